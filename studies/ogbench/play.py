"""
OGBench's `play` data sets (Park et al., 2025), recorded anew by the oracles that its wheel brings.

    make ogbench                                                       # the environment, once
    export MUJOCO_GL=disabled OMP_NUM_THREADS=1
    .venv-ogbench/bin/python studies/ogbench/play.py cube-single datasets/ogbench/cube-single-play-v0.npz

The file has the layout of the published ones. Its episodes have 1,001 steps: an oracle follows its plan, with noise, to a
random target, and when it is done another target is drawn. On one kind of processor an episode depends on its number and the
seed alone. Parts lie in a folder beside the file until all are there, and the same command continues after a kill.
"""

# This folder has no __init__.py, so that `import ogbench` finds the package and not the folder.

import argparse
import contextlib
import importlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from sb3_dtfm.files import replacing

EPISODE_STEPS = 1001
NOISE = {"noise": 0.1, "noise_smoothing": 0.5}
# Family: targets that are drawn, and further arguments of their oracles.
FAMILIES: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "cube": (("cube",), {}),
    "scene": (("cube", "button", "drawer", "window"), {}),
    "puzzle": (("button",), {"gripper_always_closed": True}),
}
# Task: range of the probability that a cube is to be put on another one, drawn for each episode.
STACKING = {
    "cube-single": (0.0, 0.0),
    "cube-double": (0.0, 0.25),
    "cube-triple": (0.05, 0.35),
    "cube-quadruple": (0.1, 0.5),
    "cube-octuple": (0.0, 0.35),
}
TYPES = {"terminals": bool, "button_states": np.int64}  # of the arrays that are not float32
COUNTS = ("n_targets", "n_reached")  # what parts hold beside the data set's arrays


class Recorder:
    """
    An environment and its oracles.

    :param task: for example "cube-single"
    :param seed: of all episodes
    """

    def __init__(self, task: str, seed: int) -> None:
        self._task, self._seed = task, seed
        options = {"mode": "data_collection", "terminate_at_goal": False, "max_episode_steps": EPISODE_STEPS}
        self._env = gym.make(f"ogbench:{task}-v0", **options)
        names, arguments = FAMILIES[task.split("-")[0]]
        plans = {name: importlib.import_module(f"ogbench.manipspace.oracles.plan.{name}_plan") for name in names}
        self._oracles = {
            name: getattr(plan, f"{name.title()}PlanOracle")(env=self._env, **NOISE, **arguments)
            for name, plan in plans.items()
        }

    def episode(self, number: int) -> dict[str, np.ndarray]:
        """
        :param number: of the episode
        :return: its arrays, (1001, .) each, and `COUNTS` of the targets whose plan was followed to its end
        """
        episodes = (self._attempt(number, attempt) for attempt in itertools.count())
        return next(recorded for recorded in episodes if not self._task.startswith("scene") or is_visible(recorded["qpos"]))

    def _attempt(self, number: int, attempt: int) -> dict[str, np.ndarray]:
        seed = int(np.random.SeedSequence((self._seed, number, attempt)).generate_state(1)[0])
        np.random.seed(seed)  # noqa: NPY002 - the oracles draw from it
        observation, info = self._env.reset(seed=seed)
        p_stack = np.random.uniform(*STACKING.get(self._task, (0.5, 0.5)))  # noqa: NPY002
        oracle = self._follow(observation, info)
        steps: list[dict[str, Any]] = []
        n_targets = n_reached = 0
        ended = False
        while not ended:
            action = np.clip(oracle.select_action(observation, info), -1.0, 1.0)
            after, _, terminated, truncated, info = self._env.step(action)
            ended = terminated or truncated
            steps.append({"observations": observation, "actions": action, "terminals": ended})
            steps[-1].update((name, info[f"prev_{name}"]) for name in ("qpos", "qvel"))
            if "prev_button_states" in info:
                steps[-1]["button_states"] = info["prev_button_states"]
            observation = after
            if oracle.done:
                n_targets, n_reached = n_targets + 1, n_reached + bool(info["success"])
                oracle = self._follow(*self._env.unwrapped.set_new_target(p_stack=p_stack))
        recorded = {name: np.array([step[name] for step in steps], TYPES.get(name, np.float32)) for name in steps[0]}
        return {**recorded, **dict(zip(COUNTS, map(np.array, (n_targets, n_reached)), strict=True))}

    def _follow(self, observation: np.ndarray, info: dict[str, Any]) -> Any:
        """The oracle for the target that is told of, with a plan."""
        oracle = self._oracles[info["privileged/target_task"]]
        oracle.reset(observation, info)
        return oracle


def is_visible(qpos: np.ndarray) -> bool:
    """
    Return whether the scene's cube stays on the table or in the drawer: the published generator repeats other episodes.

    :param qpos: (T, .) of the scene
    """
    y, z = qpos[:, 15], qpos[:, 16]
    return not ((y >= 0.29) | ((y <= -0.3) & ((z < 0.06) | (z > 0.08)))).any()


def save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write an `.npz` file, which is complete when it is there."""
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, **arrays)


def load(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file."""
    with np.load(path) as archive:
        return dict(archive)


def join(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Episodes one after the other, and the sums of `COUNTS`."""
    return {
        name: np.sum([part[name] for part in parts]) if name in COUNTS else np.concatenate([part[name] for part in parts])
        for name in parts[0]
    }


def describe(arrays: dict[str, np.ndarray]) -> str:
    """Return what can be compared with what is published of a data set."""
    observations, actions = arrays["observations"], arrays["actions"]
    reached, targets = arrays["n_reached"], arrays["n_targets"]
    return (
        f"{arrays['terminals'].sum()} episodes, {len(actions)} steps, observations {observations.shape[1]} in "
        f"[{observations.min():.2f}, {observations.max():.2f}], actions {actions.shape[1]} in "
        f"[{actions.min():.2f}, {actions.max():.2f}], mean {actions.mean(axis=0).round(3)}, std "
        f"{actions.std(axis=0).round(3)}; oracles reached {reached} of {targets} targets ({reached / max(targets, 1):.1%})"
    )


def record(episode: Callable[[int], dict[str, np.ndarray]], n_episodes: int, n_part: int, folder: Path) -> list[Path]:
    """
    Write parts that are not there yet.

    :param episode: from a number to its arrays
    :param n_episodes: in all
    :param n_part: of a part, which a kill can lose
    :param folder: of the parts
    :return: all parts in order
    """
    paths = []
    with tqdm(total=n_episodes, unit=" episodes", mininterval=10) as bar:
        for first in range(0, n_episodes, n_part):
            numbers = range(first, min(first + n_part, n_episodes))
            paths.append(folder / f"{numbers.start:05}-{numbers.stop:05}.npz")
            if not paths[-1].exists():
                episodes = []
                for number in numbers:
                    episodes.append(episode(number))
                    bar.update()
                save(paths[-1], join(episodes))
            bar.update(numbers.stop - bar.n)
    return paths


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="cube-single, scene, puzzle-3x3, ...")
    parser.add_argument("output", type=Path, help=".npz file to write")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    folder = options.output.with_suffix(f".seed{options.seed}.parts")
    paths = record(Recorder(options.task, options.seed).episode, options.episodes, 10, folder)
    arrays = join([load(path) for path in paths])
    print(describe(arrays))
    save(options.output, {name: array for name, array in arrays.items() if name not in COUNTS})
    for path in paths:
        path.unlink()
    with contextlib.suppress(OSError):  # parts of another number of episodes are in it
        folder.rmdir()


if __name__ == "__main__":
    main()
