"""
What a gradient step takes beside its matrix products alone: docs/performance.md's table.

    OMP_NUM_THREADS=1 python studies/steps.py                      # on one core, a minute
    OMP_NUM_THREADS=1 python studies/steps.py --before CHECKOUT    # in turn with another version of this package

Every measurement has a process of its own. Products are those that a step computes, of the same shapes and layouts, one
after the other and without anything else.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_dtfm.algorithms import ALGORITHMS, OfflineSequenceAlgorithm
from sb3_dtfm.data import Trajectory, TrajectoryBuffer

AGENT = dict(calm_units=True, chunk_size=1, timestep_embedding=False, dropout=0.0)
MEAN = dict(n_solver_steps=0, regression_coef=1.0)
UNCONDITIONED = dict(return_conditioning=False, return_range=False)
PEOPLE = dict(UNCONDITIONED, chunk_size=8, timestep_embedding=True, n_solver_steps=10, regression_coef=0.0)
PAPER = dict(PEOPLE, chunk_size=1, embed_dim=256, n_layers=10, flow_hidden_dim=512, dropout=0.1)
# Name: algorithm, numbers of an observation and an action, batch, context, the policy's options: what the data decide.
STEPS: dict[str, tuple[str, int, int, int, int, dict[str, Any]]] = {
    "one agent, DT": ("dt", 11, 3, 256, 1, {**AGENT, **UNCONDITIONED}),
    "one agent, DTFM": ("dtfm", 11, 3, 256, 1, {**AGENT, **MEAN, **UNCONDITIONED}),
    "several agents, DTFM": ("dtfm", 17, 6, 256, 1, {**AGENT, **MEAN}),
    "demonstrations, DTFM": ("dtfm", 29, 7, 256, 1, dict(PEOPLE, dropout=0.0)),
    "few demonstrations, DTFM": ("dtfm", 29, 7, 64, 1, dict(PEOPLE, dropout=0.2)),
    "paper's size, one token, DTFM": ("dtfm", 17, 6, 64, 20, PAPER),
    "paper's size, three tokens, DTFM": ("dtfm", 17, 6, 64, 20, dict(PAPER, tokens_per_step=3)),
}
PRODUCTS = [getattr(th.ops.aten, name).default for name in ("mm", "addmm", "bmm", "baddbmm")]


class Products(TorchDispatchMode):
    """Keeps shapes and layouts of all matrix products while it is on."""

    def __init__(self) -> None:
        super().__init__()
        self.factors: list[tuple[th.Tensor, th.Tensor]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in PRODUCTS:
            left, right = [each for each in args if isinstance(each, th.Tensor)][-2:]
            self.factors.append((left.clone(), right.clone()))
        return func(*args, **(kwargs or {}))

    def gflop(self) -> float:
        """Billions of floating-point operations."""
        return sum(2.0 * left.numel() * right.shape[-1] for left, right in self.factors) / 1e9

    def milliseconds(self, n_times: int) -> float:
        """Median time of computing them again."""
        times = []
        for _ in range(n_times):
            start = time.process_time()
            for left, right in self.factors:
                left @ right
            times.append(time.process_time() - start)
        return 1e3 * statistics.median(times)


def make_model(name: str) -> OfflineSequenceAlgorithm:
    """A model of random data with nothing left to decide."""
    algo, observation_dim, action_dim, batch_size, context_length, policy_kwargs = STEPS[name]
    rng = np.random.default_rng(0)
    episodes = [
        Trajectory(rng.normal(size=(1000, observation_dim)), rng.uniform(-1, 1, (1000, action_dim)), rng.normal(size=1000))
        for _ in range(10)
    ]
    dataset = TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (action_dim,)))
    given = dict(batch_size=batch_size, context_length=context_length, return_weight=0.0, return_steps=0)
    return ALGORITHMS[algo](
        "MultiInputPolicy", dataset=dataset, policy_kwargs=policy_kwargs, device="cpu", seed=0, **given
    )  # fmt: skip


def measure(name: str) -> dict[str, float]:
    """Median processor time of a step of `learn`, and of its products before and after: other jobs slow both."""
    n_steps = 10 if name.startswith("paper") else 200
    model = make_model(name)
    with Products() as products:
        model.learn(1, log_interval=None)
    before = products.milliseconds(n_steps // 5)
    stamps: list[float] = []
    model.learn(n_steps + 2, callback=lambda *_: stamps.append(time.process_time()) is None, log_interval=None)
    step = 1e3 * statistics.median(np.diff(stamps[1:]))
    after = products.milliseconds(n_steps // 5)
    return {"step": step, "products": min(before, after), "gflop": products.gflop()}


def run(name: str, checkout: Path) -> dict[str, float]:
    """A measurement in a process of its own."""
    command = [sys.executable, __file__, "--one", name]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one)))
        return
    here = Path(__file__).resolve().parents[1]
    print("| data | GFLOP | products, ms | step, ms | step / products | before, ms | before / now |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in STEPS:
        runs: list[list[dict[str, float]]] = [[], []]
        for _ in range(options.repeats):
            for checkout, found in zip((here, options.before), runs, strict=True):
                if checkout is not None:
                    found.append(run(name, checkout.resolve()))
        now = {key: statistics.median(each[key] for each in runs[0]) for key in runs[0][0]}
        ratio = statistics.median(each["step"] / each["products"] for each in runs[0])
        line = f"| {name} | {now['gflop']:.2f} | {now['products']:.2f} | {now['step']:.2f} | {ratio:.2f} |"
        if runs[1]:
            before = statistics.median(each["step"] for each in runs[1])
            faster = statistics.median(old["step"] / new["step"] for new, old in zip(*runs, strict=True))
            print(f"{line} {before:.2f} | {faster:.2f} |", flush=True)
        else:
            print(f"{line} - | - |", flush=True)


if __name__ == "__main__":
    main()
