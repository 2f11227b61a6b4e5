"""All recorded episodes flat in a `TrajectoryBuffer`: what it holds, what is measured of it, and others made of it."""

import copy
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import parse_env_id

from sb3_dtfm.actions import ActionSpace, bounds_of, from_vectors, same_actions
from sb3_dtfm.arguments import COUNT, check_arguments
from sb3_dtfm.data.collecting import collect
from sb3_dtfm.data.drawing import FlatSteps
from sb3_dtfm.data.episodes import EpisodeTable, Statistics, moments
from sb3_dtfm.data.expected import Steps, expected_returns_to_go
from sb3_dtfm.data.short_episodes import ShortEpisodes
from sb3_dtfm.data.storage import FileStorage, MappedSteps, MemoryStorage
from sb3_dtfm.data.trajectories import DatasetError, ScoreReference, Trajectory, listed, returns_to_go
from sb3_dtfm.files import replacing, warn
from sb3_dtfm.transitions import Transitions
from sb3_dtfm.windows import OBSERVATION, map_tensors

# A buffer moves to an accelerator if it takes at most this share of the memory that is free there.
DEVICE_MEMORY_SHARE = 0.5
# Prefix of the names of image arrays in a file of flat arrays.
IMAGE = "image:"


def with_npz(path: str | os.PathLike[str]) -> Path:
    """The file that :meth:`TrajectoryBuffer.save` writes: `.npz` is added where it is missing."""
    path = Path(path)
    return path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")


class TrajectoryBuffer(FlatSteps):
    """
    Steps of episodes in flat float32 tensors, sampled as windows that may end at any step.

    Build it with :meth:`from_trajectories`, or let :func:`~sb3_dtfm.data.load_dataset` read it. A buffer of some of the
    episodes (:meth:`select`, :meth:`random_fraction`) shares the flat tensors with the one it comes from: `rows` are its own
    steps.

    :ivar observations: (N, O) float32
    :ivar actions: (N, A) float32, in the environment's range; of a Discrete action space the vectors of
        :func:`~sb3_dtfm.actions.to_vectors`
    :ivar rewards: (N,) float32, environment reward units
    :ivar returns_to_go: (N,) float32, environment reward units
    :ivar image_spaces: spaces of the images, uint8 as they were recorded, by camera; the images themselves are `own(camera)`
    :ivar episodes: the buffer's episodes, one row each
    :ivar weights: (E,) float64, relative sampling weight of each episode's steps
    :ivar env_id: Gymnasium id of the environment that they come from, None if unknown
    :ivar controller: robot, controller and control frequency that the actions were recorded with, by robosuite's names;
        None where the data do not tell
    :ivar dropped: number of episodes that `on_invalid="drop"` has left out, and the reason of the first; None if there
        is none
    :ivar device: device of the batches
    """

    def __init__(
        self,
        tensors: dict[str, th.Tensor],
        episodes: EpisodeTable,
        observation_space: spaces.Box,
        action_space: ActionSpace,
        source: str,
        score_reference: ScoreReference | None = None,
        env_id: str | None = None,
        maps: Sequence[MappedSteps] = (),
        dropped: tuple[int, str] | None = None,
        image_spaces: Mapping[str, spaces.Box] | None = None,
    ) -> None:
        super().__init__(tensors, episodes, maps)
        self.image_spaces = dict(image_spaces or {})
        self.observation_space = observation_space
        self.action_space = action_space
        self.source = source
        self.score_reference = score_reference
        self.env_id = env_id
        self.controller: dict[str, Any] | None = None
        self.dropped = dropped
        if dropped:
            n_all = dropped[0] + len(episodes.lengths)
            warn(
                f"{source}: {dropped[0]} of {n_all} episodes have been dropped, the first for this: {dropped[1]}",
                stacklevel=2,
            )

    @classmethod
    def from_trajectories(
        cls,
        trajectories: Iterable[Trajectory | ShortEpisodes],
        action_space: ActionSpace,
        observation_space: spaces.Box | None = None,
        n_steps: int | None = None,
        source: str = "trajectories",
        score_reference: ScoreReference | None = None,
        env_id: str | None = None,
        storage: MemoryStorage | FileStorage | None = None,
        on_invalid: str = "raise",
        n_stored: int | None = None,
    ) -> "TrajectoryBuffer":
        """
        Copy episodes into flat arrays, checking every number on the way.

        :param trajectories: the episodes, at least one, each of at least one step; an iterator is read once, and may raise
            DatasetError for an episode and go on with the next, as `map` does
        :param action_space: bounded Box of floats of shape (A,), or Discrete
        :param observation_space: Box of shape (O,); unbounded with the first episode's O if not given
        :param n_steps: steps of all episodes, where known beforehand, so that memory for them is taken once
        :param source: origin of the episodes, for messages
        :param score_reference: scale of the normalised score
        :param env_id: Gymnasium id of the environment that the episodes come from
        :param storage: storage of the steps; memory if not given
        :param on_invalid: "raise" an error for an invalid episode, or "drop" it, which is counted and warned of
        :param n_stored: bytes of the files that the episodes are read from; episodes that take far more are refused before
            they fill the memory, see :func:`~sb3_dtfm.data.trajectories.check_size`
        :raises DatasetError: nothing to learn from, other spaces, wrong shapes, NaN or infinity, or actions outside of
            `action_space`
        """
        tensors, episodes, observation_space, image_spaces, dropped = collect(
            trajectories, action_space, observation_space, n_steps, source, storage or MemoryStorage(), on_invalid, n_stored
        )
        about = (source, score_reference, env_id)
        return cls(tensors, episodes, observation_space, action_space, *about, dropped=dropped, image_spaces=image_spaces)

    def __repr__(self) -> str:
        return f"TrajectoryBuffer({self.source}: {self.n_episodes} episodes, {len(self)} steps)"

    @property
    def n_episodes(self) -> int:
        return len(self.episodes.lengths)

    @property
    def n_dropped(self) -> int:
        """Number of episodes that `on_invalid="drop"` has left out."""
        return self.dropped[0] if self.dropped else 0

    @property
    def episode_lengths(self) -> np.ndarray:
        """(E,) int64"""
        return self.episodes.lengths

    @property
    def episode_returns(self) -> np.ndarray:
        """(E,) float64, environment reward units"""
        return self.episodes.returns

    @property
    def terminated(self) -> np.ndarray:
        """(E,) bool"""
        return self.episodes.terminated

    @property
    def truncated(self) -> np.ndarray:
        """(E,) bool"""
        return self.episodes.truncated

    @property
    def successes(self) -> np.ndarray:
        """(E,) float64: 1 where the task was done at the last step, 0 where not, NaN where the data do not tell"""
        return self.episodes.successes

    def statistics(self) -> Statistics:
        """Normalisation statistics of the buffer's own steps; reads none of them."""
        return self.episodes.statistics()

    def return_to_go_range(self) -> th.Tensor:
        """
        Smallest and largest return-to-go at each time step, over the buffer's own episodes; reads 4 bytes a step.

        :return: (2, T) of the T steps of the longest episode, environment reward units
        """
        timesteps, values = self.timesteps.cpu(), self.returns_to_go.cpu()
        n_timesteps = int(self.episode_lengths.max())
        low = th.full((n_timesteps,), th.inf).scatter_reduce_(0, timesteps, values, "amin")
        high = th.full((n_timesteps,), -th.inf).scatter_reduce_(0, timesteps, values, "amax")
        return th.stack((low, high))

    def return_to_go_moments(self) -> th.Tensor:
        """
        Mean and standard deviation of the return-to-go at each time step, over the buffer's own episodes.

        A standard deviation is at least a twentieth of that over all steps, and a thousandth of the largest return-to-go:
        where returns hardly differ, their differences stay small.

        :return: (2, T) of the T steps of the longest episode, environment reward units
        """
        timesteps, values = self.timesteps.cpu(), self.returns_to_go.cpu().double()
        zeros = th.zeros(int(self.episode_lengths.max()), dtype=th.float64)
        count = zeros.index_add(0, timesteps, th.ones_like(values))
        mean = zeros.index_add(0, timesteps, values) / count
        variance = zeros.index_add(0, timesteps, (values - mean[timesteps]).square()) / count
        smallest = max(float(values.std(correction=0)) / 20.0, float(values.abs().max()) / 1000.0)
        return th.stack((mean, variance.sqrt().clamp(min=smallest or 1.0))).float()

    def with_expected_returns(self, n_steps: int, seed: int = 0) -> "TrajectoryBuffer":
        """
        A buffer whose returns-to-go hardly depend on chance: the rewards after n steps are replaced by the return that may
        be expected after such an observation, an expectile of 0.95 (conditioning on expected returns: Paster et al.,
        2022). Without that, a high target return stands for chance. Returns of episodes, by which steps are drawn, stay as
        they were recorded. See :func:`~sb3_dtfm.data.expected.expected_returns_to_go`.

        :param n_steps: n, steps whose rewards count as they came
        :param seed: seed of the network that learns what to expect; an equal one gives equal numbers
        :return: buffer on the same flat tensors, but with its own returns-to-go
        """
        rows, timesteps, n_left = self._locate(th.arange(len(self), device=self._stops.device))
        steps = Steps(self.stored["observations"], self.stored["returns_to_go"], rows, timesteps, n_left)
        changed = copy.copy(self)
        expected = self.stored["returns_to_go"].clone()
        expected[rows] = expected_returns_to_go(steps, n_steps, self.statistics(), seed)
        changed.stored = {**self.stored, "returns_to_go": expected}
        return changed

    def within(self, max_episode_steps: int) -> "TrajectoryBuffer":
        """
        A buffer of what an environment with such a time limit would have shown: longer episodes are cut after
        `max_episode_steps`, count as truncated, and have the return of the steps that are left. The data do not tell
        whether a successful episode had succeeded by then; an unsuccessful one had not.

        :param max_episode_steps: steps of an episode, at least 1
        :return: buffer on the same flat tensors, but with its own returns-to-go; this buffer where no episode is longer
        :raises ValueError: `max_episode_steps` below 1
        """
        check_arguments({"max_episode_steps": max_episode_steps}, {"max_episode_steps": COUNT})
        longer = np.flatnonzero(self.episode_lengths > max_episode_steps)
        if not len(longer):
            return self
        warn(
            f"{self.source}: {len(longer)} of {self.n_episodes} episodes have more than {max_episode_steps} steps, up to "
            f"{self.episode_lengths.max()}. Later steps and their rewards are left out. To keep them, make an environment "
            "with a larger max_episode_steps, or set dataset_kwargs={'max_episode_steps': None}.",
            stacklevel=2,
        )
        table = EpisodeTable(*(column.copy() for column in self.episodes))
        table.lengths[longer], table.terminated[longer], table.truncated[longer] = max_episode_steps, False, True
        table.successes[longer[table.successes[longer] == 1.0]] = np.nan
        changed = copy.copy(self)
        shortened = self.stored["returns_to_go"].clone()
        for episode in longer:
            steps = slice(table.starts[episode], table.starts[episode] + max_episode_steps)
            to_go = returns_to_go(self.stored["rewards"][steps].cpu().numpy())
            shortened[steps] = th.from_numpy(to_go).to(shortened)
            table.returns[episode], table.return_scales[episode] = to_go[0], np.abs(to_go).max()
            found = moments(self.stored["observations"][steps].cpu().numpy())
            table.observation_means[episode], table.observation_squares[episode] = found
        changed.stored = {**self.stored, "returns_to_go": shortened}
        changed._set_episodes(table)
        return changed

    def largest_discounted_return(self, gamma: float) -> float:
        """
        Largest absolute discounted return-to-go, over the buffer's own episodes; reads 4 bytes a step.

        :param gamma: discount of a step
        :return: largest absolute value, environment reward units
        """
        largest = 0.0
        for start, length in zip(self.episodes.starts, self.episodes.lengths, strict=True):
            to_go = self.stored["rewards"][start : start + length].cpu().numpy().astype(np.float64)
            n_summed = 1  # steps that each sum has
            while n_summed < length:
                to_go[:-n_summed] += gamma**n_summed * to_go[n_summed:]
                n_summed *= 2
            largest = max(largest, float(np.abs(to_go).max()))
        return largest

    def sample_transitions(
        self, batch_size: int, n_steps: int, gamma: float, generator: th.Generator | None = None
    ) -> Transitions:
        """
        Steps of any episode with equal probability, and where they and those after them led to.

        :param batch_size: B
        :param n_steps: h, steps that count as one
        :param gamma: discount of a step
        :param generator: source of randomness
        """
        return self.transitions(self._draw(batch_size, generator), n_steps, gamma)

    def transitions(self, positions: th.Tensor, n_steps: int, gamma: float) -> Transitions:
        """
        The steps at the given positions, and where they and those after them led to; actions in the environment's range.

        Behind an episode's end its last action stands again and again, as in :meth:`windows`.

        :param positions: (B,) int64 among the buffer's own steps, episode after episode
        :param n_steps: h, steps that count as one
        :param gamma: discount of a step
        """
        positions = positions.to(self._stops.device)
        rows, _, n_left = self._locate(positions)
        terminated = self._terminated[th.searchsorted(self._stops, positions, right=True)]
        steps = th.arange(n_steps, device=rows.device)
        ahead = (rows.unsqueeze(1) + th.minimum(steps, n_left.unsqueeze(1))).flatten()
        discounted = self.stored["rewards"].index_select(0, ahead).view(-1, n_steps) * gamma**steps
        goes_on = n_left >= n_steps
        batch = Transitions(
            observations=self.stored["observations"].index_select(0, rows),
            actions=self.stored["actions"].index_select(0, ahead).view(len(rows), -1),
            rewards=(discounted * (steps <= n_left.unsqueeze(1))).sum(dim=1),
            next_observations=self.stored["observations"].index_select(0, rows + th.minimum(steps[-1] + 1, n_left)),
            discounts=gamma**n_steps * goes_on,
            mask=goes_on | terminated,
        )
        if self.cameras:
            next_rows = rows + th.minimum(steps[-1] + 1, n_left)
            batch = batch._replace(
                observations={OBSERVATION: batch.observations, **self.images(rows, rows.shape)},
                next_observations={OBSERVATION: batch.next_observations, **self.images(next_rows, rows.shape)},
            )
        return Transitions(*(map_tensors(lambda tensor: tensor.to(self.device), each) for each in batch))

    def to(self, device: th.device | str) -> "TrajectoryBuffer":
        """
        The same buffer for batches on a device.

        Its tensors move there if they take at most half of the memory that is free; otherwise each batch moves.
        """
        moved = copy.copy(self)
        moved.device = th.device(device)
        if moved.device.type == "cuda":
            free, _ = th.cuda.mem_get_info(moved.device)
            if sum(tensor.nbytes for tensor in self.stored.values()) > DEVICE_MEMORY_SHARE * free:
                return moved
        moved.stored = {name: tensor.to(moved.device) for name, tensor in self.stored.items()}
        moved.device = moved.stored["observations"].device
        moved._maps = self._maps if moved.device.type == "cpu" else ()
        moved._set_episodes(self.episodes)
        return moved

    def check_task(self, env_id: str) -> None:
        """
        Refuse the data of another task; versions may differ, and data that do not tell are taken.

        :param env_id: Gymnasium id of the environment that is to be learned
        :raises DatasetError: names both environments, and how to insist
        """
        if self.env_id is None or parse_env_id(self.env_id)[:2] == parse_env_id(env_id)[:2]:
            return
        raise DatasetError(
            f"{self.source} was recorded in {self.env_id}, and the environment is {env_id}. If the data are meant for it, "
            f"say so with dataset_kwargs={{'env_id': {env_id!r}}} (-params or --dataset-kwargs on the command line)."
        )

    def select(self, episodes: np.ndarray) -> "TrajectoryBuffer":
        """
        A buffer of some of the episodes, in the order given, on the same flat tensors.

        :param episodes: (E',) episode indices, at least one
        :raises ValueError: no episode
        """
        if not len(episodes):
            raise ValueError(f"{self.source}: select was given no episode; at least one of {self.n_episodes} is needed.")
        chosen = copy.copy(self)
        chosen.weights = self.weights[episodes]
        chosen._set_episodes(self.episodes.select(episodes))
        return chosen

    def best(
        self, min_return: float | None = None, best_share: float | None = None, success_only: bool = False
    ) -> "TrajectoryBuffer":
        """
        A buffer of the better episodes, in their order.

        :param min_return: the smallest return that is kept, environment reward units; None keeps all
        :param best_share: share of the episodes in (0, 1], those of the largest returns; at least one is kept
        :param success_only: whether to keep only successes, of which the best share is then taken
        :raises DatasetError: no episode has such a return, none is a success, or the data do not tell
        :raises ValueError: `best_share` outside of (0, 1]
        """
        buffer = self._succeeded() if success_only else self
        if min_return is not None:
            kept = np.flatnonzero(buffer.episode_returns >= min_return)
            if not len(kept):
                found = f"the largest return is {buffer.episode_returns.max():g}"
                raise DatasetError(f"{self.source}: no episode has min_return {min_return:g}; {found}.")
            buffer = buffer.select(kept)
        if best_share is not None:
            if not 0.0 < best_share <= 1.0:
                raise ValueError(f"best_share must lie in (0, 1], got {best_share}.")
            n_kept = max(1, round(best_share * buffer.n_episodes))
            buffer = buffer.select(np.sort(np.argsort(-buffer.episode_returns, kind="stable")[:n_kept]))
        return buffer

    def _succeeded(self) -> "TrajectoryBuffer":
        silent = np.flatnonzero(np.isnan(self.successes))
        if len(silent):
            found = f"of {len(silent)} of {self.n_episodes} episodes the data do not tell whether they succeeded"
            raise DatasetError(f"{self.source}: success_only, but {found}; min_return chooses by the return.")
        if not self.successes.any():
            raise DatasetError(f"{self.source}: success_only, but none of {self.n_episodes} episodes is a success.")
        return self.select(np.flatnonzero(self.successes))

    @classmethod
    def join(cls, buffers: Sequence["TrajectoryBuffer"], weights: Sequence[float]) -> "TrajectoryBuffer":
        """
        One buffer, in memory, of the episodes of several, one after the other.

        :param buffers: buffers of one task, at least one
        :param weights: relative sampling weight of the steps of each buffer
        :raises DatasetError: other observations, actions or environments than the first one's
        """
        first, source = buffers[0], " + ".join(buffer.source for buffer in buffers)
        for other in buffers[1:]:
            sizes = other.observation_space.shape == first.observation_space.shape
            cameras = other.image_spaces == first.image_spaces
            if not sizes or not cameras or not same_actions(other.action_space, first.action_space):
                held = [
                    f"{each.source} holds {each.observation_space.shape}, {each.action_space}, images of "
                    f"{listed(each.image_spaces)}"
                    for each in (first, other)
                ]
                raise DatasetError(f"{source}: other observations or actions cannot be joined: {'; '.join(held)}.")
        named = next((buffer for buffer in buffers if buffer.env_id is not None), first)
        for other in buffers:
            if other.env_id is not None:
                named.check_task(other.env_id)
        tensors = {name: th.cat([each.own(name).to(first.stored[name].device) for each in buffers]) for name in first.stored}
        table = EpisodeTable(*map(np.concatenate, zip(*(each.episodes for each in buffers), strict=True)))
        table = table._replace(starts=np.cumsum(table.lengths) - table.lengths)
        about = (first.observation_space, first.action_space, source)
        joined = cls(tensors, table, *about, env_id=named.env_id, image_spaces=first.image_spaces)
        joined.controller = next((each.controller for each in buffers if each.controller is not None), None)
        if len({buffer.score_reference for buffer in buffers}) == 1:
            joined.score_reference = first.score_reference
        if dropped := [buffer.dropped for buffer in buffers if buffer.dropped]:
            joined.dropped = sum(n for n, _ in dropped), dropped[0][1]
        joined.weights = np.concatenate([w * each.weights for w, each in zip(weights, buffers, strict=True)])
        return joined

    def random_fraction(self, fraction: float, seed: int) -> "TrajectoryBuffer":
        """
        A randomly drawn share of the episodes, the same for the same seed.

        :param fraction: share of the episodes in (0, 1]; at least one episode is kept
        :param seed: seed of the draw
        :raises ValueError: `fraction` outside of (0, 1]
        """
        if not 0.0 < fraction <= 1.0:
            raise ValueError(f"fraction must lie in (0, 1], got {fraction}.")
        if fraction == 1.0:
            return self
        n_kept = max(1, round(fraction * self.n_episodes))
        return self.select(np.sort(np.random.default_rng(seed).permutation(self.n_episodes)[:n_kept]))

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write the buffer's own steps as flat arrays, which `dataset=` and `--dataset` take; of `weights`, a warning says that
        they are not among them.

        :param path: path of the file; `.npz` is added if it is missing
        :raises OSError: it cannot be written; what was there before still is
        """
        path = with_npz(path)
        if (self.weights != self.weights[0]).any():
            warn(f"{path}: has no weights of episodes; give them again when it is read.", stacklevel=2)
        stops = self._stops.cpu().numpy()
        ended = {name: np.zeros(len(self), bool) for name in ("terminations", "truncations")}
        ended["terminations"][stops - 1], ended["truncations"][stops - 1] = self.terminated, self.truncated
        steps = {name: getattr(self, name).cpu().numpy() for name in ("observations", "actions", "rewards")}
        steps |= {f"{IMAGE}{camera}": self.own(camera).cpu().numpy() for camera in self.image_spaces}
        steps["actions"] = from_vectors(steps["actions"], self.action_space)
        space = dict(zip(("action_low", "action_high"), bounds_of(self.action_space), strict=True))
        named = {} if self.env_id is None else {"env_id": np.array(self.env_id)}
        silent = np.isnan(self.successes)
        if not silent.all():
            named["successes"] = self.successes if silent.any() else self.successes.astype(bool)
        with replacing(path) as beside, open(beside, "wb") as file:
            np.savez(file, **steps, **ended, episode_ends=stops, **space, **named)
