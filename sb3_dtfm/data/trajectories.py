"""Recorded episodes in memory: a `Trajectory` each, and all of them flat in a `TrajectoryBuffer`, sampled in windows."""

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

# Recorded float64 actions may pass a float32 bound by a rounding error; beyond this share of the range they are wrong.
ACTION_TOLERANCE = 1e-4

TENSORS = ("observations", "actions", "rewards", "returns_to_go", "timesteps")


class DatasetError(ValueError):
    """A dataset cannot be used. The message names the file, episode and step, what was found and what is accepted."""


@dataclass(frozen=True)
class Trajectory:
    """
    One recorded episode of T steps.

    :param observations: (T, O), the observation each action was chosen on
    :param actions: (T, A), in the environment's own range
    :param rewards: (T,), environment reward units
    :param terminated: the last step reached a terminal state
    :param truncated: the last step hit a time limit; neither flag set means that the recording stopped mid-episode
    :param name: what the file calls this episode, for error messages
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool = False
    truncated: bool = False
    name: str = "episode"

    def __len__(self) -> int:
        return len(self.actions)


class ScoreReference(NamedTuple):
    """Returns that a normalised score maps to 0 and 1, and where that scale comes from."""

    minimum: float
    maximum: float
    scale: str

    def normalize(self, episode_return: float) -> float:
        """Normalised score of a return in environment reward units: 0 at `minimum`, 1 at `maximum`."""
        return (episode_return - self.minimum) / (self.maximum - self.minimum)


class SequenceBatch(NamedTuple):
    """
    Windows of K consecutive steps, padded on the left; padded entries are zero and False in `mask`.

    Shapes: observations (B, K, O), actions (B, K, A) in the environment's range, returns_to_go (B, K) in environment
    reward units, timesteps (B, K) int64 counted from the episode's start, mask (B, K) bool.
    """

    observations: th.Tensor
    actions: th.Tensor
    returns_to_go: th.Tensor
    timesteps: th.Tensor
    mask: th.Tensor


def returns_to_go(rewards: np.ndarray) -> np.ndarray:
    """
    Undiscounted return from each step to the end of one episode.

    Starts from the episode's return and subtracts reward by reward, in float64: the arithmetic of
    :class:`~sb3_dtfm.envs.ReturnToGoWrapper`, so that a replayed episode shows exactly these values.

    :param rewards: (T,), environment reward units
    :return: (T,) float64
    """
    rewards = np.asarray(rewards, dtype=np.float64)
    return np.subtract.accumulate(np.concatenate([[rewards.sum()], rewards[:-1]]))


class TrajectoryBuffer:
    """
    All steps of all episodes in flat float32 tensors, sampled as windows that may end at any step.

    Build it with :meth:`from_trajectories` or a reader (`load_minari`, `load_robomimic`).

    :ivar observations: (N, O) float32
    :ivar actions: (N, A) float32, in the environment's range
    :ivar rewards: (N,) float32, environment reward units
    :ivar returns_to_go: (N,) float32, environment reward units
    :ivar timesteps: (N,) int32, steps since the episode's start
    :ivar episode_lengths: (E,) int64
    :ivar episode_returns: (E,) float64, environment reward units
    :ivar terminated: (E,) bool
    :ivar truncated: (E,) bool
    """

    def __init__(
        self,
        tensors: dict[str, th.Tensor],
        episode_lengths: np.ndarray,
        episode_returns: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        source: str,
        score_reference: ScoreReference | None = None,
    ) -> None:
        self.observations = tensors["observations"]
        self.actions = tensors["actions"]
        self.rewards = tensors["rewards"]
        self.returns_to_go = tensors["returns_to_go"]
        self.timesteps = tensors["timesteps"]
        self.episode_lengths = episode_lengths
        self.episode_returns = episode_returns
        self.terminated = terminated
        self.truncated = truncated
        self.observation_space = observation_space
        self.action_space = action_space
        self.source = source
        self.score_reference = score_reference

    @classmethod
    def from_trajectories(
        cls,
        trajectories: Iterable[Trajectory],
        action_space: spaces.Box,
        observation_space: spaces.Box | None = None,
        lengths: Sequence[int] | None = None,
        source: str = "trajectories",
        score_reference: ScoreReference | None = None,
    ) -> "TrajectoryBuffer":
        """
        Copy episodes into flat arrays, checking every number on the way.

        :param trajectories: the episodes, at least one, each of at least one step
        :param action_space: bounded Box of shape (A,)
        :param observation_space: Box of shape (O,); unbounded with the first episode's O if not given
        :param lengths: steps of each episode, where known beforehand: then an iterator is read once, without a second copy
        :param source: where the episodes come from, for messages
        :param score_reference: scale of the normalised score
        :raises DatasetError: nothing to learn from, wrong shapes, NaN or infinity, or actions outside of `action_space`
        """
        if lengths is None:
            trajectories = list(trajectories)
            lengths = [len(trajectory) for trajectory in trajectories]
        if len(lengths) == 0:
            raise DatasetError(f"{source}: holds no episode; at least one is needed.")
        n_steps = int(np.sum(lengths))
        rewards = np.empty(n_steps, np.float32)
        to_go = np.empty(n_steps, np.float32)
        timesteps = np.empty(n_steps, np.int32)
        actions = np.empty((n_steps, *action_space.shape), np.float32)
        observations = np.empty((0, 0), np.float32)
        episode_returns = np.empty(len(lengths), np.float64)
        ends = np.zeros((2, len(lengths)), bool)
        start = n_read = 0
        for trajectory in trajectories:
            if observation_space is None:
                observation_space = spaces.Box(-np.inf, np.inf, np.shape(trajectory.observations)[1:], np.float32)
            if n_read == 0:
                observations = np.empty((n_steps, *observation_space.shape), np.float32)
            check_trajectory(trajectory, observation_space, action_space, source)
            if n_read == len(lengths) or len(trajectory) != lengths[n_read]:
                announced = f"{lengths[n_read]} steps" if n_read < len(lengths) else "no such episode"
                raise DatasetError(f"{source}, {trajectory.name}: holds {len(trajectory)} steps, announced: {announced}.")
            stop = start + len(trajectory)
            observations[start:stop] = trajectory.observations
            actions[start:stop] = np.clip(trajectory.actions, action_space.low, action_space.high)
            rewards[start:stop] = trajectory.rewards
            to_go[start:stop] = returns_to_go(trajectory.rewards)
            timesteps[start:stop] = np.arange(len(trajectory))
            episode_returns[n_read] = np.sum(trajectory.rewards, dtype=np.float64)
            ends[:, n_read] = trajectory.terminated, trajectory.truncated
            start, n_read = stop, n_read + 1
        if n_read != len(lengths):
            raise DatasetError(f"{source}: announces {len(lengths)} episodes, but only {n_read} can be read.")
        assert observation_space is not None
        arrays = {
            "observations": observations,
            "actions": actions,
            "rewards": rewards,
            "returns_to_go": to_go,
            "timesteps": timesteps,
        }
        return cls(
            {name: th.from_numpy(array) for name, array in arrays.items()},
            np.asarray(lengths, np.int64),
            episode_returns,
            ends[0],
            ends[1],
            observation_space,
            action_space,
            source,
            score_reference,
        )

    def __len__(self) -> int:
        """Number of recorded steps N."""
        return len(self.timesteps)

    @property
    def n_episodes(self) -> int:
        return len(self.episode_lengths)

    def select(self, episodes: np.ndarray) -> "TrajectoryBuffer":
        """
        A buffer of some of the episodes, in the order given.

        :param episodes: (E',) episode indices
        """
        starts = np.concatenate([[0], np.cumsum(self.episode_lengths)])
        rows = th.from_numpy(np.concatenate([np.arange(starts[e], starts[e + 1]) for e in episodes]))
        return TrajectoryBuffer(
            {name: getattr(self, name)[rows] for name in TENSORS},
            self.episode_lengths[episodes],
            self.episode_returns[episodes],
            self.terminated[episodes],
            self.truncated[episodes],
            self.observation_space,
            self.action_space,
            self.source,
            self.score_reference,
        )

    def random_fraction(self, fraction: float, seed: int) -> "TrajectoryBuffer":
        """
        A randomly drawn share of the episodes, the same for the same seed.

        :param fraction: share of the episodes in (0, 1]; at least one episode is kept
        :param seed: seed of the draw
        :raises ValueError: `fraction` outside of (0, 1]
        """
        if not 0.0 < fraction <= 1.0:
            raise ValueError(f"dataset_fraction must lie in (0, 1], got {fraction}.")
        if fraction == 1.0:
            return self
        n_kept = max(1, round(fraction * self.n_episodes))
        return self.select(np.sort(np.random.default_rng(seed).permutation(self.n_episodes)[:n_kept]))

    def to(self, device: th.device | str) -> "TrajectoryBuffer":
        """The same buffer with its tensors on a device; `sample` then gathers there."""
        moved = copy.copy(self)
        for name in TENSORS:
            setattr(moved, name, getattr(self, name).to(device))
        return moved

    def sample(self, batch_size: int, context_length: int, generator: th.Generator | None = None) -> SequenceBatch:
        """
        Windows that end at any step of any episode with equal probability.

        :param batch_size: B
        :param context_length: K
        :param generator: source of randomness, on the buffer's device
        """
        device = self.timesteps.device
        ends = th.randint(len(self), (batch_size,), generator=generator, device=device)
        return self.windows(ends, context_length)

    def windows(self, ends: th.Tensor, context_length: int) -> SequenceBatch:
        """
        The windows of K steps that end at the given steps.

        :param ends: (B,) int64 positions in the flat arrays
        :param context_length: K
        """
        back = th.arange(1 - context_length, 1, device=ends.device)
        timesteps = self.timesteps[ends].long().unsqueeze(1) + back  # (B, K), negative before the episode's start
        mask = timesteps >= 0
        rows = (ends.unsqueeze(1) + back).clamp_(min=0).flatten()
        shape = (len(ends), context_length, -1)
        valid = mask.unsqueeze(-1)
        return SequenceBatch(
            observations=self.observations.index_select(0, rows).view(shape) * valid,
            actions=self.actions.index_select(0, rows).view(shape) * valid,
            returns_to_go=self.returns_to_go.index_select(0, rows).view(mask.shape) * mask,
            timesteps=timesteps.clamp_(min=0),
            mask=mask,
        )


def check_trajectory(trajectory: Trajectory, observation_space: spaces.Box, action_space: spaces.Box, source: str) -> None:
    """
    Refuse an episode that training must not see.

    :raises DatasetError: names source, episode and step, what was found and what is accepted
    """
    where = f"{source}, {trajectory.name}"
    n_steps = len(trajectory)
    if n_steps == 0:
        raise DatasetError(f"{where}: holds no step; at least one is needed.")
    expected = {
        "observations": (n_steps, *observation_space.shape),
        "actions": (n_steps, *action_space.shape),
        "rewards": (n_steps,),
    }
    for name, shape in expected.items():
        array = getattr(trajectory, name)
        if np.shape(array) != shape:
            raise DatasetError(f"{where}: {name} have shape {np.shape(array)}, expected {shape}.")
        bad = ~(np.abs(array) <= np.finfo(np.float32).max)  # also True for NaN
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            column = f", dimension {index[1]}" if len(index) > 1 else ""
            raise DatasetError(
                f"{where}, step {index[0]}: {name} hold {array[index]}{column}; numbers must be finite in float32."
            )
    slack = ACTION_TOLERANCE * (action_space.high - action_space.low)
    outside = (trajectory.actions < action_space.low - slack) | (trajectory.actions > action_space.high + slack)
    if outside.any():
        step, dimension = (int(i) for i in np.argwhere(outside)[0])
        raise DatasetError(
            f"{where}, step {step}: action {trajectory.actions[step, dimension]:g} in dimension {dimension} lies outside of "
            f"the action space [{action_space.low[dimension]:g}, {action_space.high[dimension]:g}]."
        )
