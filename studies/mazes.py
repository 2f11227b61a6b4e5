"""A ball in a maze: the ways that models take, a picture of ways, and what the benchmark is told."""

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dtfm.benchmark.evaluation import FINAL_STATES
from sb3_dtfm.envs import ReturnToGoWrapper, register_gymnasium_robotics
from sb3_dtfm.recording.agent import agent_actions
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes

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
    The ways of a model that acts deterministically, from the initial states of final evaluations, with a target return of 1.

    :param env_kwargs: of the environment
    """
    envs = [ReturnToGoWrapper(EpisodeRecorder(gym.make(ENV_ID, **env_kwargs)), target_return=1.0) for _ in range(n_episodes)]
    seeds = range(FINAL_STATES, FINAL_STATES + n_episodes)
    episodes = run_episodes(envs, agent_actions(model, None, deterministic=True), seeds)
    return [
        Path2D(np.array([each["achieved_goal"] for each in episode.observations]), episode.terminated)
        for episode in episodes
    ]


def benchmark_arguments(dataset_id: str, env_kwargs: dict[str, Any], *others: str) -> str:
    """Arguments of `sb3-dtfm benchmark` for a maze and its demonstrations, with a target return of 1."""
    words = [f"{key}:{value!r}".replace(" ", "") for key, value in env_kwargs.items()]
    data = ["--dataset", f"{ENV_ID}={dataset_id}", "--target-return", "1", "--fractions", "1.0"]
    return " ".join([*data, *others, "--env-kwargs", *words])


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
