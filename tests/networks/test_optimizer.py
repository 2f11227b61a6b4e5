"""AdamW over flat tensors is torch's AdamW."""

import copy

import pytest
import torch as th
from torch import nn

from sb3_dtfm.networks.optimizer import FlatAdamW

N_STEPS = 5
# Rounding depends on where in memory a number lies: processors work on several at a time.
RTOL = 1e-5


def make_network() -> nn.Sequential:
    th.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 5), nn.LayerNorm(5), nn.Tanh(), nn.Linear(5, 2))


def make_optimizers(network, unclipped=()):
    """Ours for a network, and torch's for a copy of it."""
    matrices, others = split(network)
    ours = FlatAdamW(matrices, others, [dict(network.named_parameters())[name] for name in unclipped], 1e-2, 0.1)
    reference = copy.deepcopy(network)
    groups = [{"params": each, "weight_decay": decay} for each, decay in zip(split(reference), (0.1, 0.0), strict=True)]
    return ours, reference, th.optim.AdamW(groups, lr=1e-2, fused=True)


def split(network):
    parameters = list(network.parameters())
    return [p for p in parameters if p.dim() == 2], [p for p in parameters if p.dim() == 1]


def backward(network, step):
    x = th.randn(8, 3, generator=th.Generator().manual_seed(step))
    network(x).square().sum().backward()


def same_weights(network, reference):
    pairs = zip(network.parameters(), reference.parameters(), strict=True)
    return all(th.allclose(ours, theirs, rtol=RTOL, atol=0) for ours, theirs in pairs)


def take_steps(ours, network, torchs, reference, n_steps=N_STEPS):
    for step in range(n_steps):
        for optimizer, each in ((ours, network), (torchs, reference)):
            optimizer.zero_grad()
            backward(each, step)
            optimizer.step()


def test_steps_and_state_dict_are_those_of_torch():
    network = make_network()
    ours, reference, torchs = make_optimizers(network)
    take_steps(ours, network, torchs, reference)
    assert same_weights(network, reference)
    mine, theirs = ours.state_dict(), torchs.state_dict()
    assert [group["params"] for group in mine["param_groups"]] == [group["params"] for group in theirs["param_groups"]]
    for number, state in theirs["state"].items():
        assert mine["state"][number].keys() == state.keys()
        for name, value in state.items():
            assert th.allclose(mine["state"][number][name], value, rtol=RTOL, atol=1e-9)
            assert mine["state"][number][name].shape == value.shape


def test_gradients_are_clipped_without_those_that_are_left_alone():
    network = make_network()
    ours, reference, torchs = make_optimizers(network, unclipped=("0.weight", "1.bias"))
    clipped = [parameter for name, parameter in reference.named_parameters() if name not in ("0.weight", "1.bias")]
    for step in range(N_STEPS):
        backward(network, step)
        backward(reference, step)
        norms = ours.clip_gradient(0.1), nn.utils.clip_grad_norm_(clipped, 0.1)
        assert float(norms[0]) == pytest.approx(float(norms[1]), rel=1e-6)
        for mine, theirs in zip(network.parameters(), reference.parameters(), strict=True):
            assert th.allclose(mine.grad, theirs.grad, rtol=1e-4, atol=1e-7)
        ours.step()
        torchs.step()
        ours.zero_grad()
        torchs.zero_grad()
    for mine, theirs in zip(network.parameters(), reference.parameters(), strict=True):
        assert th.allclose(mine, theirs, rtol=RTOL)


def test_a_step_that_is_not_finite_changes_nothing():
    network = make_network()
    ours, reference, _ = make_optimizers(network)
    backward(network, 0)
    network[0].weight.grad[0, 0] = th.nan
    ours.found_inf = th.ones(())
    ours.step()
    assert same_weights(network, reference)
    assert {float(state["step"]) for state in ours.state.values()} == {0.0}


def test_a_gradient_that_is_not_finite_leaves_no_trace_in_the_next_ones():
    """Nor in the memory between those of two parameters, which the norm counts."""
    network = make_network()
    ours, _, _ = make_optimizers(network)
    norms = []
    for wrong in (0.0, th.nan, 0.0):
        ours.zero_grad()
        backward(network, 0)
        network[0].bias.grad[0] += wrong
        norms.append(float(ours.clip_gradient(1.0)))
    assert norms[1] != norms[1]
    assert norms[2] == norms[0]


@pytest.mark.parametrize("change", ["moved", "loaded"])
def test_memory_that_was_replaced_is_laid_out_again(change):
    network = make_network()
    ours, reference, torchs = make_optimizers(network)
    for _ in range(N_STEPS):
        take_steps(ours, network, torchs, reference, n_steps=1)
        if change == "moved":
            for parameter in network.parameters():
                parameter.data = parameter.data.clone()
        else:
            ours.load_state_dict(copy.deepcopy(ours.state_dict()))
    assert same_weights(network, reference)


def test_a_frozen_parameter_stays():
    network = make_network()
    ours, reference, torchs = make_optimizers(network)
    for each in (network, reference):
        each[0].weight.requires_grad_(False)
    for step in range(N_STEPS):
        backward(network, step)
        backward(reference, step)
        ours.clip_gradient(0.1)
        nn.utils.clip_grad_norm_([p for p in reference.parameters() if p.grad is not None], 0.1)
        ours.step()
        torchs.step()
        ours.zero_grad()
        torchs.zero_grad()
    assert same_weights(network, reference)
    for each in (network, reference):
        each[0].weight.requires_grad_(True)
    ours.load_state_dict(copy.deepcopy(ours.state_dict()))
    take_steps(ours, network, torchs, reference)  # the thawed weight has had fewer steps than the others
    assert same_weights(network, reference)


def test_a_network_is_one_tensor_after_a_step():
    network = make_network()
    ours, _, _ = make_optimizers(network)
    backward(network, 0)
    ours.step()
    assert len({parameter.untyped_storage().data_ptr() for parameter in network.parameters()}) == 1
    assert all(parameter.data_ptr() % 64 == 0 for parameter in network.parameters())
    flat = ours.flat_weights()
    assert int(flat.count_nonzero()) == sum(int(parameter.count_nonzero()) for parameter in network.parameters())
    flat.zero_()
    assert not any(parameter.any() for parameter in network.parameters())
