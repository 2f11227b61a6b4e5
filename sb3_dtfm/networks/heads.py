"""The two action heads: from a hidden state to an action in [-1, 1]."""

import torch as th
from torch import nn

from sb3_dtfm.networks.flow import ONE_STEP, FilmNetwork, VectorField, integrate, interpolate, solver_times
from sb3_dtfm.networks.linear import Linear

# Solver steps whose end the one-step network learns.
DISTILLED_STEPS = 16
# What is learned of the path: its velocity, or the action that it leads to.
PREDICTIONS = ("velocity", "action")


def masked_mean(values: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """
    Mean over valid steps and all action dimensions.

    :param values: (..., A)
    :param mask: (...) bool, at least one True
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
        self.linear = Linear(embed_dim, action_dim)

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

    With `one_step` a second network learns where that ends, so that an action can take one evaluation instead of one per
    solver step. It learns from the field and gives nothing back: trunk and field are what they are without it.

    A network that predicts the action x1 gives the velocity (x1 - x) / (1 - tau). What it has to learn is then bounded, does
    not depend on the noise where the data have one mode, and is what the last Euler step lands on. The prediction is
    tanh(W h + b + FiLM network), whose last term starts at zero: training starts from :class:`RegressionHead`, and what
    noise and time have to add to it is learned.

    :param embed_dim: D
    :param action_dim: A
    :param hidden_dim: width of the vector field's hidden layers
    :param n_layers: number of hidden layers of the vector field
    :param one_step: have the second network
    :param prediction: what is learned of the path, one of `PREDICTIONS`
    :raises ValueError: unknown prediction
    """

    def __init__(
        self,
        embed_dim: int,
        action_dim: int,
        hidden_dim: int = 512,
        n_layers: int = 3,
        one_step: bool = True,
        prediction: str = "velocity",
    ) -> None:
        super().__init__()
        if prediction not in PREDICTIONS:
            raise ValueError(f"prediction must be one of {', '.join(PREDICTIONS)}, got {prediction!r}.")
        self.vector_field = VectorField(action_dim, embed_dim, hidden_dim, n_layers)
        self.regression = None
        if prediction == "action":
            self.regression = Linear(embed_dim, action_dim)
            nn.init.zeros_(self.vector_field.output.weight)
            nn.init.zeros_(self.vector_field.output.bias)
        self.jump = FilmNetwork(action_dim, embed_dim, hidden_dim, n_layers) if one_step else None

    def loss(self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, noise: th.Tensor, tau: th.Tensor) -> th.Tensor:
        """
        Conditional flow matching (Lipman et al., 2023): squared error on the path from noise to action.

        Of the velocity, or of the action, which weighs the velocity's by (1 - tau)^2.

        :param hidden: (B, K, D)
        :param actions: (B, K, A) in [-1, 1]
        :param mask: (B, K) bool
        :param noise: (B, K, A), standard normal
        :param tau: (B, K) in [0, 1]
        :return: mean squared error over valid steps
        """
        x, velocity = interpolate(noise, actions, tau.unsqueeze(-1))
        film = self.vector_field.film_condition(hidden) + self.vector_field.time_share(tau)
        output = self.vector_field(x, film)
        error = output - velocity if self.regression is None else (self.regression(hidden) + output).tanh() - actions
        return masked_mean(error.square(), mask)

    def one_step_loss(self, hidden: th.Tensor, mask: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        Distillation (Luhman and Luhman, 2021): squared error of the jump against where the solver ends, from the same noise.

        :param hidden: (B, K, D); no gradient flows into it
        :param mask: (B, K) bool
        :param noise: (B, K, A), standard normal
        :return: mean squared error over valid steps
        """
        hidden = hidden.detach()
        with th.no_grad():
            target = self(hidden, noise, "euler", DISTILLED_STEPS).clamp(-1.0, 1.0)
        return masked_mean((self(hidden, noise, ONE_STEP) - target).square(), mask)

    def forward(self, hidden: th.Tensor, noise: th.Tensor, solver: str = "euler", n_solver_steps: int = 50) -> th.Tensor:
        """
        Carry noise to actions.

        :param hidden: (..., D)
        :param noise: (..., A), standard normal
        :param solver: "one_step", or an ODE solver, a key of `sb3_dtfm.networks.flow.SOLVERS`
        :param n_solver_steps: number of the ODE solver's steps
        :return: (..., A), in [-1, 1] as far as it was learnt; the policy clips
        """
        if solver == ONE_STEP:
            assert self.jump is not None
            return noise + self.jump(noise, self.jump.film_condition(hidden))
        times = solver_times(solver, n_solver_steps).to(hidden.device)
        condition, time_shares = self.vector_field.film_condition(hidden), self.vector_field.time_share(times)
        regressed = None if self.regression is None else self.regression(hidden)
        velocity = noise

        def field(x: th.Tensor, tau: float) -> th.Tensor:
            nonlocal velocity
            i = round(tau * (len(times) - 1))
            if regressed is None:
                velocity = self.vector_field(x, condition + time_shares[i])
            elif i < len(times) - 1:
                action = (regressed + self.vector_field(x, condition + time_shares[i])).tanh()
                velocity = (action - x) / (1.0 - tau)
            # Heun and RK4 look at tau = 1 too, where a predicted action gives 0 / 0: the slope before it stands in.
            return velocity

        return integrate(field, noise, solver, n_solver_steps)
