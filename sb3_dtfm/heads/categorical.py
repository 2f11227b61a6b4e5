"""Decision Transformer's head where actions are choices."""

import torch as th

from sb3_dtfm.heads.base import ActionHead, masked_mean
from sb3_dtfm.networks.layers import Linear


class CategoricalHead(ActionHead):
    """
    A linear map of the hidden state to the logits of n choices, trained by cross-entropy.

    An action is n numbers, 1 for the choice and -1 for the others. The choice is the one whose logit and Gumbel noise have
    the largest sum: a draw from the softmax of the logits, and the most likely choice where the noise is zero.

    :param embed_dim: D
    :param action_dim: n
    """

    def __init__(self, embed_dim: int, action_dim: int) -> None:
        super().__init__(embed_dim, action_dim)
        self.noise_dim = action_dim
        self.linear = Linear(embed_dim, action_dim)

    def deterministic_noise(self, generator: th.Generator) -> th.Tensor:
        return th.zeros(1, self.noise_dim)

    def loss(
        self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, *noise: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        chosen = 0.5 * (actions + 1.0)
        surprise = -(chosen * self.linear(hidden).float().log_softmax(dim=-1)).sum(dim=-1, keepdim=True)
        loss = masked_mean(surprise, mask)
        return loss, {"cross_entropy": loss}

    def forward(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        scores = self.linear(hidden) + gumbel(noise)
        chosen = scores.argmax(dim=-1, keepdim=True) == th.arange(scores.shape[-1], device=scores.device)
        return th.where(scores.isnan().any(dim=-1, keepdim=True), th.nan, 2.0 * chosen - 1.0)  # argmax would hide it


def gumbel(noise: th.Tensor) -> th.Tensor:
    """Standard normal noise (...) as standard Gumbel noise (...), by way of the probability that a smaller one is drawn."""
    return -(-th.special.log_ndtr(noise)).log()
