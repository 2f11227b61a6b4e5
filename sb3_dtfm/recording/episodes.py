"""One episode loop for agents and demonstrators, and what it keeps of an episode."""

import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.envs.success import reported_success

# (batched observations, episode starts (n_envs,), episode numbers (n_envs,)) -> actions (n_envs, A), or (n_envs,) of choices
ActFunction = Callable[[Any, np.ndarray, Sequence[int]], np.ndarray]


@dataclass
class RecordedEpisode:
    """
    One episode while it runs and when it is complete.

    :param seed: seed that the environment was reset with
    :param observations: T + 1 arrays, or dicts of arrays
    :param actions: T arrays (A,), or numbers where the action space is Discrete
    :param rewards: T numbers, environment reward units
    :param terminated: whether it ended in a terminal state
    :param truncated: whether it ended at a time limit
    :param reported: T reports of success by the environment; None where it said nothing
    :param states: T arrays (S,), the simulator's state before each action; empty unless asked for
    :param model_file: XML of the simulated scene; empty unless asked for
    """

    seed: int | None
    observations: list[Any]
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False
    reported: list[bool | None] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)
    model_file: str = ""

    @property
    def success(self) -> bool | None:
        """Whether the last step's info reports success; None where it says nothing."""
        return self.reported[-1] if self.reported else None


class EpisodeRecorder(gym.Wrapper):
    """
    Keeps what passes through an environment.

    Other wrappers stand around it, so that what is kept is what the environment itself gave and was given.

    :param env: the environment
    :param simulation: whether to keep the simulator's states and scene too, `state` and `model_file` of `env.unwrapped`
    """

    recorded: RecordedEpisode

    def __init__(self, env: gym.Env, simulation: bool = False) -> None:
        super().__init__(env)
        self._simulator: Any = env.unwrapped if simulation else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        # An environment may hand out the same array at every step.
        self.recorded = RecordedEpisode(seed, [copy.deepcopy(observation)])
        if self._simulator is not None:
            self.recorded.model_file = self._simulator.model_file
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        episode, action = self.recorded, np.asarray(action, self.action_space.dtype)[()]  # a number, not an array of none
        if self._simulator is not None:
            episode.states.append(self._simulator.state)
        episode.actions.append(action.copy())
        observation, reward, terminated, truncated, info = self.env.step(action)
        episode.observations.append(copy.deepcopy(observation))
        episode.rewards.append(float(reward))
        episode.terminated, episode.truncated = bool(terminated), bool(truncated)
        episode.reported.append(reported_success(info))
        return observation, reward, terminated, truncated, info


def run_episodes(envs: Sequence[gym.Env], act: ActFunction, seeds: Sequence[int]) -> Iterator[RecordedEpisode]:
    """
    One episode for each seed, in their order, run side by side.

    An environment that finishes takes the next episode. Once none is left it stands still at a start, and its row of the
    batch is ignored, so that an agent with memory sees the same rows throughout. An episode that a wrapper ends, and not the
    environment itself, is truncated.

    :param envs: environments of one kind, with an :class:`EpisodeRecorder` among their wrappers
    :param act: function that chooses the actions
    :param seeds: seeds of the episodes, which the environments are reset with
    """
    envs = envs[: len(seeds)]
    numbers = list(range(len(envs)))
    observations = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=False)]
    starts, active = np.ones((2, len(envs)), dtype=bool)
    waiting = iter(range(len(envs), len(seeds)))
    finished: dict[int, RecordedEpisode] = {}
    n_yielded = 0
    while active.any():
        actions = act(stack_observations(observations), starts, numbers)
        starts[:] = ~active
        for row in np.flatnonzero(active):
            observations[row], _, terminated, truncated, _ = envs[row].step(actions[row])
            if not (terminated or truncated):
                continue
            finished[numbers[row]] = episode = envs[row].get_wrapper_attr("recorded")
            episode.truncated |= not episode.terminated
            starts[row] = True
            number = next(waiting, None)
            if number is None:
                active[row] = False
                continue
            observations[row], _ = envs[row].reset(seed=seeds[number])
            numbers[row] = number
        while n_yielded in finished:
            yield finished.pop(n_yielded)
            n_yielded += 1


def add_noise(
    act: ActFunction, space: ActionSpace, noise: float, generator: Callable[[int], np.random.Generator]
) -> ActFunction:
    """
    The same actions with Gaussian noise, clipped into the action space. Discrete actions stay as they are.

    :param act: function that chooses the actions
    :param space: the action space
    :param noise: standard deviation, as a share of the action range (high - low)
    :param generator: function from an episode's number to the random generator of its noise
    :raises ValueError: noise for Discrete actions
    """
    if isinstance(space, spaces.Discrete):
        if noise > 0.0:
            raise ValueError(f"noise must be 0 for {space}, got {noise}; actions that are sampled (--stochastic) vary, too.")
        return act
    generator = functools.cache(generator)
    scale = noise * (space.high - space.low)

    def act_with_noise(observations: Any, starts: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
        actions = act(observations, starts, numbers)
        if noise > 0.0:
            actions = actions + scale * np.stack([generator(number).standard_normal(space.shape) for number in numbers])
        return np.clip(actions, space.low, space.high).astype(space.dtype)

    return act_with_noise


def check_recording(n_episodes: int, noise: float, seed: int) -> None:
    """
    Refuse numbers out of range that every recording has.

    :param n_episodes: episodes to record
    :param noise: standard deviation of action noise, as a share of the action range
    :param seed: seed of everything random
    :raises ValueError: names the argument, what was given and what is accepted
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes must be at least 1, got {n_episodes}.")
    if not 0.0 <= noise < np.inf:
        raise ValueError(f"noise must be a share of the action range, 0 or more, got {noise}.")
    if seed < 0:
        raise ValueError(f"seed must be 0 or more, got {seed}.")


def stack_observations(observations: Sequence[Any]) -> Any:
    """One array, or dict of arrays, of several observations."""
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)
