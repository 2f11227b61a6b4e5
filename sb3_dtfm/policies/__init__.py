"""The policies: `DTPolicy` and `DTFMPolicy` differ in their head only."""

from sb3_dtfm.heads import FlowHead, RegressionHead
from sb3_dtfm.policies.sequence import SequencePolicy


class DTPolicy(SequencePolicy):
    """Decision Transformer: the action is regressed from the hidden state. Arguments are those of `SequencePolicy`."""

    head_class = RegressionHead


class DTFMPolicy(SequencePolicy):
    """
    Decision Transformer with flow matching: the hidden state conditions a vector field from noise to action.

    Arguments are those of `SequencePolicy` and, by name, :class:`~sb3_dtfm.heads.flow.FlowOptions`.
    """

    head_class = FlowHead


__all__ = ["DTFMPolicy", "DTPolicy", "SequencePolicy"]
