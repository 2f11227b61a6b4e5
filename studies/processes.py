"""
How many gradient steps a second two processes of one thread make beside one process of two threads.

    python studies/processes.py --dataset local/halfcheetah/expert-v0

By `sb3-dtfm train`, in turn, both with 64 windows a step: the small profile of HalfCheetah, and a trunk of 10 layers of 256 with
a head of 512 and a context of 20. Prints a row for each size: the rates of all rounds.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile

N_ROUNDS = 3
RATE = re.compile(r"steps_per_second\s*\|\s*([\d.]+)")
LARGE = "policy_kwargs:dict(embed_dim=256,n_layers=10,flow_hidden_dim=512)"
# Of each size, the gradient steps of a run and what `sb3-dtfm train` is told beside them.
SIZES = {
    "small profile": (1000, []),
    "width 256, context 20": (60, ["-params", "context_length:20", LARGE]),
}
WAYS = {
    "one process of two threads": ("2", ["-m", "sb3_dtfm"]),
    "two processes of one thread": ("1", ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "sb3_dtfm"]),
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
    training = ["train", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--conf-file", "small", "--dataset", dataset]
    training += ["-n", str(n_steps), "--log-interval", str(n_steps // 2), "--eval-freq", "-1", *settings]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, *start, *training, "-f", folder]
        environment = {**os.environ, "OMP_NUM_THREADS": n_threads}
        output = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    return float(RATE.findall(output)[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", required=True)
    dataset = parser.parse_args().dataset
    print(f"| steps a second | {' | '.join(WAYS)} |\n| --- | --- | --- |")
    for size in SIZES:
        rounds = [[rate(way, size, dataset) for way in WAYS] for _ in range(N_ROUNDS)]
        rates = ("; ".join(f"{value:.1f}" for value in values) for values in zip(*rounds, strict=True))
        print(f"| {size} | {' | '.join(rates)} |", flush=True)


if __name__ == "__main__":
    main()
