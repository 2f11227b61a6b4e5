"""Runs that tests/test_distributed.py starts on two processes with torchrun, and compares with a single process."""

import itertools
import sys
import time
from datetime import timedelta
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch as th
import torch.distributed as dist
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.distributed import local_rank_zero_first
from sb3_dtfm.networks import trunk
from sb3_dtfm.networks.layers import dropout
from tests.conftest import PLAIN, TINY_FLOW_POLICY, TINY_POLICY

CHUNKS = {
    "chunk_size": 3,
    "tokens_per_step": 1,
    "film_return_to_go": True,
    "clip_return_to_go": True,
    "regression_coef": 0.5,
}
ALGORITHMS = {
    "DT": (DT, TINY_POLICY),
    "DTFM": (DTFM, {**TINY_FLOW_POLICY, "regression_coef": 0.5}),
    "chunks": (DTFM, {**TINY_FLOW_POLICY, **CHUNKS}),
}
N_STEPS = 12
DOWNLOAD = 4.0  # seconds


def make_buffer() -> TrajectoryBuffer:
    """Episodes of 2 to 12 steps: windows of 8 steps are padded, unlike in each half of a batch."""
    random = np.random.default_rng(0)
    episodes = [
        Trajectory(random.normal(size=(n, 3)), random.uniform(-1, 1, (n, 2)), random.normal(size=n))
        for n in random.integers(2, 13, 30)
    ]
    return TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (2,)))


def make_model(name: str, **kwargs):
    algorithm, settings = ALGORITHMS[name]
    settings = {**settings, "dropout": 0.0, **kwargs.pop("policy_kwargs", {})}
    arguments = {**PLAIN, **dict(batch_size=64, context_length=8, seed=0, learning_rate=1e-3, ema_decay=0.9)}
    arguments |= dict(max_grad_norm=0.5, device="cpu", policy_kwargs=settings)
    return algorithm("MultiInputPolicy", dataset=make_buffer(), **{**arguments, **kwargs})


def train(name: str, folder: Path):
    """A seeded run that logs and saves to a folder."""
    model = make_model(name, tensorboard_log=str(folder))
    model.learn(N_STEPS, log_interval=1)
    model.save(folder / "model")
    return model


class StopAt(BaseCallback):
    """Stops training at a gradient step, and counts its calls."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        return self.num_timesteps < self.step


def run_without_a_seed() -> dict:
    """A process's view of a run with `seed=None`, dropout, and a callback that stops it."""
    model = make_model("DTFM", seed=None, policy_kwargs={"dropout": 0.5})
    drawn, dropped = [], []
    batches = model.buffer.batches

    def recording_batches(*args, **kwargs):
        for batch in batches(*args, **kwargs):
            drawn.append(batch)
            yield batch

    def recording_dropout(tokens, probability, training):
        output = dropout(tokens, probability, training)
        dropped.append(output.detach() == 0)
        return output

    model.buffer.batches = recording_batches
    callback = StopAt(5)
    with patch.object(trunk, "dropout", recording_dropout):
        model.learn(50, callback=callback, log_interval=None)
    return {
        "batches": [tuple(batch) for batch in drawn],
        "dropped": dropped,
        "n_steps": model.num_timesteps,
        "n_calls": callback.n_calls,
        "state": model.policy.state_dict(),
    }


def refusal_of_an_odd_batch() -> str:
    try:
        make_model("DT", batch_size=63)
    except ValueError as error:
        return str(error)
    return ""


def meet_again(meeting_point: Path, **kwargs) -> None:
    """Processes that know each other start anew; other arguments are those of `init_process_group`."""
    rank = dist.get_rank()
    dist.barrier()
    dist.destroy_process_group()
    dist.init_process_group("gloo", store=dist.FileStore(str(meeting_point), 2), rank=rank, world_size=2, **kwargs)


def wait_for_a_slow_download(folder: Path) -> float:
    """
    Process 1 waits for longer than the processes' messages to each other may take.

    :param folder: for what the processes leave there
    :return: seconds waited
    """
    meet_again(folder / "impatient", timeout=timedelta(seconds=DOWNLOAD / 2))
    start = time.monotonic()
    with local_rank_zero_first():
        if dist.get_rank() == 0:
            time.sleep(DOWNLOAD)
    waited = time.monotonic() - start
    meet_again(folder / "patient")
    return waited


def fail_on_process_1(step: int) -> None:
    """Training whose data process 1 can no longer read after some steps; without an end of its own for the others."""
    model = make_model("DT")
    batches = model.buffer.batches

    def failing_batches(*args, **kwargs):
        yield from itertools.islice(batches(*args, **kwargs), step)
        raise RuntimeError("process 1 fails on purpose")

    if dist.get_rank() == 1:
        model.buffer.batches = failing_batches
    model.learn(10**9)


def main(folder: Path) -> None:
    th.set_num_threads(1)
    dist.init_process_group("gloo")
    results = {"odd batch": refusal_of_an_odd_batch(), "without seed": run_without_a_seed()}
    for name in ALGORITHMS:
        model = train(name, folder / name / f"process_{dist.get_rank()}")
        results[name] = model.policy.state_dict()
    th.save(results, folder / f"process_{dist.get_rank()}.pt")
    th.save(wait_for_a_slow_download(folder), folder / f"download_{dist.get_rank()}.pt")
    dist.barrier()
    fail_on_process_1(step=3)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
