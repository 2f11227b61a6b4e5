"""
OGBench's single-task data sets: a `play` set with the rewards of a task, as flat arrays for `sb3-dtfm`.

    .venv-ogbench/bin/python studies/ogbench/relabel.py cube-single datasets/ogbench/cube-single-play-v0.npz

writes `cube-single-play-task1-v0.npz` to `task5` beside it. Rewards and masks are those of `ogbench.relabel_utils`: a step
is rewarded by its observation, and is terminal where that solves the task. So each solved step ends an episode, and a file
has more episodes than the `play` set, of 1 to 1,001 steps. The last step of a `play` episode is a time-out.

Episodes are longer than the task's time limit: train with `dataset_kwargs:dict(max_episode_steps=None)`, or most steps are
left out.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from play import load, save

TASKS = range(1, 6)


def flat(arrays: dict[str, np.ndarray], env_id: str) -> dict[str, np.ndarray]:
    """
    :param arrays: of a `play` set, with `rewards` and `masks`
    :param env_id: of the task
    :return: what `load_dataset` reads
    """
    solved = arrays["masks"] == 0.0
    return {
        **{name: arrays[name] for name in ("observations", "actions", "rewards")},
        "terminals": solved,
        "timeouts": arrays["terminals"] & ~solved,
        "success": solved,
        "env_id": np.array(env_id),
    }


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="cube-single, scene, puzzle-3x3, ...")
    parser.add_argument("dataset", type=Path, help="the play set, .npz")
    parser.add_argument("--tasks", type=int, nargs="+", choices=TASKS, default=list(TASKS), metavar="N", help="1 to 5")
    options = parser.parse_args()
    from ogbench.relabel_utils import relabel_dataset  # not needed for --help

    arrays = load(options.dataset)
    for number in options.tasks:
        path = options.dataset.with_name(f"{options.task}-play-task{number}-v0.npz")
        env_id = f"{options.task}-singletask-task{number}-v0"
        relabel_dataset(env_id, gym.make(f"ogbench:{env_id}"), arrays)
        found = flat(arrays, env_id)
        save(path, found)
        solved, reward = found["terminals"].mean(), found["rewards"].mean()
        print(f"{path}: {solved:.2%} of the steps solve the task, mean reward {reward:.3f}")


if __name__ == "__main__":
    main()
