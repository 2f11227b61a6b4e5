"""Stack: the small cube onto the large one."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.placing import PlacingDemonstrator
from sb3_dtfm.envs.robosuite.demonstrators.rotations import downward, object_yaw

STACKED_HEIGHT = 0.87  # metres: of the small cube's centre where it lies on the large one


class StackDemonstrator(PlacingDemonstrator):
    """Grasps the small cube between two faces that the large one leaves free, and lays it on top of that."""

    turn_speed = 0.4
    turn_tolerance = 0.15
    clearance = STACKED_HEIGHT + 0.02
    rest_height = 0.82
    precision = 0.25

    def reset(self) -> None:
        super().reset()
        self._drop = self._rng.uniform(0.0, 0.006)  # metres

    def _locate(self, observation: np.ndarray) -> np.ndarray:
        cube, self._large_cube = observation[9:12], observation[16:19]
        if self.stage == "hover":
            aside = self._large_cube - cube
            neighbour = float(np.arctan2(aside[1], aside[0]))
            self._orientation = downward(_grasp_yaw(object_yaw(observation[12:16]), neighbour))
        return cube

    def _place(self) -> np.ndarray:
        return self._large_cube[:2]

    def _release_height(self) -> float:
        return STACKED_HEIGHT + self._drop


def _grasp_yaw(cube: float, neighbour: float) -> float:
    """
    Return how the hand turns for two faces of a cube, so that neither finger comes down towards its neighbour.

    :param cube: yaw of the cube, radians
    :param neighbour: direction of the other cube, radians
    :return: radians in [-pi / 2, pi / 2]
    """
    # The fingers open sideways: with the hand's yaw along the neighbour's direction, they pass it by on both sides.
    turned = cube + 0.5 * np.pi * np.round((neighbour - cube) / (0.5 * np.pi))
    return float(np.arctan(np.tan(turned)))  # half a turn of the hand changes nothing
