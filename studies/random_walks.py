"""
A goal that no single episode reaches from the start: parts of random walks have to be put together.

Balls are pushed about a maze at random for a while, each from a cell of its own. One that comes upon the goal is rewarded,
and none of those that begin where a model will have to begin gets there.

    python studies/random_walks.py record
    sb3-dtfm benchmark $(python studies/random_walks.py arguments) --seeds 0 1 2 --algo dt dtfm --label plain \
        -params "policy_kwargs:dict(chunk_size=4,dropout=0.0)"
    sb3-dtfm benchmark $(python studies/random_walks.py arguments) --seeds 0 1 2 --algo dtfm --label critic \
        -params "policy_kwargs:dict(chunk_size=4,dropout=0.0,critic_steps=10,expectile=0.9,gamma=0.98,n_action_samples=8)"
    python studies/random_walks.py plot --dt dt.zip --dtfm dtfm.zip
    OMP_NUM_THREADS=1 python studies/random_walks.py cost --dtfm dtfm.zip
"""

import argparse
from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
from mazes import ENV_ID, WALL, Path2D, benchmark_arguments, draw, model_paths
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dtfm import DT, DTFM
from sb3_dtfm.benchmark.evaluation import action_ms, make_seeded_envs
from sb3_dtfm.recording.agent import episode_seeds
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes
from sb3_dtfm.recording.minari import check_dataset_id, write_minari

START, FREE, GOAL = "r", 0, "g"
MAZE = [
    [WALL, WALL, WALL, WALL, WALL],
    [WALL, START, FREE, FREE, WALL],
    [WALL, WALL, WALL, FREE, WALL],
    [WALL, GOAL, FREE, FREE, WALL],
    [WALL, WALL, WALL, WALL, WALL],
]
# Walks begin anywhere.
WALKED = [[START if cell == FREE else cell for cell in row] for row in MAZE]
DATASET_ID = "local/pointmaze/random-walks-v0"
N_STEPS = 50  # of a walk
ENV_KWARGS = {"maze_map": MAZE, "continuing_task": False, "max_episode_steps": 300}  # of an evaluation
N_SAMPLES, N_REPEATS = (1, 8, 32), 5  # of `cost`
TURN = 0.15  # probability with which a walk takes another direction at a step


class RandomWalk:
    """Pushes in one direction for a while, then in another."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng, self._push = rng, np.zeros(2)

    def act(self) -> np.ndarray:
        if not self._push.any() or self._rng.random() < TURN:
            self._push = self._rng.uniform(-1.0, 1.0, 2)
        return np.clip(self._push + self._rng.normal(0.0, 0.2, 2), -1.0, 1.0).astype(np.float32)


def record(n_episodes: int) -> None:
    """Write the dataset, and tell whether a walk from the start reached the goal."""
    check_dataset_id(DATASET_ID, overwrite=True)
    env = gym.make(ENV_ID, maze_map=WALKED, continuing_task=False, max_episode_steps=N_STEPS)
    walks = [RandomWalk(np.random.default_rng(number)) for number in range(n_episodes)]

    def act(observations: dict[str, np.ndarray], _: np.ndarray, numbers: list[int]) -> np.ndarray:
        return np.stack([walks[number].act() for number in numbers])

    episodes = run_episodes([EpisodeRecorder(env)], act, episode_seeds(0, n_episodes))
    dataset = write_minari(DATASET_ID, episodes, env, {"algorithm_name": "pushed at random"})
    walked = [(episode.observations["achieved_goal"], episode.terminations[-1]) for episode in dataset.iterate_episodes()]
    from_start = [reached for path, reached in walked if began_at_start(path)]
    share = np.mean([reached for _, reached in walked])
    print(f"{dataset.id}: {n_episodes} walks, {dataset.total_steps} steps, {share:.0%} come upon the goal;")
    print(f"of the {len(from_start)} that began at the start, {sum(from_start)}")


def plot(models: dict[str, BaseAlgorithm], n_episodes: int, output: Path) -> None:
    """Draw walks that began at the start, and the ways of models."""
    walks = [
        Path2D(episode.observations["achieved_goal"], bool(episode.terminations[-1]))
        for episode in minari.load_dataset(DATASET_ID).iterate_episodes()
        if began_at_start(episode.observations["achieved_goal"])
    ]
    panels = {"walks": walks[:n_episodes]}
    panels |= {name: model_paths(model, ENV_KWARGS, n_episodes) for name, model in models.items()}
    draw(panels, MAZE, {"start": (-1, 1.2), "goal": (-1, -1.4)}, output)


def began_at_start(positions: np.ndarray) -> bool:
    """:param positions: (T + 1, 2)"""
    return bool(positions[0][0] < -0.5 and positions[0][1] > 0.5)


def cost(model: DTFM) -> None:
    """Print the milliseconds of an action by the number of samples that the critic chooses among, in turn."""
    wrapper = {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}
    env = make_seeded_envs(ENV_ID, {"env_wrapper": wrapper, "env_kwargs": ENV_KWARGS}, n_envs=1)
    milliseconds: dict[int, list[float]] = {n: [] for n in N_SAMPLES}
    for seed in range(N_REPEATS):
        for n_action_samples, times in milliseconds.items():
            model.policy.set_acting(n_action_samples=n_action_samples)
            times.append(action_ms(model, env, seed))
    print("| samples | ms an action |\n| --- | --- |")
    for n_action_samples, times in milliseconds.items():
        print(f"| {n_action_samples} | {np.median(times):.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "arguments", "plot", "cost"))
    parser.add_argument("--episodes", type=int, help="1000 to record, 50 to plot by default")
    parser.add_argument("--dt", type=Path, help="a trained DT")
    parser.add_argument("--dtfm", type=Path, help="a trained DTFM with a critic, which is drawn without and with it")
    parser.add_argument("--output", type=Path, default=Path("docs/studies/random-walks.png"))
    options = parser.parse_args()
    if options.what == "record":
        record(options.episodes or 1000)
    elif options.what == "plot":
        alone, best_of_n = DTFM.load(options.dtfm), DTFM.load(options.dtfm)
        alone.policy.set_acting(n_action_samples=1)
        models = {"DT": DT.load(options.dt), "DTFM": alone, "DTFM with critic": best_of_n}
        plot(models, options.episodes or 50, options.output)
    elif options.what == "cost":
        cost(DTFM.load(options.dtfm, device="cpu"))
    else:
        others = ["-n", "2000", "--eval-freq", "1000", "--final-episodes", "100"]
        print(benchmark_arguments(DATASET_ID, ENV_KWARGS, *others))


if __name__ == "__main__":
    main()
