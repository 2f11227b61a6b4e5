"""
The ways of acting of one trained DTFM on the same initial states: success and return.

    python studies/samplers.py logs/dtfm/robosuite-Can-v0_1/robosuite-Can-v0.zip --env robosuite/Can-v0 --target-return 1

Prints one line of JSON for each way; `--report FILES` adds up such lines over models and prints a table with 95 % intervals.
"""

import argparse
import json
from collections import defaultdict
from itertools import product
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import evaluate, make_seeded_envs
from sb3_dtfm.benchmark.report.statistics import wilson
from sb3_dtfm.zoo.arguments import WRAPPER

# Name: solver, its steps, keys and values kept.
WAYS = {
    "50 Euler steps": ("euler", 50, False),
    "10 Euler steps": ("euler", 10, False),
    "5 Heun steps": ("heun", 5, False),
    "3 Euler steps": ("euler", 3, False),
    "1 Euler step": ("euler", 1, False),
    "one step": ("one_step", 1, False),
    "50 Euler steps, kv_cache": ("euler", 50, True),
    "one step, kv_cache": ("one_step", 1, True),
}


def evaluate_ways(options: argparse.Namespace) -> None:
    """One line of JSON for each way of acting, on the same initial states."""
    settings = {"env_wrapper": [{WRAPPER: {"target_return": options.target_return}}]}
    vec_env = make_seeded_envs(options.env, settings, options.n_envs)
    model = DTFM.load(options.model, device="cpu")
    seeds = range(options.seed, options.seed + options.episodes)
    noise = model.policy.noise_table.clone()
    for way, deviation in product(options.ways, options.noise_std):
        solver, flow_steps, kv_cache = WAYS[way]
        model.policy.set_acting(flow_solver=solver, flow_steps=flow_steps, kv_cache=kv_cache)
        model.policy.noise_table.copy_(deviation * noise)
        with tqdm(total=options.episodes, unit="episode", leave=False, disable=None) as progress:
            episodes = evaluate(model, vec_env, seeds, lambda n_done, bar=progress: bar.update(n_done - bar.n))
        name = f"{way}, noise {deviation:g}"
        print(json.dumps({"env": options.env, "model": options.model, "way": name, **episodes._asdict()}), flush=True)


def report(files: list[str]) -> None:
    """Success where the task has it, else returns; episodes of all models of a task together."""
    grouped: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: {"returns": [], "successes": []})
    for line in (line for file in files for line in Path(file).read_text().splitlines()):
        row = json.loads(line)
        for key, values in grouped[row["env"], row["way"]].items():
            values += row[key] or []
    print("| task | acting | success or mean return | 95 % interval, or standard deviation | episodes |")
    print("| --- | --- | --- | --- | --- |")
    for (env, way), values in grouped.items():
        returns, successes = values["returns"], values["successes"]
        if successes:
            _, low, high = wilson(int(sum(successes)), len(successes))
            result = f"{np.mean(successes):.1%} | {low:.1%} to {high:.1%}"
        else:
            result = f"{np.mean(returns):,.0f} | {np.std(returns):,.0f}"
        print(f"| {env} | {way} | {result} | {len(returns)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", help="saved DTFM")
    parser.add_argument("--env")
    parser.add_argument("--target-return", type=float)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--n-envs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1000, help="of the first initial state")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--noise-std", type=float, nargs="+", default=[1.0], help="of deterministic acting")
    parser.add_argument("--report", nargs="+", metavar="FILE")
    options = parser.parse_args()
    if options.report:
        report(options.report)
    else:
        evaluate_ways(options)


if __name__ == "__main__":
    main()
