"""
Gradient steps a second that one process makes with a thread and with two, and two processes with a thread each.

    python studies/processes.py --dataset local/halfcheetah/expert-v0

By `sb3-dtfm train`, in turn, all with 64 windows a step: a small network of width 128, and the paper's Transformer and head.
Prints a row for each size: the rates of all rounds.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile

N_ROUNDS = 3
RATE = re.compile(r"steps_per_second\s*\|\s*([\d.]+)")
TRAINING = ["train", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--eval-freq", "-1"]
# Gradient steps of a run and other arguments of `sb3-dtfm train`, by size.
SIZES = {
    "width 128": (300, []),
    "paper's size": (
        12,
        ["-params", "context_length:20", "policy_kwargs:dict(embed_dim=256, n_layers=10, flow_hidden_dim=512)"],
    ),
}
ONE = ["-m", "sb3_dtfm"]
TWO = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *ONE]
# `OMP_NUM_THREADS` and Python's arguments, by way.
WAYS = {
    "one process, one thread": ("1", ONE),
    "one process, two threads": ("2", ONE),
    "two processes, one thread each": ("1", TWO),
}


def rate(way: str, size: str, dataset: str) -> float:
    """
    Gradient steps a second of one run, by its last logged row.

    :param way: a key of `WAYS`
    :param size: a key of `SIZES`
    :param dataset: of HalfCheetah
    """
    n_threads, start = WAYS[way]
    n_steps, settings = SIZES[size]
    steps = ["-n", str(n_steps), "--log-interval", str(n_steps // 2)]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, *start, *TRAINING, *steps, "--dataset", dataset, *settings, "-f", folder]
        output = subprocess.run(
            command, env={**os.environ, "OMP_NUM_THREADS": n_threads}, check=True, stdout=subprocess.PIPE, text=True
        ).stdout
    return float(RATE.findall(output)[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", required=True)
    dataset = parser.parse_args().dataset
    print(f"| steps a second | {' | '.join(WAYS)} |\n| {' | '.join(['---'] * (1 + len(WAYS)))} |")
    for size in SIZES:
        rounds = [[rate(way, size, dataset) for way in WAYS] for _ in range(N_ROUNDS)]
        rates = ("; ".join(f"{value:.1f}" for value in values) for values in zip(*rounds, strict=True))
        print(f"| {size} | {' | '.join(rates)} |", flush=True)


if __name__ == "__main__":
    main()
