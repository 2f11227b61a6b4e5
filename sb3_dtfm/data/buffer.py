"""All recorded episodes flat in a `TrajectoryBuffer`, sampled in windows."""

import copy
import itertools
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import parse_env_id

from sb3_dtfm.actions import ActionSpace, bounds_of, from_vectors, to_vectors, vector_space
from sb3_dtfm.data.episodes import EpisodeTable, Statistics, moments
from sb3_dtfm.data.expected import Steps, expected_returns_to_go
from sb3_dtfm.data.storage import STEP_ARRAYS, FileStorage, MappedSteps, MemoryStorage
from sb3_dtfm.data.trajectories import (
    DatasetError,
    ScoreReference,
    Trajectory,
    check_action_space,
    check_size,
    check_trajectory,
)
from sb3_dtfm.files import replacing
from sb3_dtfm.windows import Transitions, Windows

# A buffer moves to an accelerator if it takes at most this share of the memory that is free there.
DEVICE_MEMORY_SHARE = 0.5
# What may become of an episode that is refused.
ON_INVALID = ("raise", "drop")


class TrajectoryBuffer:
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
    :ivar episodes: the buffer's episodes, one row each
    :ivar weights: (E,) float64, how often a step of each is drawn beside one of weight 1
    :ivar env_id: Gymnasium id of the environment that they come from, None where nobody says
    :ivar dropped: how many episodes `on_invalid="drop"` has left out, and why the first of them; None where it had none
    :ivar device: what batches are made for
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
    ) -> None:
        self.observations = tensors["observations"]
        self.actions = tensors["actions"]
        self.rewards = tensors["rewards"]
        self.returns_to_go = tensors["returns_to_go"]
        self.observation_space = observation_space
        self.action_space = action_space
        self.source = source
        self.score_reference = score_reference
        self.env_id = env_id
        self.dropped = dropped
        self._maps = maps
        self.device = self.observations.device
        self._present = th.zeros(0, dtype=th.int64)
        self.weights = np.ones(len(episodes.lengths))
        self._set_episodes(episodes)
        if dropped:
            n_all = dropped[0] + len(episodes.lengths)
            warnings.warn(
                f"{source}: {dropped[0]} of {n_all} episodes have been dropped, the first for this: {dropped[1]}",
                stacklevel=2,
            )

    def _set_episodes(self, episodes: EpisodeTable) -> None:
        self.episodes = episodes
        stops = np.cumsum(episodes.lengths)
        # Positions among the buffer's own steps at which each episode ends, and what leads from a position to its row.
        self._stops = th.from_numpy(stops).to(self.observations.device)
        self._firsts = th.from_numpy(stops - episodes.lengths).to(self.observations.device)
        self._starts = th.from_numpy(episodes.starts).to(self.observations.device)
        self._terminated = th.from_numpy(episodes.terminated).to(self.observations.device)
        self._n_steps = int(stops[-1])

    @classmethod
    def from_trajectories(
        cls,
        trajectories: Iterable[Trajectory],
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
        :param source: where the episodes come from, for messages
        :param score_reference: scale of the normalised score
        :param env_id: Gymnasium id of the environment that the episodes come from
        :param storage: where the steps go, memory if not given
        :param on_invalid: "raise" for an episode that is refused, or "drop" it, which is counted and warned of
        :param n_stored: bytes of the files that the episodes are read from; episodes that take far more are refused before
            they fill the memory, see :func:`~sb3_dtfm.data.trajectories.check_size`
        :raises DatasetError: nothing to learn from, other spaces, wrong shapes, NaN or infinity, or actions outside of
            `action_space`
        """
        if on_invalid not in ON_INVALID:
            raise DatasetError(f"on_invalid must be one of {', '.join(ON_INVALID)}, got {on_invalid!r}.")
        action_space = check_action_space(action_space, source)
        n_action_numbers = vector_space(action_space).shape[0]
        storage = storage or MemoryStorage()
        if n_steps is None and isinstance(trajectories, Sequence):
            n_steps = sum(map(len, trajectories))
        storage.reserve(n_steps or 0)
        rows: list[tuple] = []
        dropped: list[DatasetError] = []
        start = 0

        def check(trajectory: Trajectory) -> np.ndarray:
            nonlocal observation_space
            space = observation_space or spaces.Box(-np.inf, np.inf, np.shape(trajectory.observations)[1:], np.float32)
            to_go = check_trajectory(trajectory, space, action_space, source)
            if n_stored is not None:
                n_rows, n_columns = max(n_steps or 0, start + len(trajectory)), space.shape[0] + n_action_numbers + 2
                check_size(4 * n_rows * n_columns, n_stored, f"{source}: {n_rows} steps")
            observation_space = space
            return to_go

        for trajectory, to_go in _checked(trajectories, check, dropped, on_invalid):
            storage.append(
                {
                    "observations": trajectory.observations,
                    "actions": to_vectors(trajectory.actions, action_space),
                    "rewards": trajectory.rewards,
                    "returns_to_go": to_go,
                }
            )
            rows.append(_episode_row(trajectory, start, to_go))
            start += len(trajectory)
        if observation_space is None or not rows:
            left = f" that could be kept of {len(dropped)} (the first: {dropped[0]})" if dropped else ""
            raise DatasetError(f"{source}: holds no episode{left}; at least one is needed.")
        return cls(
            storage.finish(),
            EpisodeTable(*(np.array(column) for column in zip(*rows, strict=True))),
            observation_space,
            action_space,
            source,
            score_reference,
            env_id,
            dropped=(len(dropped), str(dropped[0])) if dropped else None,
        )

    def __repr__(self) -> str:
        return f"TrajectoryBuffer({self.source}: {self.n_episodes} episodes, {len(self)} steps)"

    def __len__(self) -> int:
        """Number of the buffer's own steps."""
        return self._n_steps

    @property
    def memory_mapped(self) -> bool:
        """Whether the flat tensors are files that are read where they are used."""
        return len(self._maps) > 0

    @property
    def n_episodes(self) -> int:
        return len(self.episodes.lengths)

    @property
    def n_dropped(self) -> int:
        """How many episodes `on_invalid="drop"` has left out."""
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

    @property
    def timesteps(self) -> th.Tensor:
        """(len(self),) int64, the buffer's own steps counted from their episodes' starts; made anew at each call."""
        lengths = th.from_numpy(self.episodes.lengths).to(self._firsts.device)
        return th.arange(len(self), device=lengths.device) - self._firsts.repeat_interleave(lengths)

    @property
    def rows(self) -> th.Tensor:
        """(len(self),) int64, where the buffer's own steps lie in the flat tensors; made anew at each call."""
        return self._locate(th.arange(len(self), device=self._stops.device))[0]

    def statistics(self) -> Statistics:
        """What inputs are normalised by, over the buffer's own steps; reads none of them."""
        return self.episodes.statistics()

    def return_to_go_range(self) -> th.Tensor:
        """
        Smallest and largest return-to-go at each time step, over the buffer's own episodes; reads 4 bytes a step.

        :return: (2, T) of the T steps of the longest episode, environment reward units
        """
        timesteps, values = self.timesteps.cpu(), self.returns_to_go[self.rows].cpu()
        n_timesteps = int(self.episode_lengths.max())
        low = th.full((n_timesteps,), th.inf).scatter_reduce_(0, timesteps, values, "amin")
        high = th.full((n_timesteps,), -th.inf).scatter_reduce_(0, timesteps, values, "amax")
        return th.stack((low, high))

    def with_expected_returns(self, n_steps: int, seed: int) -> "TrajectoryBuffer":
        """
        A buffer whose returns-to-go are hardly luck: what came after n steps is replaced by what may be expected after such
        an observation, an expectile of 0.9 (conditioning on expected returns: Paster et al., 2022). Without that, asking for
        the best return asks for what the luckiest did. Returns of episodes, and what draws them, stay what was recorded.
        See :func:`~sb3_dtfm.data.expected.expected_returns_to_go`.

        :param n_steps: n, steps whose rewards count as they came
        :param seed: of the network that learns what to expect; the same one gives the same numbers
        :return: on the same flat tensors, but for the returns-to-go
        """
        rows, timesteps, n_left = self._locate(th.arange(len(self), device=self._stops.device))
        steps = Steps(self.observations, self.returns_to_go, rows, timesteps, n_left)
        changed = copy.copy(self)
        changed.returns_to_go = self.returns_to_go.clone()
        changed.returns_to_go[rows] = expected_returns_to_go(steps, n_steps, self.statistics(), seed)
        return changed

    def largest_discounted_return(self, gamma: float) -> float:
        """
        Largest absolute discounted return-to-go, over the buffer's own episodes; reads 4 bytes a step.

        :param gamma: discount of a step
        :return: environment reward units
        """
        largest = 0.0
        for start, length in zip(self.episodes.starts, self.episodes.lengths, strict=True):
            to_go = self.rewards[start : start + length].cpu().numpy().astype(np.float64)
            n_summed = 1  # steps that each sum has
            while n_summed < length:
                to_go[:-n_summed] += gamma**n_summed * to_go[n_summed:]
                n_summed *= 2
            largest = max(largest, float(np.abs(to_go).max()))
        return largest

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
            f"say so with dataset_kwargs={{'env_id': {env_id!r}}} (-params on the command line)."
        )

    def select(self, episodes: np.ndarray) -> "TrajectoryBuffer":
        """
        A buffer of some of the episodes, in the order given, on the same flat tensors.

        :param episodes: (E',) episode indices
        """
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
        :param success_only: keep the successes, of which the best share is then taken
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

        :param buffers: of one task, at least one
        :param weights: how often a step of each is drawn beside one of weight 1
        :raises DatasetError: other observations, actions or environments than the first one's
        """
        first, source = buffers[0], " + ".join(buffer.source for buffer in buffers)
        for other in buffers[1:]:
            sizes = other.observation_space.shape == first.observation_space.shape
            if not sizes or other.action_space != first.action_space:
                held = [
                    f"{each.source} holds {each.observation_space.shape}, {each.action_space}" for each in (first, other)
                ]
                raise DatasetError(f"{source}: other observations or actions cannot be joined: {'; '.join(held)}.")
        named = next((buffer for buffer in buffers if buffer.env_id is not None), first)
        for other in buffers:
            if other.env_id is not None:
                named.check_task(other.env_id)
        tensors = {
            name: th.cat([getattr(each, name).index_select(0, each.rows).to(first.observations.device) for each in buffers])
            for name in STEP_ARRAYS
        }
        table = EpisodeTable(*map(np.concatenate, zip(*(each.episodes for each in buffers), strict=True)))
        table = table._replace(starts=np.cumsum(table.lengths) - table.lengths)
        joined = cls(tensors, table, first.observation_space, first.action_space, source, env_id=named.env_id)
        if len({buffer.score_reference for buffer in buffers}) == 1:
            joined.score_reference = first.score_reference
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
            raise ValueError(f"dataset_fraction must lie in (0, 1], got {fraction}.")
        if fraction == 1.0:
            return self
        n_kept = max(1, round(fraction * self.n_episodes))
        return self.select(np.sort(np.random.default_rng(seed).permutation(self.n_episodes)[:n_kept]))

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write the buffer's own steps as flat arrays, which `dataset=` and `--dataset` take.

        :param path: of the file; `.npz` is added where it is missing
        :raises OSError: it cannot be written; what was there before still is
        """
        path = Path(path)
        path = path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")
        rows, stops = self.rows, self._stops.cpu().numpy()
        ended = {name: np.zeros(len(self), bool) for name in ("terminations", "truncations")}
        ended["terminations"][stops - 1], ended["truncations"][stops - 1] = self.terminated, self.truncated
        steps = {
            name: getattr(self, name).index_select(0, rows).cpu().numpy() for name in ("observations", "actions", "rewards")
        }
        steps["actions"] = from_vectors(steps["actions"], self.action_space)
        space = dict(zip(("action_low", "action_high"), bounds_of(self.action_space), strict=True))
        named = {} if self.env_id is None else {"env_id": np.array(self.env_id)}
        silent = np.isnan(self.successes)
        if not silent.all():
            named["successes"] = self.successes if silent.any() else self.successes.astype(bool)
        with replacing(path) as beside, open(beside, "wb") as file:
            np.savez(file, **steps, **ended, episode_ends=stops, **space, **named)

    def to(self, device: th.device | str) -> "TrajectoryBuffer":
        """
        The same buffer for batches on a device.

        Its tensors move there if they take at most half of the memory that is free; otherwise each batch moves.
        """
        moved = copy.copy(self)
        moved.device = th.device(device)
        tensors = {name: getattr(self, name) for name in STEP_ARRAYS}
        if moved.device.type == "cuda":
            free, _ = th.cuda.mem_get_info(moved.device)
            if sum(tensor.nbytes for tensor in tensors.values()) > DEVICE_MEMORY_SHARE * free:
                return moved
        for name, tensor in tensors.items():
            setattr(moved, name, tensor.to(moved.device))
        moved.device = moved.observations.device
        moved._maps = self._maps if moved.device.type == "cpu" else ()
        moved._set_episodes(self.episodes)
        return moved

    def batches(
        self,
        batch_size: int,
        context_length: int,
        generator: th.Generator,
        timestep_exponent: float = 1.0,
        n_ahead: int = 0,
        return_weight: float = 0.0,
        seeds: Iterable[int] | None = None,
    ) -> Iterator[Windows]:
        """
        Endless batches of windows, each drawn before the one before it is handed out.

        So the windows of a cache are on their way from the disk while the caller is busy with the batch before.

        :param batch_size: B
        :param context_length: K
        :param generator: source of randomness, of nothing else: it is a batch ahead
        :param timestep_exponent: e of the time step T u^e in an episode of T steps, for u uniform in [0, 1]; 1 draws any
            step of any episode with equal probability
        :param n_ahead: see :meth:`windows`
        :param return_weight: w: a step of an episode of return R is drawn 1 + w (R - Rmin) / (Rmax - Rmin) times as often as
            one of the worst episode (Yue et al., 2022)
        :param seeds: what `generator` is seeded with before it draws, one number a batch: where each is its own, a run that
            goes on draws what it would have drawn. Without them the generator draws on
        """
        differ = return_weight > 0 or (self.weights != self.weights[0]).any()
        weights = self._episode_weights(return_weight).to(generator.device) if differ else None

        def ends() -> Iterator[th.Tensor]:
            for seed in itertools.repeat(None) if seeds is None else seeds:
                if seed is not None:
                    generator.manual_seed(seed)
                drawn = self._draw(batch_size, generator, timestep_exponent, weights)
                self._prefetch(drawn, context_length, n_ahead)
                yield drawn

        for present, _ in itertools.pairwise(ends()):
            self._present = present
            yield self.windows(present, context_length, n_ahead)

    def present_episodes(self) -> np.ndarray:
        """The episodes that the newest batch of :meth:`batches` is from: their indices among the buffer's own, in order."""
        return th.searchsorted(self._stops, self._present, right=True).unique().cpu().numpy()

    def sample(self, batch_size: int, context_length: int, generator: th.Generator | None = None) -> Windows:
        """
        Windows that end at any step of any episode with equal probability.

        :param batch_size: B
        :param context_length: K
        :param generator: source of randomness
        """
        return self.windows(self._draw(batch_size, generator), context_length)

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
        discounted = self.rewards.index_select(0, ahead).view(-1, n_steps) * gamma**steps
        goes_on = n_left >= n_steps
        batch = Transitions(
            observations=self.observations.index_select(0, rows),
            actions=self.actions.index_select(0, ahead).view(len(rows), -1),
            rewards=(discounted * (steps <= n_left.unsqueeze(1))).sum(dim=1),
            next_observations=self.observations.index_select(0, rows + th.minimum(steps[-1] + 1, n_left)),
            discounts=gamma**n_steps * goes_on,
            mask=goes_on | terminated,
        )
        return Transitions(*(tensor.to(self.device) for tensor in batch))

    def _episode_weights(self, return_weight: float) -> th.Tensor:
        """(E,) float32, with what probability an episode is drawn, up to a factor: by its length, its weight, its return."""
        returns = self.episodes.returns - self.episodes.returns.min()
        by_return = 1.0 + return_weight * returns / (returns.max() or 1.0)
        return th.from_numpy(self.weights * self.episodes.lengths * by_return).float()

    def _draw(
        self,
        batch_size: int,
        generator: th.Generator | None,
        timestep_exponent: float = 1.0,
        episode_weights: th.Tensor | None = None,
    ) -> th.Tensor:
        """Ends of windows as for :meth:`windows`, drawn where the generator is; see :meth:`batches`."""
        device = self.device if generator is None else generator.device
        if episode_weights is not None:
            episodes = th.multinomial(episode_weights, batch_size, True, generator=generator).to(self._stops.device)
        else:
            positions = th.randint(len(self), (batch_size,), generator=generator, device=device).to(self._stops.device)
            if timestep_exponent == 1.0:
                return positions
            episodes = th.searchsorted(self._stops, positions, right=True)
        u = th.rand(batch_size, generator=generator, device=device).to(self._stops.device)
        firsts, lasts = self._firsts[episodes], self._stops[episodes] - 1
        timesteps = ((lasts + 1 - firsts) * u**timestep_exponent).long()
        return th.minimum(firsts + timesteps, lasts)  # a product may round to T

    def _prefetch(self, ends: th.Tensor, context_length: int, n_ahead: int) -> None:
        """Start to read windows from disk, if that is where they are, so that :meth:`windows` need not wait for them."""
        if self.memory_mapped:
            rows, _, n_left = self._locate(ends)
            for steps in self._maps:
                ahead = n_ahead if steps.name == "actions" else 0
                steps.will_need((rows + n_left.clamp(max=ahead) + 1).tolist(), context_length + ahead)

    def windows(self, ends: th.Tensor, context_length: int, n_ahead: int = 0) -> Windows:
        """
        The windows of K steps that end at the given steps, actions in the environment's range.

        :param ends: (B,) int64 positions among the buffer's own steps, episode after episode
        :param context_length: K
        :param n_ahead: actions after the newest step that `actions` (B, K + n_ahead, A) holds too; where the episode ends,
            its last one again and again
        """
        last_rows, last_timesteps, n_left = self._locate(ends.to(self._stops.device))
        back = th.arange(1 - context_length, 1, device=last_rows.device)
        timesteps = last_timesteps.unsqueeze(1) + back  # (B, K), negative before the episode's start
        mask = timesteps >= 0
        rows = (last_rows.unsqueeze(1) + back).clamp_(min=0).flatten()
        shape = (len(ends), context_length, -1)
        valid = mask.unsqueeze(-1)
        batch = Windows(
            observations=self.observations.index_select(0, rows).view(shape) * valid,
            actions=self.actions.index_select(0, rows).view(shape) * valid,
            returns_to_go=self.returns_to_go.index_select(0, rows).view(mask.shape) * mask,
            timesteps=timesteps.clamp_(min=0),
            mask=mask,
        )
        if n_ahead:
            ahead = th.arange(1, n_ahead + 1, device=last_rows.device)
            rows_ahead = last_rows.unsqueeze(1) + th.minimum(ahead, n_left.unsqueeze(1))
            actions_ahead = self.actions.index_select(0, rows_ahead.flatten()).view(len(ends), n_ahead, -1)
            batch = batch._replace(actions=th.cat((batch.actions, actions_ahead), dim=1))
        if self.device.type == rows.device.type:
            return batch
        return Windows(*(tensor.pin_memory().to(self.device, non_blocking=True) for tensor in batch))

    def _locate(self, positions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Of positions among the buffer's own steps: rows in the flat tensors, time steps, and steps left in the episode."""
        episodes = th.searchsorted(self._stops, positions, right=True)
        timesteps = positions - self._firsts[episodes]
        return self._starts[episodes] + timesteps, timesteps, self._stops[episodes] - 1 - positions


def _checked(
    trajectories: Iterable[Trajectory],
    check: Callable[[Trajectory], np.ndarray],
    dropped: list[DatasetError],
    on_invalid: str,
) -> Iterator[tuple[Trajectory, np.ndarray]]:
    """
    Episodes that pass a check, each with what the check made of it.

    :param dropped: gets the reason for each other one, where `on_invalid` is "drop"
    """
    iterator = iter(trajectories)
    while True:
        try:
            trajectory = next(iterator)
            checked = check(trajectory)
        except StopIteration:
            return
        except DatasetError as error:
            if on_invalid == "raise":
                raise
            dropped.append(error)
        else:
            yield trajectory, checked


def _episode_row(trajectory: Trajectory, start: int, to_go: np.ndarray) -> tuple:
    """A row of an `EpisodeTable`."""
    return (
        start,
        len(trajectory),
        to_go[0],  # the return: the sum of all rewards in float64
        trajectory.terminated,
        trajectory.truncated,
        np.nan if trajectory.success is None else float(trajectory.success),
        *moments(trajectory.observations),
        max(to_go.max(), -to_go.min()),
    )
