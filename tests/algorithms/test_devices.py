"""What a GPU would have to wait for, seen without one."""

import pytest
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sb3_dtfm import DT, DTFM
from tests.algorithms.small import make_model


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
def test_a_gradient_step_makes_nothing_on_the_cpu_for_another_device(algorithm, flow_prediction, cheetah_buffer):
    """A number that moves from the CPU holds the GPU's queue up. PyTorch's "meta" device computes shapes alone."""
    policy_kwargs = {"flow_prediction": flow_prediction} if algorithm is DTFM else {}
    policy = make_model(algorithm, cheetah_buffer, precision="float32", policy_kwargs=policy_kwargs).policy.to("meta")
    policy.set_training_mode(True)
    batch = cheetah_buffer.sample(4, 5, th.Generator().manual_seed(0))
    noise = policy.draw_noise(batch, th.Generator().manual_seed(0))
    batch = type(batch)(*(tensor.to("meta") for tensor in batch))
    noise = [tensor.to("meta") for tensor in noise]
    with OperationsOnTheCpu() as operations:
        loss, _ = policy.compute_loss(batch, *noise)
        loss.backward()
    assert loss.device.type == "meta"
    assert operations.found == []
