"""
Two ways to a goal, equally good: demonstrations with two modes, and where trained models go.

A ball has to get round a block, to the left or to the right. The script that demonstrates it tosses a coin, whatever the
ball's position, so the same observation is followed by two actions; their mean leads into the block.

    python studies/two_ways.py record
    sb3-dtfm benchmark $(python studies/two_ways.py arguments) --seeds 0 1 2
    python studies/two_ways.py plot --dt dt.zip --dtfm dtfm.zip --output docs/studies/two-ways.png
"""

import argparse
from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
from mazes import ENV_ID, Path2D, benchmark_arguments, draw, model_paths
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dtfm import DT, DTFM
from sb3_dtfm.recording.agent import episode_seeds
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes
from sb3_dtfm.recording.minari import check_dataset_id, write_minari

ENV_KWARGS = {
    "maze_map": [[1, 1, 1, 1, 1], [1, 0, "g", 0, 1], [1, 0, 1, 0, 1], [1, 0, "r", 0, 1], [1, 1, 1, 1, 1]],
    "continuing_task": False,
    "max_episode_steps": 150,
}
DATASET_ID = "local/pointmaze/two-ways-v0"
WAYPOINTS = [(1, -1), (1, 0), (1, 1)]  # cells to the right and up from the block; the left way is their mirror image
GAIN, DAMPING = 4.0, 0.5  # of the controller, action units per metre and per metre/second
NEAR = 0.35  # metres from a way-point at which the next one is headed for


class Demonstrator:
    """Follows way-points to the goal on the side that a coin decides."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        side = rng.choice((-1, 1))
        self._targets = [np.array([side * x, y], float) for x, y in WAYPOINTS]

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        position, velocity = observation["observation"][:2], observation["observation"][2:]
        while self._targets and np.linalg.norm(self._targets[0] - position) < NEAR:
            self._targets.pop(0)
        target = self._targets[0] if self._targets else observation["desired_goal"]
        wanted = GAIN * (target - position) - DAMPING * velocity + self._rng.normal(0.0, 0.1, 2)
        return np.clip(wanted, -1.0, 1.0).astype(np.float32)


def record(n_episodes: int) -> None:
    """Write the dataset."""
    check_dataset_id(DATASET_ID, overwrite=True)
    env = gym.make(ENV_ID, **ENV_KWARGS)
    demonstrators = [Demonstrator(np.random.default_rng(number)) for number in range(n_episodes)]

    def act(observations: dict[str, np.ndarray], _: np.ndarray, numbers: list[int]) -> np.ndarray:
        return np.stack([demonstrators[n].act({k: v[i] for k, v in observations.items()}) for i, n in enumerate(numbers)])

    metadata = {"algorithm_name": "way-points, left or right at random"}
    episodes = run_episodes([EpisodeRecorder(env)], act, episode_seeds(0, n_episodes))
    dataset = write_minari(DATASET_ID, episodes, env, metadata)
    episodes = list(dataset.iterate_episodes())
    reached = np.mean([episode.terminations[-1] for episode in episodes])
    print(f"{dataset.id}: {n_episodes} episodes, {reached:.0%} reach the goal, {dataset.total_steps} steps")


def plot(models: dict[str, BaseAlgorithm], n_episodes: int, output: Path) -> None:
    """Draw the ways of demonstrations and models, those that did not arrive in red."""
    dataset = minari.load_dataset(DATASET_ID)
    demonstrated = [
        Path2D(episode.observations["achieved_goal"], bool(episode.terminations[-1]))
        for episode in dataset.iterate_episodes(range(n_episodes))
    ]
    panels = {"demonstrations": demonstrated}
    panels |= {name: model_paths(model, ENV_KWARGS, n_episodes) for name, model in models.items()}
    draw(panels, ENV_KWARGS["maze_map"], {"start": (0, -1.42), "goal": (0, 1.3)}, output)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "arguments", "plot"))
    parser.add_argument("--episodes", type=int, help="200 to record, 50 to plot by default")
    parser.add_argument("--dt", type=Path, help="a trained DT")
    parser.add_argument("--dtfm", type=Path, help="a trained DTFM")
    parser.add_argument("--output", type=Path, default=Path("docs/studies/two-ways.png"))
    options = parser.parse_args()
    if options.what == "record":
        record(options.episodes or 200)
    elif options.what == "plot":
        plot({"DT": DT.load(options.dt), "DTFM": DTFM.load(options.dtfm)}, options.episodes or 50, options.output)
    else:
        print(benchmark_arguments(DATASET_ID, ENV_KWARGS, "-n", "1000", "--label", "two-ways"))


if __name__ == "__main__":
    main()
