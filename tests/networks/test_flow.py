"""The flow's mathematics against closed forms."""

import itertools
import math

import pytest
import torch as th
from torch import nn

from sb3_dtfm.networks.flow import SOLVERS, VectorField, check_solver, integrate, interpolate, sinusoidal_embedding
from sb3_dtfm.networks.heads import PREDICTIONS, FlowHead, RegressionHead

ORDERS = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}


def nonlinear_field(x: th.Tensor, tau: float) -> th.Tensor:
    """dx/dtau = x^2 exp(-tau), whose flow is x(1) = 1 / (1 / x(0) - 1 + 1 / e)."""
    return x.square() * math.exp(-tau)


@pytest.mark.parametrize("solver", SOLVERS)
def test_solver_converges_to_the_closed_form_at_its_order(solver):
    noise = th.tensor([[0.5, -1.0, 0.9]], dtype=th.float64)
    exact = 1.0 / (1.0 / noise - 1.0 + math.exp(-1.0))
    errors = [(integrate(nonlinear_field, noise, solver, n) - exact).abs().max().item() for n in (16, 32, 64)]
    for coarse, fine in itertools.pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(ORDERS[solver], abs=0.15)
    assert errors[-1] < 0.05


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_is_exact_on_a_straight_path_in_one_step(solver):
    noise, action = th.randn(5, 3), th.rand(5, 3)
    torch_path = integrate(lambda x, tau: action - noise, noise, solver, 1)
    assert th.allclose(torch_path, action, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_gaussian_flow_carries_noise_to_the_target_distribution(solver):
    """For a Gaussian target the marginal vector field of conditional flow matching is known, and so is its flow."""
    mean, std = 0.3, 0.2

    def marginal_field(x: th.Tensor, tau: float) -> th.Tensor:
        variance = (1 - tau) ** 2 + (tau * std) ** 2
        slope = (tau * std**2 - (1 - tau)) / variance
        return mean + slope * (x - tau * mean)

    noise = th.randn(20, 2, dtype=th.float64, generator=th.Generator().manual_seed(0))
    assert th.allclose(integrate(marginal_field, noise, solver, 400), mean + std * noise, atol=6e-3)


def test_interpolate_runs_from_noise_at_zero_to_action_at_one():
    noise, action = th.randn(4, 3), th.randn(4, 3)
    for tau, expected in ((0.0, noise), (1.0, action), (0.25, 0.75 * noise + 0.25 * action)):
        x, velocity = interpolate(noise, action, th.full((4, 1), tau))
        assert th.allclose(x, expected, atol=1e-6)
        assert th.allclose(velocity, action - noise)


def test_velocity_agrees_with_the_papers_form_away_from_its_singularity():
    noise, action, tau = th.randn(4, 3), th.randn(4, 3), th.full((4, 1), 0.7)
    x, velocity = interpolate(noise, action, tau)
    assert th.allclose(velocity, (action - x) / (1 - tau), atol=1e-5)


def test_sinusoidal_embedding_tells_neighbouring_times_apart():
    embedding = sinusoidal_embedding(th.linspace(0, 1, 101), 64)
    assert embedding.shape == (101, 64)
    distances = th.cdist(embedding, embedding) + 1e9 * th.eye(101)
    assert distances.min() > 0.1


def test_film_halves_add_up_to_one_linear_map_of_time_and_condition():
    field = VectorField(action_dim=3, condition_dim=8, hidden_dim=16, n_layers=2)
    hidden, tau = th.randn(5, 8), th.rand(5)
    weight = th.cat((field.film_time.weight, field.film_condition.weight), dim=1)
    features = th.cat((sinusoidal_embedding(tau, field.time_embedding_dim), hidden), dim=1)
    joint = features @ weight.T + field.film_condition.bias
    x = noise = th.randn(5, 3)
    for i, layer in enumerate(field.layers):
        scale, shift = joint[:, 32 * i : 32 * i + 16], joint[:, 32 * i + 16 : 32 * i + 32]
        x = th.nn.functional.silu(layer(x) * (1 + scale) + shift)
    assert th.allclose(field(noise, field.film_condition(hidden) + field.time_share(tau)), field.output(x), atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("n_solver_steps", [1, 7])
def test_a_predicted_action_is_where_every_solver_ends(solver, n_solver_steps):
    head = FlowHead(embed_dim=4, action_dim=2, hidden_dim=8, prediction="action")
    action = th.tensor([0.3, -0.8])
    with th.no_grad():
        head.regression.weight.zero_()
        head.regression.bias.copy_(action.atanh())
        th.testing.assert_close(head(th.randn(5, 4), th.randn(5, 2), solver, n_solver_steps), action.expand(5, 2))


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_the_loss_is_the_mean_over_valid_steps(prediction):
    head = FlowHead(embed_dim=4, action_dim=2, hidden_dim=8, prediction=prediction)
    nn.init.normal_(head.vector_field.output.weight)
    hidden, actions = th.randn(3, 5, 4), th.rand(3, 5, 2)
    noise, tau = th.randn(3, 5, 2), th.rand(3, 5)
    mask = th.tensor([[0, 0, 1, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1, 1, 1]], dtype=th.bool)
    by_hand = []
    for row, step in mask.nonzero().tolist():
        x = (1 - tau[row, step]) * noise[row, step] + tau[row, step] * actions[row, step]
        film = head.vector_field.film_condition(hidden[row, step]) + head.vector_field.time_share(tau[row, step])
        output = head.vector_field(x, film)
        if prediction == "velocity":
            error = output - (actions[row, step] - noise[row, step])
        else:
            error = (head.regression(hidden[row, step]) + output).tanh() - actions[row, step]
        by_hand.append(error.square().mean())
    th.testing.assert_close(head.loss(hidden, actions, mask, noise, tau), th.stack(by_hand).mean())


@pytest.mark.parametrize("n_solver_steps", [1, 3, 50])
def test_a_predicted_action_stays_within_the_bounds(n_solver_steps):
    head = FlowHead(embed_dim=4, action_dim=2, hidden_dim=8, prediction="action")
    with th.no_grad():
        head.regression.weight.mul_(1000.0)
        actions = head(10 * th.randn(500, 4), th.randn(500, 2), "euler", n_solver_steps)
    assert 0.9 < actions.abs().max() < 1.0 + 1e-6


def test_a_head_that_predicts_actions_starts_as_decision_transformers():
    head, regression = FlowHead(embed_dim=4, action_dim=2, hidden_dim=8, prediction="action"), RegressionHead(4, 2)
    regression.linear.load_state_dict(head.regression.state_dict())
    hidden, actions, mask = th.randn(3, 5, 4), th.rand(3, 5, 2), th.ones(3, 5, dtype=th.bool)
    noise, tau = th.randn(3, 5, 2), th.rand(3, 5)
    th.testing.assert_close(head.loss(hidden, actions, mask, noise, tau), regression.loss(hidden, actions, mask))
    th.testing.assert_close(head(hidden, noise, "euler", 3), regression(hidden))


def test_unknown_predictions_are_refused_by_name():
    with pytest.raises(ValueError, match="prediction must be one of velocity, action, got 'noise'"):
        FlowHead(embed_dim=4, action_dim=2, prediction="noise")


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_a_flow_head_learns_two_modes_that_regression_would_average(prediction):
    th.manual_seed(0)
    generator = th.Generator().manual_seed(0)
    head = FlowHead(embed_dim=4, action_dim=1, hidden_dim=64, n_layers=2, prediction=prediction)
    optimizer = th.optim.Adam(head.parameters(), 3e-3)
    hidden, mask = th.zeros(256, 1, 4), th.ones(256, 1, dtype=th.bool)
    for _ in range(400):
        actions = th.where(th.rand(256, 1, 1, generator=generator) < 0.5, -0.7, 0.7)
        noise, tau = th.randn(256, 1, 1, generator=generator), th.rand(256, 1, generator=generator)
        optimizer.zero_grad()
        (head.loss(hidden, actions, mask, noise, tau) + head.one_step_loss(hidden, mask, noise)).backward()
        optimizer.step()
    with th.no_grad():
        samples = head(th.zeros(500, 4), th.randn(500, 1, generator=generator), n_solver_steps=20)
        noise = th.randn(500, 1, generator=generator)
        ends, jumps, plain = (head(th.zeros(500, 4), noise, *way) for way in (("euler", 16), ("one_step", 1), ("euler", 1)))
    assert ((samples.abs() - 0.7).abs() < 0.2).float().mean() > 0.9
    assert 0.35 < (samples > 0).float().mean() < 0.65
    far = noise.abs() > 0.3  # between the modes the flow is steep
    assert (jumps - ends)[far].abs().mean() < 0.1
    assert (plain - ends)[far].abs().mean() > 0.4


@pytest.mark.parametrize(("solver", "n_solver_steps"), [("verlet", 10), ("euler", 0)])
def test_unknown_solvers_are_refused_by_name(solver, n_solver_steps):
    with pytest.raises(ValueError, match="verlet" if solver == "verlet" else "n_solver_steps"):
        check_solver(solver, n_solver_steps)
