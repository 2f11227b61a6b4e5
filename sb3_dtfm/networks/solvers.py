"""Solvers of ordinary differential equations in fixed steps, from tau = 0 to tau = 1."""

from collections.abc import Callable

import torch as th

Field = Callable[[th.Tensor, float], th.Tensor]
SolverStep = Callable[[Field, th.Tensor, float, float], th.Tensor]


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


def integrate(field: Field, noise: th.Tensor, flow_solver: str = "euler", flow_steps: int = 50) -> th.Tensor:
    """
    Follow dx/dtau = field(x, tau) from tau = 0 to tau = 1 in equal steps.

    The global error falls with the step to the power 1 (euler), 2 (midpoint, heun) or 4 (rk4), at 1, 2, 2 and 4 field
    evaluations a step, all at times that :func:`solver_times` lists.

    :param field: function from (x, tau) to the velocity, shaped like x
    :param noise: (..., A), x at tau = 0
    :param flow_solver: a key of `SOLVERS`
    :param flow_steps: number of steps, at least 1
    :return: x at tau = 1, (..., A)
    """
    step_function = SOLVERS[flow_solver]
    step = 1.0 / flow_steps
    x = noise
    for i in range(flow_steps):
        x = step_function(field, x, i * step, step)
    return x


def solver_times(flow_solver: str, flow_steps: int, device: th.device | None = None) -> th.Tensor:
    """Equally spaced times from 0 to 1 among which a solver evaluates its field: whole steps, or half ones as well."""
    intervals = flow_steps if flow_solver == "euler" else 2 * flow_steps
    return th.linspace(0.0, 1.0, intervals + 1, device=device)
