"""Solvers against closed forms."""

import itertools
import math

import pytest
import torch as th

from sb3_dtfm.networks.solvers import SOLVERS, integrate

ORDERS = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}


def nonlinear_field(x: th.Tensor, tau: float) -> th.Tensor:
    """dx/dtau = x^2 exp(-tau), whose flow is x(1) = 1 / (1 / x(0) - 1 + 1 / e)."""
    return x.square() * math.exp(-tau)


@pytest.mark.parametrize("flow_solver", SOLVERS)
def test_solver_converges_to_the_closed_form_at_its_order(solver):
    noise = th.tensor([[0.5, -1.0, 0.9]], dtype=th.float64)
    exact = 1.0 / (1.0 / noise - 1.0 + math.exp(-1.0))
    errors = [(integrate(nonlinear_field, noise, flow_solver, n) - exact).abs().max().item() for n in (16, 32, 64)]
    for coarse, fine in itertools.pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(ORDERS[solver], abs=0.15)
    assert errors[-1] < 0.05


@pytest.mark.parametrize("flow_solver", SOLVERS)
def test_every_solver_is_exact_on_a_straight_path_in_one_step(solver):
    noise, action = th.randn(5, 3), th.rand(5, 3)
    torch_path = integrate(lambda x, tau: action - noise, noise, flow_solver, 1)
    assert th.allclose(torch_path, action, atol=1e-6)


@pytest.mark.parametrize("flow_solver", SOLVERS)
def test_gaussian_flow_carries_noise_to_the_target_distribution(solver):
    """For a Gaussian target the marginal vector field of conditional flow matching is known, and so is its flow."""
    mean, std = 0.3, 0.2

    def marginal_field(x: th.Tensor, tau: float) -> th.Tensor:
        variance = (1 - tau) ** 2 + (tau * std) ** 2
        slope = (tau * std**2 - (1 - tau)) / variance
        return mean + slope * (x - tau * mean)

    noise = th.randn(20, 2, dtype=th.float64, generator=th.Generator().manual_seed(0))
    assert th.allclose(integrate(marginal_field, noise, flow_solver, 400), mean + std * noise, atol=6e-3)
