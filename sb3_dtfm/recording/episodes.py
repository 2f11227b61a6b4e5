"""Running episodes side by side and keeping what happened in them."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from minari.data_collector import EpisodeBuffer
from tqdm import tqdm

# (batched observations, episode starts (n_envs,), episode numbers (n_envs,)) -> actions (n_envs, A)
ActFunction = Callable[[Any, np.ndarray, list[int]], np.ndarray]


@dataclass
class RecordedEpisode:
    """
    One episode while it runs and when it is complete.

    :param seed: what the environment was reset with
    :param observations: T + 1 entries
    :param actions: T arrays (A,)
    :param rewards: (T,) float64, environment reward units
    :param terminated: ended in a terminal state
    :param truncated: ended at a time limit
    """

    seed: int
    observations: list[Any]
    actions: list[np.ndarray] = field(default_factory=list)
    reward_list: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False

    @property
    def rewards(self) -> np.ndarray:
        return np.asarray(self.reward_list, dtype=np.float64)

    def to_buffer(self) -> EpisodeBuffer:
        n_steps = len(self.actions)
        ends = np.zeros((2, n_steps), dtype=bool)
        ends[:, -1] = self.terminated, self.truncated
        return EpisodeBuffer(
            seed=self.seed,
            observations=stack_observations(self.observations),
            actions=np.stack(self.actions),
            rewards=self.rewards,
            terminations=ends[0],
            truncations=ends[1],
        )


def check_recording(n_episodes: int, noise: float) -> None:
    """
    Refuse numbers out of range that every recording has.

    :param n_episodes: episodes to record
    :param noise: standard deviation of action noise, as a share of the action range
    :raises ValueError: names the argument, what was given and what is accepted
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}.")
    if not 0.0 <= noise < np.inf:
        raise ValueError(f"noise must be a share of the action range, 0 or more, got {noise}.")


def stack_observations(observations: Sequence[Any]) -> Any:
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)


def run_episodes(envs: Sequence[gym.Env], act: ActFunction, n_episodes: int, seed: int) -> Iterator[RecordedEpisode]:
    """
    Episodes 0 to n - 1 in their order, run side by side.

    An environment that finishes takes the next episode. Once none is left it stands still, and its row of the batch is
    ignored, so that an agent with memory sees the same rows throughout.

    :param envs: environments of one kind
    :param act: chooses the actions
    :param n_episodes: n
    :param seed: seed that the episodes' seeds are drawn from
    """
    seeds = [int(number) for number in np.random.default_rng(seed).integers(2**31, size=n_episodes)]
    n_rows = min(len(envs), n_episodes)
    numbers = list(range(n_rows))
    running = [start(envs[row], seeds[row]) for row in range(n_rows)]
    starts = np.ones(n_rows, dtype=bool)
    active = np.ones(n_rows, dtype=bool)
    finished: dict[int, RecordedEpisode] = {}
    n_started, n_yielded = n_rows, 0
    while active.any():
        actions = act(stack_observations([episode.observations[-1] for episode in running]), starts, numbers)
        starts[:] = False
        for row in np.flatnonzero(active):
            if not step(envs[row], running[row], actions[row]):
                continue
            finished[numbers[row]] = running[row]
            if n_started == n_episodes:
                active[row] = False
                continue
            running[row] = start(envs[row], seeds[n_started])
            numbers[row], starts[row] = n_started, True
            n_started += 1
        while n_yielded in finished:
            yield finished.pop(n_yielded)
            n_yielded += 1


def start(env: gym.Env, seed: int) -> RecordedEpisode:
    """Reset the environment and record its first observation."""
    return RecordedEpisode(seed, [copy.deepcopy(env.reset(seed=seed)[0])])


def step(env: gym.Env, episode: RecordedEpisode, action: np.ndarray) -> bool:
    """Execute and record one action. True if the episode is over."""
    episode.actions.append(action.copy())
    observation, reward, terminated, truncated, _ = env.step(action)
    # An environment may hand out the same array at every step.
    episode.observations.append(copy.deepcopy(observation))
    episode.reward_list.append(float(reward))
    episode.terminated, episode.truncated = bool(terminated), bool(truncated)
    return episode.terminated or episode.truncated


def show_progress(episodes: Iterator[RecordedEpisode], n_episodes: int, progress: bool) -> Iterator[RecordedEpisode]:
    """Pass episodes on under a progress bar with their mean return."""
    total_return = 0.0
    with tqdm(total=n_episodes, unit="episode", disable=not progress) as bar:
        for number, episode in enumerate(episodes, start=1):
            total_return += episode.rewards.sum()
            bar.set_postfix(mean_return=f"{total_return / number:.1f}", refresh=False)
            bar.update()
            yield episode
