"""The policy of Decision Transformer with flow matching."""

import math
from typing import Any

import torch as th
from torch import nn

from sb3_dtfm.networks.flow import ONE_STEP, check_solver
from sb3_dtfm.networks.heads import FlowHead, RegressionHead
from sb3_dtfm.policies.sequence import SequenceNetwork, SequencePolicy, standard_normal

# Rows of the table that deterministic acting takes its noise from.
NOISE_ROWS = 1024
# Newest steps of each window that the one-step network learns from: where acting asks it, and few enough to cost little.
ONE_STEP_POSITIONS = 4


class DTFMPolicy(SequencePolicy):
    """
    Decision Transformer with flow matching: the hidden state conditions a vector field from noise to action.

    `deterministic=True` starts from noise that belongs to the time step and the episode: rows of a table that is drawn once
    from `seed` and saved with the model, from a row on that the episode's first observation decides. Zero noise would be one
    point of the distribution, and following the same mode for ever gets an arm stuck; the same rows in every episode would
    give all of them the same luck.

    :param flow_hidden_dim: width of the vector field's hidden layers
    :param flow_n_layers: number of its hidden layers
    :param flow_prediction: what the head learns of the path: its "velocity", or the "action" it leads to, within its bounds
        by tanh, from which the velocity follows
    :param flow_tau_exponent: tau of the loss is u to this power for u uniform in [0, 1]: above 1 it is more often near the
        noise, where the action has to come from the hidden state
    :param solver: how to act: an ODE solver, euler, midpoint, heun or rk4; or one_step, the network that learnt its end
    :param n_solver_steps: steps of the ODE solver
    :param one_step: train that network; a few percent of a gradient step, no influence on the rest
    :param regression_coef: weight of the auxiliary action regression; 0 leaves it out

    The other parameters are those of :class:`SequencePolicy`.
    """

    noise_table: th.Tensor

    def __init__(
        self,
        *args: Any,
        flow_hidden_dim: int = 512,
        flow_n_layers: int = 3,
        flow_prediction: str = "velocity",
        flow_tau_exponent: float = 1.0,
        solver: str = "euler",
        n_solver_steps: int = 50,
        one_step: bool = True,
        regression_coef: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.flow_hidden_dim = flow_hidden_dim
        self.flow_n_layers = flow_n_layers
        self.flow_prediction = flow_prediction
        if not 0.0 < flow_tau_exponent < math.inf:
            raise ValueError(f"flow_tau_exponent must be positive and finite, got {flow_tau_exponent}.")
        self.flow_tau_exponent = flow_tau_exponent
        self.solver = solver
        self.n_solver_steps = n_solver_steps
        self.one_step = one_step
        self.regression_coef = regression_coef
        super().__init__(*args, **kwargs)
        noise_generator = th.Generator().manual_seed(0 if self.seed is None else self.seed)
        self.register_buffer("noise_table", standard_normal(NOISE_ROWS, self.action_dim, noise_generator))
        self._acting_generator: th.Generator | None = None

    def _make_head(self) -> FlowHead:
        self._check_solver(self.solver, self.n_solver_steps)
        sizes = (self.embed_dim, self.action_dim, self.flow_hidden_dim, self.flow_n_layers)
        return FlowHead(*sizes, self.one_step, self.flow_prediction)

    @staticmethod
    def _head(network: SequenceNetwork) -> FlowHead:
        assert isinstance(network.head, FlowHead)
        return network.head

    def _make_auxiliary_head(self) -> RegressionHead | None:
        return RegressionHead(self.embed_dim, self.action_dim) if self.regression_coef > 0 else None

    def draw_noise(self, batch: Any, generator: th.Generator) -> tuple[th.Tensor, ...]:
        shape, device = batch.actions.shape, batch.actions.device
        noise = th.randn(shape, generator=generator, device=device)
        tau = th.rand(shape[:2], generator=generator, device=device) ** self.flow_tau_exponent
        return noise, tau

    def compute_loss(self, batch: Any, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        starts, tau = noise
        windows = self.scaled_windows(batch)
        hidden = self.hidden_states(self.network, windows)
        head = self._head(self.network)
        parts = {"flow_loss": head.loss(hidden, windows.actions, windows.mask, starts, tau)}
        loss = parts["flow_loss"]
        if self.network.auxiliary_head is not None:
            parts["regression_loss"] = self.network.auxiliary_head.loss(hidden, windows.actions, windows.mask)
            loss = loss + self.regression_coef * parts["regression_loss"]
        if self.one_step:
            newest = slice(-ONE_STEP_POSITIONS, None)
            parts["one_step_loss"] = head.one_step_loss(hidden[:, newest], windows.mask[:, newest], starts[:, newest])
            loss = loss + parts["one_step_loss"]
        return loss, parts

    def part_masks(self, mask: th.Tensor) -> dict[str, th.Tensor]:
        return {"one_step_loss": mask[:, -ONE_STEP_POSITIONS:]} if self.one_step else {}

    def clipped_parameters(self) -> list[nn.Parameter]:
        """All but the one-step network's: it must not change how the others are clipped."""
        return [p for name, p in self.network.named_parameters() if not name.startswith("head.jump")]

    def _generate(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        return self._head(self.acting_network)(hidden, noise, self.solver, self.n_solver_steps)

    def _check_solver(self, solver: str, n_solver_steps: int) -> None:
        check_solver(solver, n_solver_steps)
        if solver == ONE_STEP and not self.one_step:
            raise ValueError(f"solver={ONE_STEP!r} needs a model that was trained with policy_kwargs=dict(one_step=True).")

    def set_solver(self, solver: str, n_solver_steps: int = 1) -> None:
        """
        Choose how to act; the trained weights do not depend on it.

        :param solver: euler, midpoint, heun or rk4, or one_step: a single evaluation of the network that learnt their end
        :param n_solver_steps: steps of the ODE solver
        :raises ValueError: unknown solver, fewer than one step, or one_step of a model that did not learn it
        """
        self._check_solver(solver, n_solver_steps)
        self.solver = solver
        self.n_solver_steps = n_solver_steps

    def _acting_noise(self, timestep: th.Tensor, episode_key: th.Tensor, deterministic: bool) -> th.Tensor:
        if deterministic:
            return self.noise_table[(timestep + episode_key) % NOISE_ROWS]
        if self._acting_generator is None:
            self._acting_generator = th.Generator(self.device)
            if self.seed is None:
                self._acting_generator.seed()
            else:
                self._acting_generator.manual_seed(self.seed)
        return standard_normal(len(timestep), self.action_dim, self._acting_generator)

    def _acting_settings(self) -> dict[str, Any]:
        return {**super()._acting_settings(), "solver": self.solver, "n_solver_steps": self.n_solver_steps}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        flow_names = ("flow_hidden_dim", "flow_n_layers", "flow_prediction", "flow_tau_exponent")
        names = (*flow_names, "one_step", "regression_coef")
        own = {name: getattr(self, name) for name in names}
        return {**super()._get_constructor_parameters(), **own, **self._acting_settings()}
