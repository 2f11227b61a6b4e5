"""The policies: `DTPolicy` and `DTFMPolicy` differ in their head only."""

from sb3_dtfm.policies.dt import DTPolicy
from sb3_dtfm.policies.dtfm import DTFMPolicy
from sb3_dtfm.policies.sequence import SequencePolicy

__all__ = ["DTFMPolicy", "DTPolicy", "SequencePolicy"]
