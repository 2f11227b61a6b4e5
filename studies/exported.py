"""
An action of the exported policy beside one of `predict`, on one thread: `OMP_NUM_THREADS=1 python studies/exported.py`.

Both are asked in turn for the same observations, one environment with a full context, and prints medians in milliseconds:
what `examples/deploy.py` takes with ONNX Runtime, its own bookkeeping included, and what `model.predict` takes.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch as th
from worker import OBSERVATION_DIM, make_model

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from deploy import Policy

# Name: algorithm, width, layers, width of the flow head, tokens a step, context.
SMALL = ("width 128", 128, 3, 128, 1, 5)
PAPER = ("paper's size", 256, 10, 512, 3, 20)
FEW, MANY, ONE = {"flow_steps": 3}, {"flow_steps": 50}, {"flow_solver": "one_step"}
WAYS = [
    (SMALL, "dt", {}),
    (SMALL, "dtfm", FEW),
    (SMALL, "dtfm", {**FEW, "kv_cache": True}),
    (PAPER, "dt", {}),
    (PAPER, "dtfm", MANY),
    (PAPER, "dtfm", {**MANY, "kv_cache": True}),
    (PAPER, "dtfm", ONE),
    (PAPER, "dtfm", {**ONE, "kv_cache": True}),
]
N_ACTIONS = 200


def main() -> None:
    th.set_num_threads(1)
    print("| size | algorithm | way of acting | predict, ms | exported, ms | ratio | difference | export, s | file, MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    rng = np.random.default_rng(0)
    for (size, *numbers), algo, ways in WAYS:
        model = make_model(algo, *numbers, **ways)
        with tempfile.TemporaryDirectory() as folder:
            path, start = Path(folder) / "policy.onnx", time.perf_counter()
            model.export(path)
            seconds, megabytes = time.perf_counter() - start, path.stat().st_size / 1e6
            policy = Policy(str(path))
        times: list[tuple[float, float]] = []
        state, difference = None, 0.0
        for t in range(model.context_length + N_ACTIONS):
            numbers_seen = rng.normal(size=OBSERVATION_DIM).astype(np.float32)
            observation = {"observation": numbers_seen, "return_to_go": np.ones(1, np.float32), "timestep": np.array([t])}
            stamps = [time.perf_counter()]
            expected, state = model.predict(observation, state=state, deterministic=True)
            stamps.append(time.perf_counter())
            found = policy.act(numbers_seen, 1.0, t)
            stamps.append(time.perf_counter())
            times.append((stamps[1] - stamps[0], stamps[2] - stamps[1]))
            difference = max(difference, float(np.abs(found - expected).max()))
        ours, exported = (statistics.median(each) * 1e3 for each in zip(*times[model.context_length :], strict=True))
        how = ", ".join(f"{key} {value}" for key, value in ways.items()) or "window"
        print(
            f"| {size} | {algo.upper()} | {how} | {ours:.2f} | {exported:.2f} | {exported / ours:.2f} "
            f"| {difference:.0e} | {seconds:.0f} | {megabytes:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
