"""Decision Transformer's policy."""

from typing import Any

import torch as th

from sb3_dtfm.networks.heads import RegressionHead
from sb3_dtfm.policies.sequence import SequenceNetwork, SequencePolicy


class DTPolicy(SequencePolicy):
    """Decision Transformer: the action is regressed from the hidden state, bounded by tanh."""

    def _make_head(self) -> RegressionHead:
        return RegressionHead(self.embed_dim, self.action_dim)

    @staticmethod
    def _head(network: SequenceNetwork) -> RegressionHead:
        assert isinstance(network.head, RegressionHead)
        return network.head

    def compute_loss(self, batch: Any, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        windows = self.scaled_windows(batch)
        hidden = self.hidden_states(self.network, windows)
        loss = self._head(self.network).loss(hidden, windows.actions, windows.mask)
        return loss, {"regression_loss": loss}

    def _generate(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        return self._head(self.acting_network)(hidden)
