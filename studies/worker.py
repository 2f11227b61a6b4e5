"""
Measure DT or DTFM; run by `compare.py`, each measurement in a process of its own.

`python worker.py train MODEL N` or `python worker.py act MODEL N FLOW_SOLVER FLOW_STEPS KV_CACHE N_ENVS FIRST` prints a line
of JSON; MODEL is ALGO WIDTH LAYERS FLOW_HIDDEN_DIM TOKENS_PER_STEP. `python worker.py profile train MODEL N
[PRECISION]` prints the share of the processor's time that each of torch's operations takes in as many steps of training, in
float32 unless said otherwise, and `profile act ...` that of each function.
"""

import cProfile
import functools
import json
import pstats
import resource
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import torch as th
from gymnasium import spaces

import sb3_dtfm
from sb3_dtfm.algorithms import ALGORITHMS, OfflineAlgorithm
from sb3_dtfm.data import Trajectory, TrajectoryBuffer

OBSERVATION_DIM, ACTION_DIM, BATCH_SIZE, CONTEXT_LENGTH = 17, 6, 64, 20
N_SHARES = 20


def make_model(
    algo: str,
    width: int,
    n_layers: int,
    flow_hidden_dim: int,
    tokens_per_step: int,
    context_length: int = CONTEXT_LENGTH,
    precision: str = "auto",
    **policy_kwargs: object,
) -> OfflineAlgorithm:
    """DT or DTFM at its defaults but for the size and what is given."""
    rng = np.random.default_rng(0)
    episodes = [
        Trajectory(rng.normal(size=(1000, OBSERVATION_DIM)), rng.uniform(-1, 1, (1000, ACTION_DIM)), rng.normal(size=1000))
        for _ in range(10)
    ]
    dataset = TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (ACTION_DIM,)))
    sizes = dict(embed_dim=width, n_layers=n_layers, tokens_per_step=tokens_per_step)
    head = dict(flow_hidden_dim=flow_hidden_dim) if algo == "dtfm" else {}
    return ALGORITHMS[algo](
        "MultiInputPolicy",
        dataset=dataset,
        batch_size=BATCH_SIZE,
        context_length=context_length,
        precision=precision,
        policy_kwargs={**sizes, **head, **policy_kwargs},
        device="cpu",
        seed=0,
    )


def train(model: OfflineAlgorithm, n_steps: int) -> dict[str, float]:
    """Median of the time between two steps of `learn`, its sampling included, and the time of the sampling."""
    stamps = []
    model.learn(
        n_steps + 2,
        callback=lambda *_: stamps.append((time.perf_counter(), time.process_time())) is None,
        log_interval=None,
    )
    wall, processor = (statistics.median(column) * 1e3 for column in np.diff(stamps[1:], axis=0).T)
    generator = th.Generator()
    sampling = median_ms(lambda: model.buffer.sample(BATCH_SIZE, CONTEXT_LENGTH, generator), 200)
    return {"wall_ms": wall, "processor_ms": processor, "sampling_ms": sampling}


def act(model: OfflineAlgorithm, n: int, n_envs: int, first: int) -> dict[str, float]:
    """Median time of `predict` with a full context, in episodes seen from time step `first` on."""
    rng = np.random.default_rng(0)
    state, times = None, []
    for t in range(CONTEXT_LENGTH + n):
        observation = {
            "observation": rng.normal(size=(n_envs, OBSERVATION_DIM)).astype(np.float32),
            "return_to_go": np.ones((n_envs, 1), np.float32),
            "timestep": np.full((n_envs, 1), first + t),
        }
        start = time.perf_counter()
        _, state = model.predict(observation, state=state, deterministic=True)
        times.append(time.perf_counter() - start)
    return {"wall_ms": statistics.median(times[CONTEXT_LENGTH:]) * 1e3}


def operations(work: Callable[[], object]) -> dict[str, float]:
    """Measure what torch's operations take, in any unit."""
    with th.profiler.profile(activities=[th.profiler.ProfilerActivity.CPU]) as recorded:
        work()
    return {event.key: event.self_cpu_time_total for event in recorded.key_averages()}


def calls(work: Callable[[], object]) -> dict[str, float]:
    """Measure what functions take by themselves, those of Python and of its libraries."""
    with cProfile.Profile() as recorded:
        work()
    return {name: values[2] for (_, _, name), values in pstats.Stats(recorded).stats.items()}  # type: ignore[attr-defined]


def shares(times: dict[str, float]) -> dict[str, float]:
    """Return shares in percent, the largest first."""
    found = {name: round(100 * time / sum(times.values()), 1) for name, time in times.items()}
    return dict(sorted(found.items(), key=lambda item: -item[1])[:N_SHARES])


def median_ms(function: Callable[[], object], n: int) -> float:
    """Median time of a call in milliseconds."""
    times = []
    for _ in range(n):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


def main() -> None:
    arguments = sys.argv[1:]
    profiled = arguments[0] == "profile"
    what, algo, *numbers = arguments[profiled:]
    *sizes, n = map(int, numbers[:5])
    if what == "train":
        model = make_model(algo, *sizes, precision=(numbers[5:] or ["float32" if profiled else "auto"])[0])
        work = functools.partial(train, model, n)
    else:
        solver, flow_steps, kv_cache, n_envs, first = numbers[5], *map(int, numbers[6:])
        ways = dict(flow_solver=solver, flow_steps=flow_steps, kv_cache=bool(kv_cache))
        model = make_model(algo, *sizes, **ways)
        work = functools.partial(act, model, n, n_envs, first)
    work_profile = operations if what == "train" else calls
    result = shares(work_profile(work)) if profiled else work()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({**result, "peak_mib": peak, "version": sb3_dtfm.__version__, "torch": th.__version__}))


if __name__ == "__main__":
    main()
