"""
Demonstrations of Can of which every second one fails: somebody who lets go of the can on its way, again and again.

    python studies/dropping.py --episodes 100 --output datasets/can_dropped.hdf5

Rewards tell: 1 at the end of a success, none of a failure, which goes on for the task's 400 steps.
"""

import argparse
import functools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from sb3_dtfm.envs.robosuite import RobosuiteEnv
from sb3_dtfm.envs.robosuite.demonstrators import CanDemonstrator, Demonstrator
from sb3_dtfm.recording.episodes import EpisodeRecorder, RecordedEpisode, run_episodes
from sb3_dtfm.recording.robomimic import write_robomimic

TASK = "Can"


class Dropping(CanDemonstrator):
    """Grasps and raises as the packaged script does, and lets go before the can is over the wall between the bins."""

    share_range = (0.1, 0.35)  # of the way aside at which it lets go; the wall is at 0.4

    def reset(self) -> None:
        super().reset()
        self._begun: np.ndarray | None = None
        self._share = self._rng.uniform(*self.share_range)

    def _next_stage_holding(self, hand: np.ndarray, position: np.ndarray, fingers: float) -> str:
        stage = super()._next_stage_holding(hand, position, fingers)
        if stage != "carry":
            self._begun = None
            return stage
        if self._begun is None:
            self._begun = position[:2].copy()
        way = self._place() - self._begun
        done = float((position[:2] - self._begun) @ way / (way @ way))
        return "release" if done > self._share else stage


def episodes(n_episodes: int, seed: int) -> Iterator[RecordedEpisode]:
    """
    Successes and failures in turns, until there are so many; attempts that end otherwise than they should are left out.

    :param n_episodes: of both together
    :param seed: of starts and demonstrators
    """
    env = EpisodeRecorder(RobosuiteEnv(TASK), simulation=True)
    columns = np.cumsum(list(env.unwrapped.observation_keys.values()))[:-1]
    n_done = attempt = 0
    with tqdm(total=n_episodes, unit="episode") as bar:
        while n_done < n_episodes:
            fails = n_done % 2 == 1
            env_seed, own_seed = map(int, np.random.SeedSequence((seed, attempt)).generate_state(2))
            demonstrator: Demonstrator = (Dropping if fails else CanDemonstrator)(own_seed)
            attempt += 1
            episode = next(run_episodes([env], functools.partial(act, demonstrator), [env_seed]))
            if episode.terminated == fails:
                continue
            by_key = [
                dict(zip(env.unwrapped.observation_keys, np.split(each, columns), strict=True))
                for each in episode.observations
            ]
            yield replace(episode, observations=by_key)
            n_done += 1
            bar.update()


def act(demonstrator: Demonstrator, observations: np.ndarray, starts: np.ndarray, numbers: list[int]) -> np.ndarray:
    """Act as :func:`~sb3_dtfm.recording.episodes.run_episodes` asks."""
    return demonstrator.act(observations[0])[None]


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", required=True)
    arguments = parser.parse_args()
    write_robomimic(
        arguments.output, episodes(arguments.episodes, arguments.seed), RobosuiteEnv(TASK).env_args, arguments.seed
    )


if __name__ == "__main__":
    main()
