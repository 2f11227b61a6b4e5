"""
The ways of acting of one trained DTFM on the same initial states: success, return, and time of an action.

    python benchmarks/samplers.py logs/dtfm/robosuite-Can-v0_1/robosuite-Can-v0.zip --env robosuite/Can-v0 --target-return 1

Prints one line of JSON for each way; `--report FILES` adds up such lines over models and prints a table with 95 % intervals.
"""

import argparse
import json
import statistics
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_dtfm import DTFM
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.zoo.plots import wilson_interval

# Name: solver, its steps, keys and values kept.
WAYS = {
    "50 Euler steps": ("euler", 50, False),
    "10 Euler steps": ("euler", 10, False),
    "1 Euler step": ("euler", 1, False),
    "one step": ("one_step", 1, False),
    "50 Euler steps, kv_cache": ("euler", 50, True),
    "one step, kv_cache": ("one_step", 1, True),
}


def roll_out(model: DTFM, vec_env: VecEnv, n_episodes: int, seed: int) -> dict[str, list[float]]:
    """
    The first episodes of each environment, the same number in all: episodes that end early are not counted more often.

    :return: returns and successes by episode, and seconds by call of `predict`
    """
    per_env = -(-n_episodes // vec_env.num_envs)
    vec_env.seed(seed)
    observations, state, starts = vec_env.reset(), None, np.ones(vec_env.num_envs, bool)
    returns, counts = np.zeros(vec_env.num_envs), np.zeros(vec_env.num_envs, int)
    result: dict[str, list[float]] = {"returns": [], "successes": [], "seconds": []}
    with tqdm(total=per_env * vec_env.num_envs, unit="episode", leave=False) as progress:
        while (counts < per_env).any():
            start = time.perf_counter()
            actions, state = model.predict(observations, state, starts, deterministic=True)
            result["seconds"].append(time.perf_counter() - start)
            observations, rewards, starts, infos = vec_env.step(actions)
            returns += rewards
            for i in np.flatnonzero(starts & (counts < per_env)):
                result["returns"].append(float(returns[i]))
                result["successes"].append(float(infos[i].get("is_success", np.nan)))
                counts[i] += 1
                progress.update()
            returns[starts] = 0.0
    return result


def evaluate(options: argparse.Namespace) -> None:
    wrapper_kwargs = dict(target_return=options.target_return)
    vec_env = make_vec_env(options.env, options.n_envs, wrapper_class=ReturnToGoWrapper, wrapper_kwargs=wrapper_kwargs)
    model = DTFM.load(options.model, device="cpu")
    for way in options.ways:
        solver, n_solver_steps, kv_cache = WAYS[way]
        model.policy.set_solver(solver, n_solver_steps)
        model.policy.kv_cache = kv_cache
        result: dict[str, Any] = roll_out(model, vec_env, options.episodes, options.seed)
        result["ms_per_call"] = 1e3 * statistics.median(result.pop("seconds"))
        print(
            json.dumps({"env": options.env, "model": options.model, "way": way, "seed": options.seed, **result}), flush=True
        )


def report(files: list[str]) -> None:
    cells: dict[tuple[str, str], list[float]] = defaultdict(list)
    for line in (line for file in files for line in Path(file).read_text().splitlines()):
        row = json.loads(line)
        cells[row["env"], row["way"]] += row["successes"]
    print("| task | acting | success | 95 % interval | episodes |\n| --- | --- | --- | --- | --- |")
    for (env, way), successes in cells.items():
        low, high = wilson_interval(int(sum(successes)), len(successes))
        print(f"| {env} | {way} | {np.mean(successes):.1%} | {low:.1%} to {high:.1%} | {len(successes)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", help="saved DTFM")
    parser.add_argument("--env")
    parser.add_argument("--target-return", type=float)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--n-envs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1000, help="of the first initial state")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--report", nargs="+", metavar="FILE")
    options = parser.parse_args()
    if options.report:
        report(options.report)
    else:
        evaluate(options)


if __name__ == "__main__":
    main()
