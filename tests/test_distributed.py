"""Several processes train what one would: started with torchrun, as a user starts them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch as th
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.distributed_runs import ALGORITHMS, DOWNLOAD, N_STEPS, train

ROOT = Path(__file__).parents[1]
LIMIT = 180  # seconds after which two processes that wait for each other are taken as hanging


def torchrun(*arguments: str, **kwargs) -> subprocess.CompletedProcess:
    """Two processes on this machine."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *arguments]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT, **kwargs)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder that two processes wrote to, how they ended, and what each of them saw."""
    folder = tmp_path_factory.mktemp("two_processes")
    process = torchrun("-m", "tests.distributed_runs", str(folder))
    files = [folder / f"process_{rank}.pt" for rank in range(2)]
    assert all(file.is_file() for file in files), process.stderr
    return folder, process, [th.load(file) for file in files]


def curves(folder: Path) -> dict[str, list[float]]:
    """All curves of a TensorBoard log but the times."""
    events = EventAccumulator(str(next(folder.glob("*_1")))).Reload()
    return {
        tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"] if tag.startswith("train/")
    }


def all_equal(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> bool:
    return all(th.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_two_processes_log_and_learn_what_one_does(name, finished, tmp_path):
    """Halves of a batch that differ in padding; the loss, its parts, the gradient's norm and the moving average."""
    folder, _, (first, second) = finished
    model = train(name, tmp_path)
    expected, found = curves(tmp_path), curves(folder / name / "process_0")
    assert {"train/loss", "train/regression_loss", "train/grad_norm", "train/action_mse"} <= set(expected)
    assert found.keys() == expected.keys()
    for tag, values in expected.items():
        assert len(values) == N_STEPS
        assert found[tag] == pytest.approx(values, rel=1e-4), tag
    assert all_equal(first[name], second[name])
    for key, tensor in model.policy.state_dict().items():
        assert th.allclose(first[name][key], tensor, atol=1e-5), key


@pytest.mark.parametrize("name", ALGORITHMS)
def test_only_process_0_writes(name, finished):
    assert [path.name for path in (finished[0] / name).iterdir()] == ["process_0"]


def test_without_a_seed_processes_share_batches_and_weights_but_not_dropout(finished):
    first, second = (seen["without seed"] for seen in finished[2])
    assert len(first["batches"]) >= 5
    assert len(first["dropped"]) > 0
    assert not th.equal(first["batches"][0][0], first["batches"][1][0])
    for ours, theirs in zip(first["batches"], second["batches"], strict=True):
        assert all(th.equal(*tensors) for tensors in zip(ours, theirs, strict=True))
    assert all_equal(first["state"], second["state"])
    assert not any(th.equal(ours, theirs) for ours, theirs in zip(first["dropped"], second["dropped"], strict=True))


def test_a_callback_runs_on_process_0_and_stops_all(finished):
    assert [(seen["without seed"]["n_steps"], seen["without seed"]["n_calls"]) for seen in finished[2]] == [(5, 5), (5, 0)]


def test_a_batch_that_cannot_be_shared_is_refused(finished):
    for seen in finished[2]:
        assert "batch_size=63 and 2 processes" in seen["odd batch"]


def test_a_download_may_take_longer_than_a_message(finished):
    """Process 1 waits for process 0 however long it takes."""
    folder, process, _ = finished
    waits = [folder / f"download_{rank}.pt" for rank in range(2)]
    assert all(file.is_file() for file in waits), process.stderr
    assert all(th.load(file) > 0.9 * DOWNLOAD for file in waits)


def test_a_process_that_fails_ends_all(finished):
    assert finished[1].returncode != 0
    assert "process 1 fails on purpose" in finished[1].stderr
