"""Expected range of the return-to-go, given the observation."""

import torch as th
from torch import nn

from sb3_dtfm.networks.layers import Linear

HIDDEN_DIM = 256
# The lower and the upper expectile: 0.5 would be the mean twice, 0 and 1 the extremes.
EXPECTILES = (0.05, 0.95)


class ReturnRange(nn.Module):
    """
    A lower and an upper expectile of the return-to-go by the observation (Newey and Powell, 1987), in the trunk's units.

    Returns-to-go outside of it are rare in the training data from such an observation. This matters where the start decides
    the return, as in Pendulum, and where an agent has fallen and cannot reach the target any more.

    :param observation_dim: O
    """

    def __init__(self, observation_dim: int) -> None:
        super().__init__()
        sizes = (observation_dim, HIDDEN_DIM, HIDDEN_DIM)
        layers = [layer for i in (0, 1) for layer in (Linear(sizes[i], sizes[i + 1]), nn.LayerNorm(sizes[i + 1]), nn.ReLU())]
        self.layers = nn.Sequential(*layers, Linear(HIDDEN_DIM, 2))

    def loss(self, observations: th.Tensor, returns_to_go: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        :param observations: (B, K, O), normalised
        :param returns_to_go: (B, K), in the trunk's units
        :param mask: (B, K) bool, False on padded steps
        :return: sum of both expectile losses, mean over valid steps
        """
        missing = returns_to_go.unsqueeze(-1) - self.layers(observations).float()
        above = missing.new_tensor(EXPECTILES)
        errors = th.where(missing > 0, above, 1.0 - above) * missing.square()
        return (errors.sum(dim=-1) * mask).sum() / mask.sum()

    def forward(self, observations: th.Tensor, returns_to_go: th.Tensor) -> th.Tensor:
        """
        :param observations: (B, K, O), normalised
        :param returns_to_go: (B, K)
        :return: (B, K), clamped to the range
        """
        low, high = self.layers(observations).unbind(-1)
        return returns_to_go.clamp(low, high)
