"""Flat tensors of steps, where episodes lie in them, and how windows are drawn."""

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch as th

from sb3_dtfm.data.episodes import EpisodeTable
from sb3_dtfm.data.storage import STEP_ARRAYS, MappedSteps
from sb3_dtfm.windows import OBSERVATION, Windows


def channels_first(images: th.Tensor) -> th.Tensor:
    """Bring (R, height, width, channels), or channels first, to (R, channels, height, width): a view of the same numbers."""
    return images if images.shape[1] == min(images.shape[1:]) else images.movedim(3, 1)


class FlatSteps:
    """
    Steps of episodes in flat float32 tensors, drawn as windows that may end at any step.

    :param tensors: tensors (N, ...) for each of `STEP_ARRAYS`, and images by camera
    :param episodes: table of the buffer's own episodes, which need not be all that lie in the tensors
    :param maps: memory-mapped arrays among those that windows read; empty in memory
    :ivar stored: the tensors, which buffers of other episodes share; the buffer's own steps lie at `rows`. To read them,
        take `observations`, `actions`, `rewards` and `returns_to_go`, which are the own ones alone
    """

    def __init__(self, tensors: dict[str, th.Tensor], episodes: EpisodeTable, maps: Sequence[MappedSteps] = ()) -> None:
        self.stored = dict(tensors)
        self.cameras = [name for name in tensors if name not in STEP_ARRAYS]
        self.device = tensors["observations"].device
        self.weights = np.ones(len(episodes.lengths))
        self._maps = maps
        self._present = th.zeros(0, dtype=th.int64)
        self._set_episodes(episodes)

    def _set_episodes(self, episodes: EpisodeTable) -> None:
        self.episodes = episodes
        stops = np.cumsum(episodes.lengths)
        # Positions among the buffer's own steps at which each episode ends, and what leads from a position to its row.
        stored = self.stored["observations"]
        self._stops = th.from_numpy(stops).to(stored.device)
        self._firsts = th.from_numpy(stops - episodes.lengths).to(stored.device)
        self._starts = th.from_numpy(episodes.starts).to(stored.device)
        self._terminated = th.from_numpy(episodes.terminated).to(stored.device)
        self._n_steps = int(stops[-1])
        self._is_whole = self._n_steps == len(stored) and np.array_equal(episodes.starts, stops - episodes.lengths)

    def __len__(self) -> int:
        """Number of the buffer's own steps."""
        return self._n_steps

    @property
    def memory_mapped(self) -> bool:
        """Return whether the flat tensors are files that are read where they are used."""
        return len(self._maps) > 0

    @property
    def observations(self) -> th.Tensor:
        """(len(self), O) float32, of the buffer's own steps, episode after episode."""
        return self.own("observations")

    @property
    def actions(self) -> th.Tensor:
        """(len(self), A) float32, in the environment's range; Discrete ones as vectors."""
        return self.own("actions")

    @property
    def rewards(self) -> th.Tensor:
        """(len(self),) float32, environment reward units."""
        return self.own("rewards")

    @property
    def returns_to_go(self) -> th.Tensor:
        """(len(self),) float32, environment reward units."""
        return self.own("returns_to_go")

    def own(self, name: str) -> th.Tensor:
        """An array's rows of the buffer's own steps; a copy where the tensor holds others, too."""
        return self.stored[name] if self._is_whole else self.stored[name].index_select(0, self.rows)

    @property
    def timesteps(self) -> th.Tensor:
        """(len(self),) int64, the buffer's own steps counted from their episodes' starts; made anew at each call."""
        lengths = th.from_numpy(self.episodes.lengths).to(self._firsts.device)
        return th.arange(len(self), device=lengths.device) - self._firsts.repeat_interleave(lengths)

    @property
    def rows(self) -> th.Tensor:
        """(len(self),) int64, where the buffer's own steps lie in the stored tensors; made anew at each call."""
        return self._locate(th.arange(len(self), device=self._stops.device))[0]

    def batches(
        self,
        batch_size: int,
        context_length: int,
        generator: th.Generator,
        n_ahead: int = 0,
        return_weighting: float = 0.0,
        seeds: Iterable[int] | None = None,
    ) -> Iterator[Windows]:
        """
        Endless batches of windows, each drawn before the one before it is handed out.

        So the windows of a cache are on their way from the disk while the caller is busy with the batch before.

        :param batch_size: B
        :param context_length: K
        :param generator: source of randomness for nothing else, since it is a batch ahead
        :param n_ahead: see :meth:`windows`
        :param return_weighting: w: a step of an episode of return R is drawn 1 + w (R - Rmin) / (Rmax - Rmin) times as often
            as one of the worst episode (Yue et al., 2022)
        :param seeds: seeds of `generator`, one for each batch: a resumed run then draws what it would have drawn. Without
            them the generator draws on
        """
        differ = return_weighting > 0 or (self.weights != self.weights[0]).any()
        weights = self._episode_weights(return_weighting).to(generator.device) if differ else None

        def ends() -> Iterator[th.Tensor]:
            for seed in itertools.repeat(None) if seeds is None else seeds:
                if seed is not None:
                    generator.manual_seed(seed)
                drawn = self._draw(batch_size, generator, weights)
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

    def _episode_weights(self, return_weighting: float) -> th.Tensor:
        """(E,) float32, probability of drawing each episode, up to a factor: by its length, its weight and its return."""
        returns = self.episodes.returns - self.episodes.returns.min()
        by_return = 1.0 + return_weighting * returns / (returns.max() or 1.0)
        return th.from_numpy(self.weights * self.episodes.lengths * by_return).float()

    def _draw(self, batch_size: int, generator: th.Generator | None, episode_weights: th.Tensor | None = None) -> th.Tensor:
        """Ends of windows as for :meth:`windows`, drawn where the generator is; see :meth:`batches`."""
        device = self.device if generator is None else generator.device
        if episode_weights is None:
            return th.randint(len(self), (batch_size,), generator=generator, device=device).to(self._stops.device)
        episodes = th.multinomial(episode_weights, batch_size, True, generator=generator).to(self._stops.device)
        u = th.rand(batch_size, generator=generator, device=device).to(self._stops.device)
        firsts, lasts = self._firsts[episodes], self._stops[episodes] - 1
        timesteps = ((lasts + 1 - firsts) * u).long()
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
            observations=self.stored["observations"].index_select(0, rows).view(shape) * valid,
            actions=self.stored["actions"].index_select(0, rows).view(shape) * valid,
            returns_to_go=self.stored["returns_to_go"].index_select(0, rows).view(mask.shape) * mask,
            timesteps=timesteps.clamp_(min=0),
            mask=mask,
        )
        if self.cameras:
            batch = batch._replace(observations={OBSERVATION: batch.observations, **self.images(rows, mask.shape)})
        if n_ahead:
            ahead = th.arange(1, n_ahead + 1, device=last_rows.device)
            rows_ahead = last_rows.unsqueeze(1) + th.minimum(ahead, n_left.unsqueeze(1))
            actions_ahead = self.stored["actions"].index_select(0, rows_ahead.flatten()).view(len(ends), n_ahead, -1)
            batch = batch._replace(actions=th.cat((batch.actions, actions_ahead), dim=1))
        if self.device.type == rows.device.type:
            return batch
        return batch.map(lambda tensor: tensor.pin_memory().to(self.device, non_blocking=True))

    def images(self, rows: th.Tensor, shape: Sequence[int]) -> dict[str, th.Tensor]:
        """
        Images by camera, (*shape, channels, height, width) uint8, of these rows of the stored tensors.

        :param rows: (R,) int64, rows of the stored tensors
        :param shape: leading shape of the images, R in all
        """
        found = {camera: self.stored[camera].index_select(0, rows) for camera in self.cameras}
        return {camera: channels_first(image).unflatten(0, tuple(shape)) for camera, image in found.items()}

    def _locate(self, positions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return rows in the flat tensors, time steps and steps left in the episode, for positions among own steps."""
        episodes = th.searchsorted(self._stops, positions, right=True)
        timesteps = positions - self._firsts[episodes]
        return self._starts[episodes] + timesteps, timesteps, self._stops[episodes] - 1 - positions
