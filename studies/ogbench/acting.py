"""
How many episodes of a task a trained model solves by each way of choosing among its samples.

    PYTHONPATH=studies .venv-ogbench/bin/python studies/ogbench/acting.py model.zip cube-single-singletask-task2-v0 \\
        --samples 1 8 16 32 --temperatures 0 0.3

Initial states are those of final evaluations.
"""

import argparse
import itertools

import torch as th

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="that was trained with a critic")
    parser.add_argument("task", help="id of the environment")
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 8, 16, 32], metavar="N")
    parser.add_argument("--temperatures", type=float, nargs="+", default=[0.0, 0.3], metavar="T")
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args()
    import ogbench  # noqa: F401  (registers the tasks)

    th.set_num_threads(1)
    model = DTFM.load(options.model, device="cpu")
    settings = {"env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 0.0}}]}
    print("| samples | temperature | solved | of | mean length |\n| --- | --- | --- | --- | --- |")
    for n, temperature in itertools.product(options.samples, options.temperatures):
        if n == 1 and temperature:
            continue  # there is nothing to choose among
        model.policy.set_acting(n_action_samples=n, temperature=temperature)
        envs = make_seeded_envs(options.task, settings, 10)
        found = evaluate(model, envs, range(FINAL_STATES, FINAL_STATES + options.episodes))
        envs.close()
        length = sum(found.lengths) / options.episodes
        print(f"| {n} | {temperature} | {sum(found.successes or [])} | {options.episodes} | {length:.0f} |", flush=True)


if __name__ == "__main__":
    main()
