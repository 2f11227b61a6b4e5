"""
Flow matching: the path from noise to action, the vector field that is learned on it, and the solvers that follow it.

Time runs one way everywhere: tau = 0 is noise, tau = 1 is the action.
"""

import math
from collections.abc import Callable

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.networks.linear import Linear

Field = Callable[[th.Tensor, float], th.Tensor]
SolverStep = Callable[[Field, th.Tensor, float, float], th.Tensor]

# Not an ODE solver: a network of its own that has learnt where the solver would end (see heads.py).
ONE_STEP = "one_step"


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


def sinusoidal_embedding(tau: th.Tensor, embedding_dim: int) -> th.Tensor:
    """
    Sines and cosines of tau at frequencies from 1 to 100 rad, geometrically spaced.

    Higher ones would change faster than a solver's step can follow.

    :param tau: (...) in [0, 1]
    :param embedding_dim: even
    :return: (..., embedding_dim)
    """
    half = embedding_dim // 2
    frequencies = th.exp(th.linspace(0.0, math.log(100.0), half, device=tau.device))
    angles = tau.unsqueeze(-1) * frequencies
    return th.cat((angles.sin(), angles.cos()), dim=-1)


class FilmNetwork(nn.Module):
    """
    MLP from A to A numbers whose every hidden layer is scaled and shifted from outside (FiLM, Perez et al., 2018).

    :param action_dim: A
    :param condition_dim: width D of the hidden state h
    :param hidden_dim: width of the hidden layers
    :param n_layers: number of hidden layers
    """

    def __init__(self, action_dim: int, condition_dim: int, hidden_dim: int = 512, n_layers: int = 3) -> None:
        super().__init__()
        self.n_layers = n_layers
        self.film_dim = 2 * hidden_dim * n_layers
        sizes = [action_dim] + [hidden_dim] * n_layers
        self.layers = nn.ModuleList(Linear(sizes[i], sizes[i + 1]) for i in range(n_layers))
        self.film_condition = Linear(condition_dim, self.film_dim)
        self.output = Linear(hidden_dim, action_dim)

    def forward(self, x: th.Tensor, film: th.Tensor) -> th.Tensor:
        """
        :param x: (..., A)
        :param film: (..., 2 * hidden_dim * n_layers), scales and shifts: `film_condition(h)` and what is added to it
        :return: (..., A)
        """
        for layer, layer_film in zip(self.layers, film.chunk(self.n_layers, dim=-1), strict=True):
            scale, shift = layer_film.chunk(2, dim=-1)
            x = F.silu(layer(x) * (1.0 + scale) + shift)
        return self.output(x)


class VectorField(FilmNetwork):
    """
    Velocity v(x, tau, h): a FiLM network whose scales and shifts come from tau and h.

    The FiLM map of [psi(tau), h] is linear, so its two halves are kept apart: the half of h is computed once per action,
    the half of tau once for all times of a solver.

    :param time_embedding_dim: size of psi(tau)

    The other parameters are those of :class:`FilmNetwork`.
    """

    def __init__(
        self, action_dim: int, condition_dim: int, hidden_dim: int = 512, n_layers: int = 3, time_embedding_dim: int = 128
    ) -> None:
        super().__init__(action_dim, condition_dim, hidden_dim, n_layers)
        self.time_embedding_dim = time_embedding_dim
        self.film_time = Linear(time_embedding_dim, self.film_dim, bias=False)

    def time_share(self, tau: th.Tensor) -> th.Tensor:
        """The share of times in [0, 1], (...), in all scales and shifts: (..., 2 * hidden_dim * n_layers)."""
        return self.film_time(sinusoidal_embedding(tau, self.time_embedding_dim))


def _euler_step(field: Field, x: th.Tensor, tau: float, step: float) -> th.Tensor:
    return x + step * field(x, tau)


def _midpoint_step(field: Field, x: th.Tensor, tau: float, step: float) -> th.Tensor:
    middle = x + 0.5 * step * field(x, tau)
    return x + step * field(middle, tau + 0.5 * step)


def _heun_step(field: Field, x: th.Tensor, tau: float, step: float) -> th.Tensor:
    start = field(x, tau)
    return x + 0.5 * step * (start + field(x + step * start, tau + step))


def _rk4_step(field: Field, x: th.Tensor, tau: float, step: float) -> th.Tensor:
    k1 = field(x, tau)
    k2 = field(x + 0.5 * step * k1, tau + 0.5 * step)
    k3 = field(x + 0.5 * step * k2, tau + 0.5 * step)
    k4 = field(x + step * k3, tau + step)
    return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


SOLVERS: dict[str, SolverStep] = {
    "euler": _euler_step,
    "midpoint": _midpoint_step,
    "heun": _heun_step,
    "rk4": _rk4_step,
}


def integrate(field: Field, noise: th.Tensor, solver: str = "euler", n_solver_steps: int = 50) -> th.Tensor:
    """
    Follow dx/dtau = field(x, tau) from tau = 0 to tau = 1 in equal steps.

    The global error falls with the step to the power 1 (euler), 2 (midpoint, heun) or 4 (rk4), at 1, 2, 2 and 4 field
    evaluations a step, all at times that :func:`solver_times` lists.

    :param field: velocity of (x, tau), shaped like x
    :param noise: (..., A), x at tau = 0
    :param solver: a key of `SOLVERS`
    :param n_solver_steps: number of steps, at least 1
    :return: x at tau = 1, (..., A)
    """
    step_function = SOLVERS[solver]
    step = 1.0 / n_solver_steps
    x = noise
    for i in range(n_solver_steps):
        x = step_function(field, x, i * step, step)
    return x


def solver_times(solver: str, n_solver_steps: int) -> th.Tensor:
    """Equally spaced times from 0 to 1 among which a solver evaluates its field: whole steps, or half ones as well."""
    intervals = n_solver_steps if solver == "euler" else 2 * n_solver_steps
    return th.linspace(0.0, 1.0, intervals + 1)


def check_solver(solver: str, n_solver_steps: int) -> None:
    """
    :raises ValueError: unknown solver, or fewer than one step
    """
    accepted = (*SOLVERS, ONE_STEP)
    if solver not in accepted:
        raise ValueError(f"solver must be one of {', '.join(accepted)}, got {solver!r}.")
    if n_solver_steps < 1:
        raise ValueError(f"n_solver_steps must be at least 1, got {n_solver_steps}.")
