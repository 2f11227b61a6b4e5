"""Square: the square nut onto its peg."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.placing import PlacingDemonstrator
from sb3_dtfm.envs.robosuite.demonstrators.rotations import downward, hand_yaw, object_yaw

PEG = np.array([0.23, 0.1])  # metres: its axis
PEG_TOP = 0.95  # metres
HANDLE = 0.060  # metres from the middle of the nut to where the hand holds it
FITTING = 0.5 * np.pi * np.array([1.0, 2.0, 3.0])  # yaws of a nut on the peg; with its handle ahead, the arm is too short
LEAST_HAND_YAW = -np.pi / 3.0  # the wrist turns further to the other side


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

    def _locate(self, observation: np.ndarray) -> np.ndarray:
        turned = object_yaw(observation[19:23])
        self._handle = HANDLE * np.array([np.cos(turned), np.sin(turned)])
        if self.stage in ("hover", "descend", "pause", "grasp"):
            turns = (FITTING - turned + np.pi) % (2.0 * np.pi) - np.pi
            self._nut_yaw = turned + float(turns[np.argmin(np.abs(turns))])
            # Half a turn of the hand changes nothing.
            self._orientation = downward((turned - LEAST_HAND_YAW) % np.pi + LEAST_HAND_YAW)
        else:
            to_turn = (self._nut_yaw - turned + np.pi) % (2.0 * np.pi) - np.pi
            self._orientation = downward(hand_yaw(observation[3:7]) + to_turn)
        return observation[16:19] + np.array([*self._handle, 0.0])

    def _place(self) -> np.ndarray:
        return PEG + self._handle

    def _release_height(self) -> float:
        return self._drop_height
