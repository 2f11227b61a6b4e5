"""The two action heads: from a hidden state to an action in [-1, 1]."""

import torch as th
from torch import nn

from sb3_dtfm.networks.flow import VectorField, integrate, interpolate


def masked_mean(values: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """
    Mean over valid steps and all action dimensions.

    :param values: (B, K, A)
    :param mask: (B, K) bool, at least one True
    """
    per_step = values.float().mean(dim=-1)
    return (per_step * mask).sum() / mask.sum()


class RegressionHead(nn.Module):
    """
    Decision Transformer's head: a linear map of the hidden state, bounded by tanh, learned by mean squared error.

    :param embed_dim: D
    :param action_dim: A
    """

    def __init__(self, embed_dim: int, action_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(embed_dim, action_dim)

    def loss(self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        :param hidden: (B, K, D)
        :param actions: (B, K, A) in [-1, 1]
        :param mask: (B, K) bool
        :return: mean squared error over valid steps
        """
        return masked_mean((self(hidden) - actions).square(), mask)

    def forward(self, hidden: th.Tensor) -> th.Tensor:
        """Actions in [-1, 1], (..., A), for hidden states (..., D)."""
        return self.linear(hidden).tanh()


class FlowHead(nn.Module):
    """
    Flow-matching head: the hidden state conditions a vector field that carries Gaussian noise to the action.

    :param embed_dim: D
    :param action_dim: A
    :param hidden_dim: width of the vector field's hidden layers
    :param n_layers: number of hidden layers of the vector field
    """

    def __init__(self, embed_dim: int, action_dim: int, hidden_dim: int = 512, n_layers: int = 3) -> None:
        super().__init__()
        self.vector_field = VectorField(action_dim, embed_dim, hidden_dim, n_layers)

    def loss(self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, noise: th.Tensor, tau: th.Tensor) -> th.Tensor:
        """
        Conditional flow matching (Lipman et al., 2023): squared error of the velocity on the path from noise to action.

        :param hidden: (B, K, D)
        :param actions: (B, K, A) in [-1, 1]
        :param mask: (B, K) bool
        :param noise: (B, K, A), standard normal
        :param tau: (B, K), uniform in [0, 1]
        :return: mean squared error over valid steps
        """
        x, velocity = interpolate(noise, actions, tau.unsqueeze(-1))
        predicted = self.vector_field(x, tau, self.vector_field.condition(hidden))
        return masked_mean((predicted - velocity).square(), mask)

    def forward(self, hidden: th.Tensor, noise: th.Tensor, solver: str = "euler", n_solver_steps: int = 50) -> th.Tensor:
        """
        Carry noise to actions.

        :param hidden: (B, D)
        :param noise: (B, A), standard normal
        :param solver: ODE solver, a key of `sb3_dtfm.networks.flow.SOLVERS`
        :param n_solver_steps: number of its steps
        :return: (B, A), in [-1, 1] as far as the field learned it; the policy clips
        """
        condition = self.vector_field.condition(hidden)

        def field(x: th.Tensor, tau: float) -> th.Tensor:
            return self.vector_field(x, th.full((), tau, device=x.device), condition)

        return integrate(field, noise, solver, n_solver_steps)
