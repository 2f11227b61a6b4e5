"""One offline learn loop, and an algorithm for each action head."""

from sb3_dtfm.algorithms.dt import DT
from sb3_dtfm.algorithms.dtfm import DTFM
from sb3_dtfm.algorithms.offline import OfflineAlgorithm

# By the name that RL-Zoo and the command line use.
ALGORITHMS: dict[str, type[OfflineAlgorithm]] = {"dt": DT, "dtfm": DTFM}

__all__ = ["ALGORITHMS", "DT", "DTFM"]
