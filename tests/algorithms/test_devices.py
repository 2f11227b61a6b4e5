"""Waits between a GPU and its host, found without a GPU."""

import time

import pytest
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sb3_dtfm import DT, DTFM
from sb3_dtfm.optimization import RunningMeans
from tests.algorithms.small import make_model, record_curves


class OperationsOnTheCpu(TorchDispatchMode):
    """Remembers the operations that give a tensor on the CPU."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        output = func(*args, **(kwargs or {}))
        if any(isinstance(leaf, th.Tensor) and leaf.device.type == "cpu" for leaf in tree_leaves(output)):
            self.found.append(str(func))
        return output


@pytest.mark.parametrize("algorithm", [DT, DTFM])
@pytest.mark.parametrize("flow_prediction", ["velocity", "action"])
@pytest.mark.parametrize("tokens_per_step", [3, 1])
def test_a_gradient_step_makes_nothing_on_the_cpu_for_another_device(
    algorithm, flow_prediction, tokens_per_step, cheetah_buffer
):
    """A number that moves from the CPU holds the GPU's queue up. PyTorch's "meta" device computes shapes alone."""
    policy_kwargs = {"flow_prediction": flow_prediction} if algorithm is DTFM else {}
    policy_kwargs["tokens_per_step"] = tokens_per_step
    model = make_model(algorithm, cheetah_buffer, precision="float32", policy_kwargs=policy_kwargs)
    policy = model.policy.to("meta")
    policy.set_training_mode(True)
    batch = cheetah_buffer.sample(4, 5, th.Generator().manual_seed(0))
    noise = policy.network.draw_noise(batch, th.Generator().manual_seed(0))
    batch = type(batch)(*(tensor.to("meta") for tensor in batch))
    noise = [tensor.to("meta") for tensor in noise]
    with OperationsOnTheCpu() as operations:
        loss, _ = model.compute_loss(batch, *noise)
        loss.backward()
    assert loss.device.type == "meta"
    assert operations.found == []


def test_waiting_for_a_gpu_counts_as_training_time(cheetah_buffer, monkeypatch):
    """Its steps have only been asked for when the loop is through with them: it is at the means that they are waited for."""
    wait, pop = 0.5, RunningMeans.pop
    monkeypatch.setattr(RunningMeans, "pop", lambda means: time.sleep(wait) or pop(means))
    model = make_model(DT, cheetah_buffer)
    curves = record_curves(model)
    model.learn(4, log_interval=2)
    rates = [rate for _, rate in curves.points["time/steps_per_second"]]
    assert len(rates) == 2
    assert all(0.0 < rate < 2 / wait for rate in rates)
