"""Decision Transformer's head."""

import torch as th

from sb3_dtfm.heads.base import ActionHead, masked_mean
from sb3_dtfm.heads.categorical import CategoricalHead
from sb3_dtfm.networks.layers import Linear


class RegressionHead(ActionHead):
    """Decision Transformer (Chen et al., 2021): a linear map of the hidden state, bounded by tanh, trained by MSE."""

    algorithm = "DT"
    discrete = CategoricalHead

    def __init__(self, embed_dim: int, action_dim: int) -> None:
        super().__init__(embed_dim, action_dim)
        self.linear = Linear(embed_dim, action_dim)

    def loss(
        self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, *noise: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        loss = masked_mean((self(hidden) - actions).square(), mask)
        return loss, {"regression_loss": loss}

    def forward(self, hidden: th.Tensor, noise: th.Tensor | None = None) -> th.Tensor:
        return self.linear(hidden).tanh()
