"""
Time that a gradient step takes beside its matrix products alone: docs/performance.md's tables. On one core:

    OMP_NUM_THREADS=1 python studies/steps.py defaults             # what the data decide, a minute
    OMP_NUM_THREADS=1 python studies/steps.py sizes                # larger and smaller ones
    OMP_NUM_THREADS=1 python studies/steps.py sizes --before CHECKOUT --d3rlpy .venv-baselines/bin/python
    OMP_NUM_THREADS=1 python studies/steps.py sizes --compile --repeats 1    # beside `compile=True`: a minute or two each
    OMP_NUM_THREADS=1 python studies/steps.py profile              # what defaults and the largest sizes spend their time on

in turn with another version of this package, and with d3rlpy's Decision Transformer of the same width and depth, of which a
step has 64 windows of 20 steps. Every measurement has a process of its own. Products are those that a step computes, of the
same shapes and layouts, one after the other and without anything else.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_dtfm.algorithms import ALGORITHMS, OfflineAlgorithm
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.zoo.registration import policy_of


class Step(NamedTuple):
    """
    Settings of a gradient step.

    :param algo: "dt" or "dtfm"
    :param observation_dim: numbers of an observation
    :param action_dim: numbers of an action
    :param batch_size: windows
    :param context_length: steps of a window
    :param policy_kwargs: the policy's options
    """

    algo: str
    observation_dim: int
    action_dim: int
    batch_size: int
    context_length: int
    policy_kwargs: dict[str, Any]


AGENT = dict(observation_scaling="robust", chunk_size=1, timestep_embedding=False, dropout=0.0)
MEAN = dict(flow_steps=0, regression_coef=1.0)
CONDITIONED = dict(return_conditioning=True, return_range=False)  # which earlier versions always were
UNCONDITIONED = dict(return_conditioning=False, return_range=False)
PEOPLE = dict(UNCONDITIONED, chunk_size=8, timestep_embedding=True, flow_steps=10, regression_coef=0.0)
DEFAULTS: dict[str, Step] = {
    "one agent, DT": Step("dt", 11, 3, 256, 1, {**AGENT, **UNCONDITIONED}),
    "one agent, DTFM": Step("dtfm", 11, 3, 256, 1, {**AGENT, **MEAN, **UNCONDITIONED}),
    "several agents, DTFM": Step("dtfm", 17, 6, 256, 1, {**AGENT, **MEAN}),
    "demonstrations, DTFM": Step("dtfm", 29, 7, 256, 1, dict(PEOPLE, dropout=0.0)),
    "few demonstrations, DTFM": Step("dtfm", 29, 7, 64, 1, dict(PEOPLE, dropout=0.2)),
}
SMALL = dict(
    embed_dim=128, n_layers=3, flow_hidden_dim=128, tokens_per_step=1, chunk_size=1, timestep_embedding=True,
    observation_scaling="robust", flow_steps=3, regression_coef=0.0,
)  # fmt: skip
WIDE = dict(SMALL, flow_hidden_dim=512, dropout=0.1)
PAPER = dict(WIDE, embed_dim=256, n_layers=10)
# Sizes that papers and other libraries use. For a version before 581be92, with other option names, take f478840's steps.py.
SIZES: dict[str, Step] = {
    "width 128 x 3, one step, batch 64": Step("dtfm", 17, 6, 64, 1, dict(SMALL, dropout=0.2)),
    "width 128 x 3, one step, chunks of 8": Step("dtfm", 29, 7, 64, 1, dict(SMALL, dropout=0.0, chunk_size=8)),
    "width 128 x 3, five steps": Step("dtfm", 17, 6, 64, 5, dict(SMALL, dropout=0.0, film_return_to_go=True)),
    "width 128 x 3, one step, batch 256": Step("dtfm", 17, 6, 256, 1, dict(SMALL, dropout=0.2)),
    "width 128 x 3, 20 steps, head 512": Step("dtfm", 17, 6, 64, 20, WIDE),
    "width 128 x 3, 20 steps, head 128": Step("dtfm", 17, 6, 64, 20, dict(WIDE, flow_hidden_dim=128)),
    "width 256 x 10, 20 steps, head 512": Step("dtfm", 17, 6, 64, 20, PAPER),
    "width 256 x 10, 20 steps, three tokens a step": Step("dtfm", 17, 6, 64, 20, dict(PAPER, tokens_per_step=3)),
}
STEPS = {**DEFAULTS, **SIZES}
COLUMNS = {
    "gflop": "GFLOP", "products": "products, ms", "step": "step, ms", "ratio": "step / products",
    "compiled": "compiled, ms", "compiled / now": "/ step", "compiling": "compiling, s",
    "auto": "before, auto, ms", "auto / now": "/ step", "float32": "before, float32, ms", "float32 / now": "/ step",
    "d3rlpy": "d3rlpy's DT, ms", "d3rlpy / now": "/ step",
}  # fmt: skip
HERE = Path(__file__).resolve().parents[1]
PRODUCTS = [getattr(th.ops.aten, name).default for name in ("mm", "addmm", "bmm", "baddbmm")]
# Kinds of operations in a profile, by beginnings of their names in PyTorch.
KINDS = {
    "products": ("mm", "addmm", "bmm", "baddbmm"),
    "copies": ("copy_", "cat", "fill_", "zero_"),
    "activations": ("gelu", "silu", "tanh", "_softmax"),
    "layer norms": ("native_layer_norm",),
    "sums, products and differences of elements": ("add", "sub", "mul", "div", "sum", "mean", "neg"),
    "optimiser and average": ("_fused_adamw", "lerp", "_foreach", "linalg_vector_norm"),
}


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


def make_model(name: str, precision: str = "float32", **options: Any) -> OfflineAlgorithm:
    """A model of random data with nothing left to decide."""
    step = STEPS[name]
    rng = np.random.default_rng(0)
    shapes = (1000, step.observation_dim), (1000, step.action_dim)
    episodes = [
        Trajectory(rng.normal(size=shapes[0]), rng.uniform(-1, 1, shapes[1]), rng.normal(size=1000)) for _ in range(10)
    ]
    dataset = TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (step.action_dim,)))
    known = policy_of(step.algo).parameter_names()
    decided = {key: value for key, value in CONDITIONED.items() if key in known}
    if decided:
        decided["expected_return_steps"] = 0
    given = dict(batch_size=step.batch_size, context_length=step.context_length, return_weighting=0.0, ema_decay=0.999)
    return ALGORITHMS[step.algo](
        "MultiInputPolicy", dataset=dataset, policy_kwargs={**decided, **step.policy_kwargs}, precision=precision,
        device="cpu", seed=0, **given, **options,
    )  # fmt: skip


def measure(name: str, precision: str) -> dict[str, float]:
    """Median processor time of a step of `learn`, and of its products before and after: other jobs slow both."""
    n_steps = 10 if STEPS[name].context_length == 20 else 200
    model = make_model(name, precision)
    with Products() as products:
        model.learn(1, log_interval=None)
    before = products.milliseconds(n_steps // 5)
    stamps: list[float] = []
    model.learn(n_steps + 2, callback=lambda *_: stamps.append(time.process_time()) is None, log_interval=None)
    step = 1e3 * statistics.median(np.diff(stamps[1:]))
    after = products.milliseconds(n_steps // 5)
    return {"step": step, "products": min(before, after), "gflop": products.gflop()}


def measure_compiled(name: str) -> dict[str, float]:
    """Median processor time of a compiled step of `learn`, and seconds until the first one has ended."""
    n_steps = 10 if STEPS[name].context_length == 20 else 200
    model, stamps, start = make_model(name, compile=True), [], time.perf_counter()
    model.learn(n_steps + 2, callback=lambda *_: stamps.append(clocks()) is None, log_interval=None)
    waited, used = np.transpose(stamps)
    return {"compiled": 1e3 * float(np.median(np.diff(used[1:]))), "compiling": waited[0] - start}


def clocks() -> tuple[float, float]:
    """Seconds of the clock and of the processor."""
    return time.perf_counter(), time.process_time()


def profile(name: str) -> dict[str, float]:
    """Shares of a gradient step's processor time by `KINDS`, the first that fits; the rest is everything else."""
    model = make_model(name)
    model.learn(1, log_interval=None)
    with th.profiler.profile(activities=[th.profiler.ProfilerActivity.CPU]) as profiled:
        model.learn(4 if name in SIZES else 50, log_interval=None)
    times = {each.key.removeprefix("aten::"): each.self_cpu_time_total for each in profiled.key_averages()}
    found = dict.fromkeys([*KINDS, "everything else"], 0.0)
    for operation, time_spent in times.items():
        fitting = (kind for kind, beginnings in KINDS.items() if operation.startswith(beginnings))
        found[next(fitting, "everything else")] += time_spent
    return {kind: time_spent / sum(times.values()) for kind, time_spent in found.items()}


def run(name: str, checkout: Path, *options: str) -> dict[str, float]:
    """A measurement in a process of its own."""
    command = [sys.executable, __file__, "one", "--name", name, *options]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def run_d3rlpy(python: Path, step: Step) -> float:
    """Median processor time of a step of d3rlpy's Decision Transformer, milliseconds."""
    size = [str(step.policy_kwargs[key]) for key in ("embed_dim", "n_layers")]
    command = [str(python), str(HERE / "studies" / "d3rlpy_worker.py"), "train", *size, "10"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])["processor_ms"]


def line(name: str, options: argparse.Namespace) -> str:
    """A row of the table: medians of all runs, and of the ratios of runs that were made in turn."""
    found: dict[str, list[float]] = {}

    def keep(**values: float) -> None:
        for key, value in values.items():
            found.setdefault(key, []).append(value)

    for _ in range(options.repeats):
        now = run(name, HERE)
        keep(**now, ratio=now["step"] / now["products"])
        if options.before:
            for precision in ("auto", "float32"):
                before = run(name, options.before.resolve(), "--precision", precision)["step"]
                keep(**{precision: before, f"{precision} / now": before / now["step"]})
        if options.compile:
            compiled = run(name, HERE, "--compile")
            keep(**compiled, **{"compiled / now": compiled["compiled"] / now["step"]})
        if options.d3rlpy and STEPS[name].context_length == 20:
            baseline = run_d3rlpy(options.d3rlpy.absolute(), STEPS[name])
            keep(d3rlpy=baseline, **{"d3rlpy / now": baseline / now["step"]})
    columns = [f"{statistics.median(found[key]):.2f}" if key in found else "-" for key in COLUMNS]
    return f"| {name} | {' | '.join(columns)} |"


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("defaults", "sizes", "profile", "one"))
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    parser.add_argument("--d3rlpy", type=Path, metavar="PYTHON", help="of an environment that has d3rlpy")
    parser.add_argument("--compile", action="store_true", help="compiled steps, too")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--name", help=argparse.SUPPRESS)
    parser.add_argument("--precision", default="float32", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.what == "one":
        one = measure_compiled(options.name) if options.compile else measure(options.name, options.precision)
        print(json.dumps(one))
        return
    if options.what == "profile":
        for name in (*DEFAULTS, *list(SIZES)[-2:]):
            print(f"{name}: " + ", ".join(f"{kind} {share:.0%}" for kind, share in profile(name).items()))
        return
    print(f"| | {' | '.join(COLUMNS.values())} |")
    print("| --- " * (1 + len(COLUMNS)) + "|")
    for name in {"defaults": DEFAULTS, "sizes": SIZES}[options.what]:
        print(line(name, options), flush=True)


if __name__ == "__main__":
    main()
