"""
How well a policy of `scene-play` grasps: how often its gripper goes down to the table at the cube and elsewhere, and how
often the cube is lifted.

    .venv-ogbench/bin/python studies/ogbench/grasps.py MODEL [MODEL ...] --acting n_action_samples:1

prints a line for each model. Initial states are those of the final episodes of `sb3-dtfm benchmark`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch as th

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.zoo.arguments import key_values

# Metres: the gripper is down below the first, at the cube within the second; a cube above the third is lifted.
DOWN, AT_CUBE, LIFTED = 0.035, 0.03, 0.06


class Counts(NamedTuple):
    """Over all episodes."""

    at_cube: int
    elsewhere: int
    lifts: int


def begins(states: np.ndarray) -> int:
    """
    :param states: (T, n) bool, of n episodes
    :return: how often one becomes true
    """
    return int((states[1:] & ~states[:-1]).sum())


def count(grippers: np.ndarray, cubes: np.ndarray) -> Counts:
    """
    :param grippers: positions (T, n, 3), metres
    :param cubes: positions (T, n, 3), metres
    """
    distances = np.linalg.norm(grippers - cubes, axis=2)
    down, on_table = grippers[..., 2] < DOWN, cubes[..., 2] < LIFTED / 2
    elsewhere = down & (distances > 1.5 * AT_CUBE) & on_table
    return Counts(begins(down & (distances < AT_CUBE)), begins(elsewhere), begins(cubes[..., 2] > LIFTED))


def act(model: DTFM, env_id: str, n_episodes: int, n_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """
    :param model: whose policy acts
    :return: positions of the gripper and of the cube, (T, n, 3), metres; an episode that has ended stays where it is
    """
    envs = [ReturnToGoWrapper(gym.make(env_id), target_return=0.0) for _ in range(n_episodes)]
    observations = [env.reset(seed=FINAL_STATES + number)[0] for number, env in enumerate(envs)]
    state, start, ended = None, np.ones(n_episodes, bool), np.zeros(n_episodes, bool)
    grippers, cubes = [], []
    for _ in range(n_steps):
        batch = {name: np.stack([each[name] for each in observations]) for name in observations[0]}
        actions, state = model.predict(batch, state, start, deterministic=True)
        start = np.zeros(n_episodes, bool)
        for number in np.flatnonzero(~ended):
            observations[number], _, terminated, truncated, _ = envs[number].step(actions[number])
            ended[number] = terminated or truncated
        infos = [env.unwrapped.compute_ob_info() for env in envs]
        grippers.append([info["proprio/effector_pos"] for info in infos])
        cubes.append([info["privileged/block_0_pos"] for info in infos])
    return np.array(grippers), np.array(cubes)


def main(arguments: Sequence[str] | None = None) -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL")
    parser.add_argument("--env", default="scene-singletask-task3-v0")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--steps", type=int, default=500, help="of each episode")
    parser.add_argument("--acting", nargs="+", default=["n_action_samples:1"], help="as in sb3-dtfm sweep")
    options = parser.parse_args(arguments)
    import ogbench  # noqa: F401  # registers the tasks, not needed for --help

    th.set_num_threads(1)
    for path in options.models:
        model = DTFM.load(path, device="cpu")
        model.policy.set_acting(**key_values("--acting", options.acting))
        found = count(*act(model, options.env, options.episodes, options.steps))
        print(
            f"{path}: down at the cube {found.at_cube} times, elsewhere {found.elsewhere}; {found.lifts} lifts", flush=True
        )


if __name__ == "__main__":
    main()
