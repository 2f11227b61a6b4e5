"""A lack of memory raises an error that says what to lower."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm import DT
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from tests.algorithms.small import make_model

NAMED = r"batch_size=(\d+), context_length=5, chunk_size=1, embed_dim=32, n_layers=2"


def test_a_batch_larger_than_any_memory_is_named(cheetah_buffer):
    """Before any of it is taken: an operating system may grant it, and end the process when it is used."""
    model = make_model(DT, cheetah_buffer, batch_size=10**9)
    with pytest.raises(MemoryError, match=rf"takes at least 15,820.0 GB, and cpu has [\d.,]+: {NAMED}. Lower batch_size"):
        model.learn(1)


def test_a_batch_of_few_numbers_is_refused_for_what_the_network_keeps():
    """16 bytes a step of data, which this machine may have, and 16 for each of two blocks' 32 channels and three tokens."""
    episode = Trajectory(np.random.default_rng(0).normal(size=(9, 3)), np.zeros((9, 1)), np.ones(9))
    buffer = TrajectoryBuffer.from_trajectories([episode], spaces.Box(-1.0, 1.0, (1,)))
    model = make_model(DT, buffer, batch_size=10**9, context_length=1)
    with pytest.raises(MemoryError, match=r"takes at least 3,088.0 GB, and cpu has"):
        model.learn(1)


OUT_OF_MEMORY = [
    th.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
    RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 8 bytes."),
    RuntimeError("CUDA error: out of memory"),
    MemoryError("Unable to allocate 711. PiB"),
]


@pytest.mark.parametrize("error", OUT_OF_MEMORY)
def test_any_error_of_memory_is_named_and_leaves_the_weights_alone(error, cheetah_buffer, monkeypatch):
    model = make_model(DT, cheetah_buffer).learn(1)
    before = {name: weight.clone() for name, weight in model.policy.state_dict().items()}

    def fail(*args):
        raise error

    monkeypatch.setattr(model, "compute_loss", fail)
    with pytest.raises(MemoryError, match=NAMED) as caught:
        model.learn(1)
    assert caught.value.__cause__ is error
    assert all(th.equal(weight, before[name]) for name, weight in model.policy.state_dict().items())


def test_other_errors_stay_what_they_are(cheetah_buffer, monkeypatch):
    model = make_model(DT, cheetah_buffer)
    error = RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    def fail(*args):
        raise error

    monkeypatch.setattr(model, "compute_loss", fail)
    with pytest.raises(RuntimeError) as caught:
        model.learn(1)
    assert caught.value is error
