"""
A ball that a planner leads through a maze: the shortest way over the cells, followed by a controller that is not exact.

    python studies/suite/planned.py
"""

import argparse
from collections import deque

import gymnasium as gym
import numpy as np

from sb3_dtfm.envs import register_gymnasium_robotics
from sb3_dtfm.recording.agent import episode_seeds
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes
from sb3_dtfm.recording.minari import check_dataset_id, write_minari

ENV_ID, ENV_KWARGS = "PointMaze_Medium-v3", {"continuing_task": False}
DATASET_ID, N_EPISODES = "local/pointmaze/planned-v0", 100
GAIN, DAMPING, NOISE = 10.0, 1.0, 0.3  # of position errors in metres, of velocities, and of actions in [-1, 1]
ARRIVED = 0.2  # metres from a cell's centre, where the next cell is the one to go to


class Planner:
    """
    Goes from cell to cell along a shortest way.

    :param maze: of the environment
    :param seed: of the noise of actions
    """

    def __init__(self, maze: object, seed: int) -> None:
        self._maze, self._rng = maze, np.random.default_rng(seed)
        self._way: list[np.ndarray] | None = None

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """:return: (2,) in [-1, 1]"""
        position, velocity = observation["observation"][:2], observation["observation"][2:]
        if self._way is None:
            self._way = self._plan(position, observation["desired_goal"])
        while len(self._way) > 1 and np.linalg.norm(self._way[0] - position) < ARRIVED:
            self._way.pop(0)
        action = GAIN * (self._way[0] - position) - DAMPING * velocity + self._rng.normal(0.0, NOISE, 2)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _plan(self, position: np.ndarray, goal: np.ndarray) -> list[np.ndarray]:
        """Centres of the cells on the way, and the goal in the end."""
        maze = self._maze
        start, end = (tuple(maze.cell_xy_to_rowcol(place)) for place in (position, goal))
        came_from, queue = {end: end}, deque([end])
        while queue:
            cell = queue.popleft()
            for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                beside = (cell[0] + step[0], cell[1] + step[1])
                if beside not in came_from and maze.maze_map[beside[0]][beside[1]] != 1:
                    came_from[beside] = cell
                    queue.append(beside)
        cells, cell = [], start
        while cell != end:
            cell = came_from[cell]
            cells.append(cell)
        return [*(maze.cell_rowcol_to_xy(np.array(cell)) for cell in cells[:-1]), goal.copy()]


def main() -> None:
    """Write the dataset."""
    register_gymnasium_robotics()
    check_dataset_id(DATASET_ID, overwrite=True)
    env = gym.make(ENV_ID, **ENV_KWARGS)
    planners = [Planner(env.unwrapped.maze, number) for number in range(N_EPISODES)]

    def act(observations: dict[str, np.ndarray], _: np.ndarray, numbers: list[int]) -> np.ndarray:
        rows = [{key: value[i] for key, value in observations.items()} for i in range(len(numbers))]
        return np.stack([planners[number].act(row) for number, row in zip(numbers, rows, strict=True)])

    episodes = run_episodes([EpisodeRecorder(env)], act, episode_seeds(0, N_EPISODES))
    dataset = write_minari(DATASET_ID, episodes, env, {"algorithm_name": "shortest way, a noisy controller"})
    reached = [episode.terminations[-1] for episode in dataset.iterate_episodes()]
    print(f"{dataset.id}: {len(reached)} episodes, {dataset.total_steps} steps, {np.mean(reached):.0%} reach the goal")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
