"""The flow's mathematics against closed forms, and what the head makes of it."""

import pytest
import torch as th
from torch import nn

from sb3_dtfm.callbacks import flow_paths
from sb3_dtfm.heads import FlowHead, RegressionHead
from sb3_dtfm.heads.flow import in_turn, interpolate
from sb3_dtfm.networks.solvers import SOLVERS

PREDICTIONS = ("velocity", "action")


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


@pytest.mark.parametrize("flow_solver", SOLVERS)
@pytest.mark.parametrize("flow_steps", [1, 7])
def test_a_predicted_action_is_where_every_solver_ends(flow_solver, flow_steps):
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_prediction="action")
    action = th.tensor([0.3, -0.8])
    with th.no_grad():
        head.regression.linear.weight.zero_()
        head.regression.linear.bias.copy_(action.atanh())
        th.testing.assert_close(head.solve(th.randn(5, 4), th.randn(5, 2), flow_solver, flow_steps), action.expand(5, 2))


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_the_loss_is_the_mean_over_valid_steps(prediction):
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_prediction=prediction)
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
            error = (head.regression.linear(hidden[row, step]) + output).tanh() - actions[row, step]
        by_hand.append(error.square().mean())
    th.testing.assert_close(head.flow_loss(hidden, actions, mask, noise, tau), th.stack(by_hand).mean())


def test_several_draws_are_the_mean_of_single_ones_and_share_the_hidden_state():
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_draws=3, regression_coef=0.0)
    nn.init.normal_(head.vector_field.output.weight)
    hidden, actions, mask = th.randn(5, 2, 4, requires_grad=True), th.rand(5, 2, 2), th.rand(5, 2) < 0.7
    noise, tau = head.draw_noise(actions, th.Generator().manual_seed(0))
    assert (noise.shape, tau.shape) == ((15, 2, 2), (15, 2))
    assert tau.view(3, 5, 2)[:, :, 0].sqrt().sort(dim=0).values.diff(dim=0).min() > 0.1  # of a row, far from each other
    single = [head.flow_loss(hidden, actions, mask, *each) for each in zip(noise.split(5), tau.split(5), strict=True)]
    expected = th.stack(single).mean()
    loss, _ = head.loss(hidden, actions, mask, noise, tau)
    th.testing.assert_close(loss, expected)
    gradients = [th.autograd.grad(each, hidden, retain_graph=True)[0] for each in (loss, expected)]
    th.testing.assert_close(*gradients)


def test_taus_are_spread_evenly_from_a_random_start_and_taken_in_turn():
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_tau_exponent=1.0)
    generator = th.Generator().manual_seed(0)
    noise, tau = head.draw_noise(th.zeros(50, 20, 2), generator)
    assert (noise.shape, tau.shape) == ((50, 20, 2), (50, 4))
    assert tau.flatten().sort().values.diff().max() <= 1 / 50 + 1e-6
    th.testing.assert_close((tau - tau[:, :1]).remainder(1.0), th.tensor([0.0, 0.25, 0.5, 0.75]).expand(50, 4))
    starts = th.cat([head.draw_noise(th.zeros(1, 1, 2), generator)[1] for _ in range(2000)])
    assert starts.mean() == pytest.approx(0.5, abs=0.03)
    assert 0.0 <= starts.min() < 0.01 < 0.99 < starts.max() <= 1.0
    tau = tau.unsqueeze(-1)
    assert in_turn(tau, 6).equal(tau[:, [0, 1, 2, 3, 0, 1]])
    assert in_turn(tau, 3).equal(tau[:, :3])


@pytest.mark.parametrize("flow_steps", [1, 3, 50])
def test_a_predicted_action_stays_within_the_bounds(flow_steps):
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_prediction="action")
    with th.no_grad():
        head.regression.linear.weight.mul_(1000.0)
        actions = head.solve(10 * th.randn(500, 4), th.randn(500, 2), "euler", flow_steps)
    assert 0.9 < actions.abs().max() < 1.0 + 1e-6


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_paths_lead_from_the_noise_to_the_actions(prediction):
    head = FlowHead(
        embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_prediction=prediction, flow_solver="euler", flow_steps=9
    )
    nn.init.normal_(head.vector_field.output.weight)
    hidden, noise = th.randn(5, 4), th.randn(5, 2)
    with th.no_grad():
        paths = flow_paths(head, hidden, noise, 9)
        assert paths.shape == (10, 5, 2)
        assert paths[0].equal(noise)
        assert paths[-1].equal(head(hidden, noise))
        th.testing.assert_close(paths[:2], flow_paths(head, hidden, noise, 9)[:2])
        assert not head.vector_field._forward_pre_hooks, "nothing stays behind"


def test_a_head_that_predicts_actions_starts_as_decision_transformers():
    head, regression = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_prediction="action"), RegressionHead(4, 2)
    regression.load_state_dict(head.regression.state_dict())
    hidden, actions, mask = th.randn(3, 5, 4), th.rand(3, 5, 2), th.ones(3, 5, dtype=th.bool)
    noise, tau = th.randn(3, 5, 2), th.rand(3, 5)
    expected, _ = regression.loss(hidden, actions, mask)
    th.testing.assert_close(head.flow_loss(hidden, actions, mask, noise, tau), expected)
    th.testing.assert_close(head.solve(hidden, noise, "euler", 3), regression(hidden))


def test_its_one_step_network_starts_so_too_and_leaves_the_regression_alone():
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_prediction="action", one_step_policy=True)
    hidden, noise = th.randn(3, 4), th.randn(3, 2)
    th.testing.assert_close(head.one_step_action(hidden, noise), head.solve(hidden, noise, "euler", 1))
    nn.init.normal_(head.vector_field.output.weight)
    head.one_step_loss(hidden, th.ones(3, dtype=th.bool), noise).backward()
    moved = {name for name, parameter in head.named_parameters() if parameter.grad is not None}
    assert moved == {name for name, _ in head.named_parameters() if name.startswith("one_step_policy.")}


@pytest.mark.parametrize(("flow_steps", "expected"), [(3, 3), (50, 16)])
def test_the_one_step_network_learns_where_the_solver_of_the_settings_ends(flow_steps, expected):
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_steps=flow_steps, one_step_policy=True)
    head.options = head.options.changed(flow_steps=1)  # as it acts later changes nothing
    hidden, noise = th.randn(3, 4), th.randn(3, 2)
    error = head.one_step_action(hidden, noise) - head.solve(hidden, noise, "euler", expected).clamp(-1.0, 1.0)
    loss = head.one_step_loss(hidden, th.ones(3, dtype=th.bool), noise)
    th.testing.assert_close(loss, error.square().mean())


def test_the_mean_action_and_the_hidden_state_are_learned_by_the_regression_alone():
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, flow_steps=0)
    assert not head.noise_decides
    nn.init.normal_(head.vector_field.output.weight)
    hidden, actions, mask = th.randn(3, 5, 4, requires_grad=True), th.rand(3, 5, 2), th.ones(3, 5, dtype=th.bool)
    head.loss(hidden, actions, mask, th.randn(3, 5, 2), th.rand(3, 5))[0].backward()
    learned = (hidden, head.regression.linear.weight)
    expected = th.autograd.grad(head.regression.loss(hidden, actions, mask)[0], learned)
    th.testing.assert_close(tuple(each.grad for each in learned), expected)
    assert head.vector_field.output.weight.grad.abs().max() > 0
    assert head(hidden, th.randn(3, 5, 2)).equal(head.regression(hidden))


def test_the_mean_action_needs_a_regression():
    with pytest.raises(ValueError, match=r"flow_steps=0 needs .*regression_coef"):
        FlowHead(embed_dim=4, action_dim=2, flow_steps=0, regression_coef=0.0)


def test_parts_of_the_loss_add_up():
    """Flow, auxiliary regression by its weight, and the one-step network."""
    head = FlowHead(embed_dim=4, action_dim=2, flow_hidden_dim=8, regression_coef=0.5, one_step_policy=True)
    hidden, actions, mask = th.randn(3, 5, 4), th.rand(3, 5, 2), th.ones(3, 5, dtype=th.bool)
    loss, parts = head.loss(hidden, actions, mask, th.randn(3, 5, 2), th.rand(3, 5))
    assert set(parts) == {"flow_loss", "regression_loss", "one_step_loss"}
    th.testing.assert_close(loss, parts["flow_loss"] + 0.5 * parts["regression_loss"] + parts["one_step_loss"])


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_a_flow_head_learns_two_modes_that_regression_would_average(prediction):
    th.manual_seed(0)
    generator = th.Generator().manual_seed(0)
    sizes = dict(embed_dim=4, action_dim=1, flow_hidden_dim=64, flow_n_layers=2)
    head = FlowHead(**sizes, flow_prediction=prediction, one_step_policy=True)
    optimizer = th.optim.Adam(head.parameters(), 3e-3)
    hidden, mask = th.zeros(256, 1, 4), th.ones(256, 1, dtype=th.bool)
    for _ in range(400):
        actions = th.where(th.rand(256, 1, 1, generator=generator) < 0.5, -0.7, 0.7)
        noise, tau = th.randn(256, 1, 1, generator=generator), th.rand(256, 1, generator=generator)
        optimizer.zero_grad()
        head.loss(hidden, actions, mask, noise, tau)[0].backward()
        optimizer.step()
    with th.no_grad():
        samples = head.solve(th.zeros(500, 4), th.randn(500, 1, generator=generator), "euler", 20)
        noise = th.randn(500, 1, generator=generator)
        ends, plain = (head.solve(th.zeros(500, 4), noise, "euler", n_steps) for n_steps in (16, 1))
        jumps = head.one_step_action(th.zeros(500, 4), noise)
    assert ((samples.abs() - 0.7).abs() < 0.2).float().mean() > 0.9
    assert 0.35 < (samples > 0).float().mean() < 0.65
    far = noise.abs() > 0.3  # between the modes the flow is steep
    assert (jumps - ends)[far].abs().mean() < 0.1
    assert (plain - ends)[far].abs().mean() > 0.4
