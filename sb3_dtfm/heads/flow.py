"""
The flow-matching head on one page: path, loss, distillation, solver.

Time runs one way everywhere: tau = 0 is noise, tau = 1 is the action.
"""

from dataclasses import dataclass
from typing import Any

import torch as th
from torch import nn

from sb3_dtfm.arguments import BOOLEAN, COUNT, NOT_NEGATIVE, POSITIVE, Choice, Number, Options, option
from sb3_dtfm.heads.base import ActionHead, masked_mean
from sb3_dtfm.heads.regression import RegressionHead
from sb3_dtfm.networks.layers import FilmNetwork, VectorField
from sb3_dtfm.networks.solvers import SOLVERS, integrate, solver_times

# Not an ODE solver: a network of its own that has learnt where the solver would end.
ONE_STEP = "one_step"
# Most Euler steps whose end the one-step policy learns, however many the solver takes.
MAX_DISTILLED_STEPS = 16
# Values of tau in a window, which its steps take in turn: the share of tau in scales and shifts is computed once for each.
TAUS_PER_WINDOW = 4


@dataclass(frozen=True)
class FlowOptions(Options):
    """
    Options of :class:`FlowHead`.

    :param flow_steps: number of the ODE solver's steps; 0 takes the mean action, which no noise changes
    :param flow_solver: ODE solver: "euler", "midpoint", "heun" or "rk4"; or "one_step", the distilled network
    :param flow_hidden_dim: width of the vector field's hidden layers
    :param flow_n_layers: number of the vector field's hidden layers
    :param flow_prediction: output of the vector field: "velocity" of the path, or the "action" at its end
    :param flow_draws: number of noises and times that are drawn for each step in training; more than one if an encoder of
        images, which all of them share, costs most of a gradient step
    :param flow_tau_exponent: exponent p of the loss's times tau = u^p, with u uniform in [0, 1]; above 1 more of them are
        near the noise, where the action has to come from the hidden state
    :param regression_coef: weight of the regression of the action from the hidden state in the loss; 0 leaves it out
    :param one_step_policy: whether a network is trained that replaces the solver by one evaluation
    :raises ValueError: an option out of range, or a way of acting that the others do not train, by name
    """

    flow_steps: int = option(10, Number(low=0, high=10_000, whole=True), acting=True)
    flow_solver: str = option("euler", Choice((*SOLVERS, ONE_STEP)), acting=True)
    flow_hidden_dim: int = option(128, COUNT)
    flow_n_layers: int = option(3, COUNT)
    flow_prediction: str = option("action", Choice(("velocity", "action")))
    flow_draws: int = option(1, COUNT)
    flow_tau_exponent: float = option(2.0, POSITIVE)
    regression_coef: float = option(1.0, NOT_NEGATIVE)
    one_step_policy: bool = option(False, BOOLEAN)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.flow_solver == ONE_STEP and not self.one_step_policy:
            raise ValueError(
                f"flow_solver={ONE_STEP!r} needs a model that was trained with policy_kwargs=dict(one_step_policy=True)."
            )
        if self.flow_steps == 0 and not self.regression_coef:
            raise ValueError("flow_steps=0 needs a model that was trained with policy_kwargs=dict(regression_coef=1.0).")


def interpolate(noise: th.Tensor, action: th.Tensor, tau: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Point and velocity at time tau on the straight path from noise to action (Lipman et al., 2023, optimal transport).

    :param noise: (..., A), the path's start
    :param action: (..., A), the path's end
    :param tau: (..., 1) in [0, 1]
    :return: the point (1 - tau) noise + tau action, and the constant velocity action - noise, both (..., A)
    """
    velocity = action - noise
    return noise + tau * velocity, velocity


def in_turn(values: th.Tensor, context_length: int) -> th.Tensor:
    """Repeat N values a window, (B, N, ...), in turn, to one a step, (B, K, ...)."""
    return values.repeat(1, -(-context_length // values.shape[1]), 1)[:, :context_length]


class FlowHead(ActionHead):
    """
    Flow-matching head: the hidden state conditions a vector field that carries Gaussian noise to the action.

    A head that predicts the action x1 instead of the velocity has a bounded target, which does not depend on the noise where
    the data have one mode, and which the last Euler step lands on; the velocity (x1 - x) / (1 - tau) follows from it. The
    prediction is tanh(W h + b + FiLM network), whose last term starts at zero: training starts from Decision Transformer's
    regression, and what noise and time have to add to it is learned.

    With `regression_coef` above 0, Transformer and W h + b learn by the regression's loss, and the FiLM network by flow
    matching from a hidden state that it gives no gradient. `flow_steps=0` then acts with tanh(W h + b), the mean action.
    By the flow's loss alone the Transformer learns the mean more slowly.

    With `one_step_policy` a second network learns where `flow_steps` of Euler end, 16 at most, so that an action can take
    one evaluation instead of one per solver step. It passes no gradient back. If the field predicts actions, it adds
    to the same W h + b, and starts at zero, too; else it adds to the noise.

    :param embed_dim: D
    :param action_dim: A
    :param options: options of :class:`FlowOptions`
    """

    algorithm = "DTFM"
    options_class = FlowOptions
    options: FlowOptions

    def __init__(self, embed_dim: int, action_dim: int, **options: Any) -> None:
        super().__init__(embed_dim, action_dim, **options)
        self.noise_dim = action_dim
        sizes = (action_dim, embed_dim, self.options.flow_hidden_dim, self.options.flow_n_layers)
        self.vector_field = VectorField(*sizes)
        self.predicts_action = self.options.flow_prediction == "action"
        regresses = self.predicts_action or self.options.regression_coef > 0
        self.regression = RegressionHead(embed_dim, action_dim) if regresses else None
        self.one_step_policy = FilmNetwork(*sizes) if self.options.one_step_policy else None
        if self.predicts_action:
            for network in (self.vector_field, self.one_step_policy):
                if network is not None:
                    nn.init.zeros_(network.output.weight)
                    nn.init.zeros_(network.output.bias)
        self.n_distilled_steps = min(max(self.options.flow_steps, 1), MAX_DISTILLED_STEPS)  # however it acts later

    @property
    def noise_decides(self) -> bool:
        """Return False with 0 solver steps, or with one of Euler, which ends at the mean action from any noise."""
        solver, n_steps = self.options.flow_solver, self.options.flow_steps
        return solver == ONE_STEP or n_steps > (1 if solver == "euler" else 0)

    def draw_noise(self, actions: th.Tensor, generator: th.Generator) -> tuple[th.Tensor, ...]:
        batch_size, context_length = self.options.flow_draws * actions.shape[0], actions.shape[1]
        noise = th.randn(batch_size, *actions.shape[1:], generator=generator, device=actions.device)
        start = th.rand((), generator=generator, device=actions.device)
        rows = th.linspace(0, 1, batch_size + 1, device=actions.device)[:-1, None]
        turns = th.linspace(0, 1, TAUS_PER_WINDOW + 1, device=actions.device)[:-1]
        return noise, (start + rows + turns)[:, :context_length].remainder(1.0) ** self.options.flow_tau_exponent

    def loss(
        self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, *noise: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        starts, tau = noise
        learned = hidden.detach() if self.options.regression_coef else hidden
        hiddens, targets, masks = (th.cat([each] * self.options.flow_draws) for each in (learned, actions, mask))
        loss = self.flow_loss(hiddens, targets, masks, starts, tau)
        parts = {"flow_loss": loss}
        if self.options.regression_coef:
            assert self.regression is not None
            regression_loss, regression_parts = self.regression.loss(hidden, actions, mask)
            loss, parts = loss + self.options.regression_coef * regression_loss, {**parts, **regression_parts}
        if self.one_step_policy is not None:
            parts["one_step_loss"] = self.one_step_loss(hidden[:, -1], mask[:, -1], starts[: len(hidden), -1])
            loss = loss + parts["one_step_loss"]
        return loss, parts

    def flow_loss(
        self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, noise: th.Tensor, tau: th.Tensor
    ) -> th.Tensor:
        """
        Conditional flow matching (Lipman et al., 2023): squared error on the path from noise to action.

        The error is the velocity's, or the action's, which weighs the velocity's by (1 - tau)^2.

        :param hidden: (B, K, D)
        :param actions: (B, K, A) in [-1, 1]
        :param mask: (B, K) bool
        :param noise: (B, K, A), standard normal
        :param tau: (B, N) in [0, 1], which the steps take in turn
        :return: mean squared error over valid steps
        """
        x, velocity = interpolate(noise, actions, in_turn(tau.unsqueeze(-1), actions.shape[1]))
        time_share = in_turn(self.vector_field.time_share(tau), actions.shape[1])
        output = self.vector_field(x, self.vector_field.film_condition(hidden) + time_share)
        error = (self._regressed(hidden) + output).tanh() - actions if self.predicts_action else output - velocity
        return masked_mean(error.square(), mask)

    def _regressed(self, hidden: th.Tensor) -> th.Tensor:
        """W h + b, (..., A); learned by the regression alone where there is one."""
        assert self.regression is not None
        regressed = self.regression.linear(hidden)
        return regressed.detach() if self.options.regression_coef else regressed

    def one_step_loss(self, hidden: th.Tensor, mask: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        Distillation (Luhman and Luhman, 2021): squared error against where the solver ends, from the same noise.

        :param hidden: (..., D); no gradient flows into it
        :param mask: (...) bool
        :param noise: (..., A), standard normal
        :return: mean squared error over valid steps
        """
        hidden = hidden.detach()
        with th.no_grad():
            target = self.solve(hidden, noise, "euler", self.n_distilled_steps).clamp(-1.0, 1.0)
        return masked_mean((self.one_step_action(hidden, noise) - target).square(), mask)

    def forward(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        if self.options.flow_solver == ONE_STEP:
            return self.one_step_action(hidden, noise)
        if self.options.flow_steps == 0:
            assert self.regression is not None
            return self.regression(hidden)
        return self.solve(hidden, noise, self.options.flow_solver, self.options.flow_steps)

    def one_step_action(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """Map noise (..., A) to actions (..., A) in one step. No gradient flows into the field's W h + b."""
        assert self.one_step_policy is not None
        change = self.one_step_policy(noise, self.one_step_policy.film_condition(hidden))
        return (self._regressed(hidden).detach() + change).tanh() if self.predicts_action else noise + change

    def solve(self, hidden: th.Tensor, noise: th.Tensor, flow_solver: str, flow_steps: int) -> th.Tensor:
        """
        Carry noise to actions along the vector field.

        The FiLM map of [psi(tau), h] is linear: the share of h is computed once, that of tau once for all times.

        :param hidden: (..., D)
        :param noise: (..., A), standard normal
        :param flow_solver: a key of `SOLVERS`
        :param flow_steps: number of steps
        :return: (..., A), in [-1, 1] as far as it was learnt; the policy clips
        """
        times = solver_times(flow_solver, flow_steps, hidden.device)
        condition, time_shares = self.vector_field.film_condition(hidden), self.vector_field.time_share(times)
        regressed = self._regressed(hidden) if self.predicts_action else None
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

        return integrate(field, noise, flow_solver, flow_steps)

    def part_masks(self, mask: th.Tensor) -> dict[str, th.Tensor]:
        return {"one_step_loss": mask[:, -1]} if self.one_step_policy is not None else {}

    def unclipped_parameters(self) -> list[nn.Parameter]:
        """The one-step network's: it must not change how the others are clipped."""
        return [] if self.one_step_policy is None else list(self.one_step_policy.parameters())

    @staticmethod
    def search_space(trial: Any) -> dict[str, Any]:
        return {
            "flow_hidden_dim_pow": trial.suggest_int("flow_hidden_dim_pow", 7, 9),
            "flow_n_layers": trial.suggest_int("flow_n_layers", 2, 4),
            "flow_prediction": trial.suggest_categorical("flow_prediction", ["velocity", "action"]),
            "flow_tau_exponent": trial.suggest_categorical("flow_tau_exponent", [1.0, 2.0]),
            "flow_steps": trial.suggest_categorical("flow_steps", [0, 3, 10, 50]),
        }
