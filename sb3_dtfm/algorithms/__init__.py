"""One offline learn loop, and an algorithm for each action head."""

from sb3_dtfm.algorithms.base import POLICY_NAMES
from sb3_dtfm.algorithms.dt import DT
from sb3_dtfm.algorithms.dtfm import DTFM
from sb3_dtfm.algorithms.offline import OfflineSequenceAlgorithm
from sb3_dtfm.heads import HEADS, ActionHead
from sb3_dtfm.policies import SequencePolicy


def _algorithm_of(head: type[ActionHead]) -> type[OfflineSequenceAlgorithm]:
    """For a head without a class of its own here; this module holds the new classes, so that their models can be saved."""
    policy = type(f"{head.algorithm}Policy", (SequencePolicy,), {"head_class": head, "__module__": __name__})
    members = {"policy_aliases": dict.fromkeys(POLICY_NAMES, policy), "__module__": __name__, "__doc__": head.__doc__}
    algorithm = type(head.algorithm, (OfflineSequenceAlgorithm,), members)
    globals().update({each.__name__: each for each in (policy, algorithm)})
    return algorithm


# By the name that RL-Zoo and the command line use.
ALGORITHMS: dict[str, type[OfflineSequenceAlgorithm]] = {"dt": DT, "dtfm": DTFM}
for _name, _head in HEADS.items():
    if _name.lower() not in ALGORITHMS:
        ALGORITHMS[_name.lower()] = _algorithm_of(_head)

__all__ = ["ALGORITHMS", "DT", "DTFM"]
