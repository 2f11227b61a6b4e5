"""A ball in a maze: the ways that models take, and a picture of ways."""

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm.benchmark.evaluation import FINAL_STATES
from sb3_dtfm.envs import OBSERVATION, ReturnToGoWrapper, register_gymnasium_robotics

register_gymnasium_robotics()
ENV_ID = "PointMaze_UMaze-v3"
WALL = 1


class Path2D(NamedTuple):
    """
    :param positions: (T + 1, 2), in metres from the middle of the maze; a cell is one metre wide
    :param arrived: at the goal
    """

    positions: np.ndarray
    arrived: bool


def model_paths(model: BaseAlgorithm, env_kwargs: dict[str, Any], n_episodes: int) -> list[Path2D]:
    """
    The ways of a model that acts deterministically, from the initial states of final evaluations, asked for a return of 1.

    :param env_kwargs: of the environment
    """
    vec_env = DummyVecEnv([lambda: ReturnToGoWrapper(gym.make(ENV_ID, **env_kwargs), target_return=1.0)] * n_episodes)
    vec_env.seed(FINAL_STATES)
    observations: Any = vec_env.reset()
    state, start, arrived = None, np.ones(n_episodes, bool), np.zeros(n_episodes, bool)
    positions: list[list[np.ndarray]] = [[each[:2]] for each in observations[OBSERVATION]]
    running = np.ones(n_episodes, bool)
    while running.any():
        actions, state = model.predict(observations, state, start, deterministic=True)
        observations, _, start, infos = vec_env.step(actions)
        for i in np.flatnonzero(running):
            last = infos[i]["terminal_observation"][OBSERVATION] if start[i] else observations[OBSERVATION][i]
            positions[i].append(last[:2])
            arrived[i] = start[i] and not infos[i]["TimeLimit.truncated"]
        running &= ~start
    return [Path2D(np.array(way), bool(there)) for way, there in zip(positions, arrived, strict=True)]


def draw(
    panels: dict[str, list[Path2D]], maze: list[list[Any]], places: dict[str, tuple[float, float]], output: Path
) -> None:
    """
    A panel beside the other, ways that did not arrive in red.

    :param panels: ways by title
    :param maze: rows of cells from above, those that are `WALL` are grey
    :param places: what is written where, in metres
    :param output: PNG to write
    """
    figure = Figure(figsize=(3.0 * len(panels), 3.3), layout="constrained")
    FigureCanvasAgg(figure)
    height, width = len(maze), len(maze[0])
    for axis, (name, paths) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for path in sorted(paths, key=lambda path: not path.arrived):
            color = "#0072B2" if path.arrived else "#D55E00"
            axis.plot(*path.positions.T, color=color, linewidth=0.9, alpha=0.7, zorder=3 - path.arrived)
        for row, cells in enumerate(maze):
            for column, cell in enumerate(cells):
                if cell == WALL:
                    axis.add_patch(Rectangle((column - width / 2, height / 2 - row - 1), 1, 1, color="0.75", linewidth=0))
        for text, place in places.items():
            axis.text(*place, text, ha="center", color="0.45")
        arrived = sum(path.arrived for path in paths)
        axis.set(title=f"{name}: {arrived} of {len(paths)} arrive", xticks=[], yticks=[], aspect="equal")
        axis.set(xlim=(-width / 2 + 0.8, width / 2 - 0.8), ylim=(-height / 2 + 0.8, height / 2 - 0.8))
        axis.set_frame_on(False)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=150)
    print(output)
