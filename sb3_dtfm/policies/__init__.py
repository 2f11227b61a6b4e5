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

    def set_solver(self, flow_solver: str, flow_steps: int = 1) -> None:
        """
        Choose how to act; the trained weights do not depend on it.

        :param flow_solver: "euler", "midpoint", "heun" or "rk4", or "one_step": one evaluation of the distilled network
        :param flow_steps: steps of the ODE solver
        :raises ValueError: unknown solver, fewer than one step, or one_step of a model that did not learn it
        """
        self.set_acting(flow_solver=flow_solver, flow_steps=flow_steps)


__all__ = ["DTFMPolicy", "DTPolicy", "SequencePolicy"]
