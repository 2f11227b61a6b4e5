"""Square: the square nut onto its peg."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.base import downward, hand_yaw, object_yaw
from sb3_dtfm.envs.robosuite.demonstrators.placing import PlacingDemonstrator

PEG = np.array([0.23, 0.1])  # metres: its axis
PEG_TOP = 0.95  # metres
HANDLE = 0.060  # metres from the middle of the nut to where the hand holds it


class SquareDemonstrator(PlacingDemonstrator):
    """Grasps the nut by its handle, turns it until it is square with the peg, and lowers it over that."""

    misjudgement = 0.03
    speed_range = (0.5, 0.9)
    turn_speed = 0.4
    turn_tolerance = 0.15
    clearance = PEG_TOP + 0.03
    rest_height = 0.83
    precision = 0.15
    place_turn_tolerance = 0.1

    def reset(self) -> None:
        super().reset()
        self._drop_height = self._rng.uniform(0.87, 0.93)  # metres

    def _look(self, observation: np.ndarray) -> np.ndarray:
        turned = object_yaw(observation[19:23])
        self._handle = HANDLE * np.array([np.cos(turned), np.sin(turned)])
        if self.stage in ("hover", "descend", "pause", "grasp"):
            self._square_yaw = 0.5 * np.pi * np.round(turned / (0.5 * np.pi))
            self._orientation = downward(float(np.arctan(np.tan(turned))))  # half a turn of the hand changes nothing
        else:
            self._orientation = downward(hand_yaw(observation[3:7]) + self._square_yaw - turned)
        return observation[16:19] + np.array([*self._handle, 0.0])

    def _place(self) -> np.ndarray:
        return PEG + self._handle

    def _release_height(self) -> float:
        return self._drop_height
