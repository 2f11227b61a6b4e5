"""Can: from the one bin into its compartment of the other."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.placing import PlacingDemonstrator

COMPARTMENT = np.array([0.1975, 0.405])  # metres: its middle


class CanDemonstrator(PlacingDemonstrator):
    """Grasps the can, raises it over the wall, carries it over its compartment and lets go."""

    object_columns = slice(16, 19)
    grasp_height = 0.015
    misjudgement = 0.055
    speed_range = (0.75, 1.15)  # it has half a metre to go
    clearance = 0.955  # the bins' walls
    rest_height = 0.86

    def _place(self) -> np.ndarray:
        return COMPARTMENT

    def _after_carry(self) -> str:
        return "release"  # from where it is: it may fall
