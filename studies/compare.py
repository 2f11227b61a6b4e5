"""
DT and DTFM beside their baseline d3rlpy, in turn on one machine: `make bench`.

Prints docs/performance.md's tables of training and acting: medians over repeats, each in a process of its own, and ratios
of the medians. Baselines come from PyPI in an environment of their own.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch as th
from torch.utils.flop_counter import FlopCounterMode
from worker import BATCH_SIZE, CONTEXT_LENGTH, make_model

HERE = Path(__file__).parent
# Name: width, layers, width of the flow head (512 by default), gradient steps to measure.
SIZES = {
    "width 128, 3 layers, head 256": (128, 3, 256, 15),
    "width 128, 3 layers, head 512": (128, 3, 512, 15),
    "width 256, 10 layers, head 512": (256, 10, 512, 5),
}
N_ACTIONS = 100
TOKENS = (3, 1)
# Name: solver, its steps, keys and values kept, environments, time step of the first action.
ACTING = {
    "50 Euler steps": ("euler", 50, 0, 1, 0),
    "one step": ("one_step", 1, 0, 1, 0),
    "50 Euler steps, kv_cache": ("euler", 50, 1, 1, 0),
    "one step, kv_cache": ("one_step", 1, 1, 1, 0),
    "50 Euler steps, kv_cache, 16 environments": ("euler", 50, 1, 16, 0),
    "one step, kv_cache, 16 environments": ("one_step", 1, 1, 16, 0),
}


def measure(python: str, worker: str, *arguments: object) -> dict[str, float]:
    """One measurement in a fresh process."""
    command = [python, str(HERE / worker), *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def medians(runs: list[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(run[key] for run in runs) for key in runs[0] if not isinstance(runs[0][key], str)}


def matrix_flops(width: int, n_layers: int, flow_hidden_dim: int, tokens_per_step: int) -> float:
    """Floating-point operations of one gradient step's matrix products, counted by torch."""
    model = make_model("dtfm", width, n_layers, flow_hidden_dim, tokens_per_step)
    model.policy.set_training_mode(True)
    generator = th.Generator().manual_seed(0)
    batch = model.buffer.sample(BATCH_SIZE, CONTEXT_LENGTH, generator)
    with FlopCounterMode(display=False) as counter:
        loss, _ = model.compute_loss(batch, *model.policy.network.draw_noise(batch, generator))
        loss.backward()
    return counter.get_total_flops()


def matrix_rate() -> float:
    """Floating-point operations a second of a float32 product large enough to be at the machine's limit."""
    a, b = th.randn(2048, 2048), th.randn(2048, 2048)
    times = []
    for _ in range(15):
        start = time.perf_counter()
        th.mm(a, b)
        times.append(time.perf_counter() - start)
    return 2 * 2048**3 / min(times)


def training_table(baseline_python: str, repeats: int) -> None:
    """DT and DTFM, each with three tokens a step and with one, in turn with the baseline."""
    print(
        "| training | tokens | d3rlpy DT, ms | DT, ms | DTFM, ms | d3rlpy / DT | / DTFM | head | bound, ms | drawing | MiB |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    ours = tuple((algo, tokens) for tokens in TOKENS for algo in ("dt", "dtfm"))
    for name, (*size, n_steps) in SIZES.items():
        baselines, rates = [], []
        runs: dict[tuple[str, int], list[dict[str, float]]] = {each: [] for each in ours}
        for _ in range(repeats):
            rates.append(matrix_rate())
            baselines.append(measure(baseline_python, "d3rlpy_worker.py", "train", *size[:2], n_steps))
            for algo, tokens in ours:
                runs[algo, tokens].append(measure(sys.executable, "worker.py", "train", algo, *size, tokens, n_steps))
        baseline = medians(baselines)
        for tokens in TOKENS:
            dt, dtfm = (medians(runs[algo, tokens]) for algo in ("dt", "dtfm"))
            bound = matrix_flops(*size, tokens) / statistics.median(rates) * 1e3
            print(
                f"| {name} | {tokens} | {baseline['wall_ms']:.0f} | {dt['wall_ms']:.0f} | {dtfm['wall_ms']:.0f} "
                f"| {baseline['wall_ms'] / dt['wall_ms']:.2f} | {baseline['wall_ms'] / dtfm['wall_ms']:.2f} "
                f"| {1 - dt['wall_ms'] / dtfm['wall_ms']:.0%} | {bound:.0f} | {dtfm['sampling_ms'] / dtfm['wall_ms']:.1%} "
                f"| {baseline['peak_mib']:.0f}, {dtfm['peak_mib']:.0f} |",
                flush=True,
            )
    print(
        "\nHead: what DTFM takes longer than DT, as a share of its step. Bound: DTFM's matrix products alone, at the "
        f"{statistics.median(rates) / 1e9:.0f} GFLOP/s of a large float32 product. MiB: peaks of d3rlpy and DTFM.\n"
    )


def acting_table(baseline_python: str, repeats: int) -> None:
    """DTFM's ways of acting, with three tokens a step and with one, in turn with the baseline."""
    print("| acting, width 256, 10 layers | 3 tokens, ms | 1 token, ms | 3 tokens, of d3rlpy's | 1 token, of d3rlpy's |")
    print("| --- | --- | --- | --- | --- |")
    ours = tuple((name, tokens) for name in ACTING for tokens in TOKENS)
    baselines: list[dict[str, float]] = []
    runs: dict[tuple[str, int], list[dict[str, float]]] = {each: [] for each in ours}
    for _ in range(repeats):
        baselines.append(measure(baseline_python, "d3rlpy_worker.py", "act", 256, 10, N_ACTIONS))
        for name, tokens in ours:
            runs[name, tokens].append(
                measure(sys.executable, "worker.py", "act", "dtfm", 256, 10, 512, tokens, N_ACTIONS, *ACTING[name])
            )
    baseline = medians(baselines)["wall_ms"]
    print(f"| d3rlpy DT | {baseline:.1f} | | 1.00 | |")
    for name in ACTING:
        times = [medians(runs[name, tokens])["wall_ms"] for tokens in TOKENS]
        cells = [f"{each:.1f}" for each in times] + [f"{each / baseline:.2f}" for each in times]
        print(f"| {name} | {' | '.join(cells)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--baseline-python", required=True, help="Python of an environment with d3rlpy and the same torch")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=HERE, check=False
    )
    print(f"torch {th.__version__}, {th.get_num_threads()} threads, {platform.processor() or platform.machine()}, ", end="")
    print(
        f"{th.backends.cpu.get_cpu_capability()}, commit {commit.stdout.strip()}, batch {BATCH_SIZE}, K = {CONTEXT_LENGTH}\n"
    )
    training_table(options.baseline_python, options.repeats)
    acting_table(options.baseline_python, options.repeats)


if __name__ == "__main__":
    main()
