"""Many short episodes together: one by one, a million of them take minutes of Python."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from sb3_dtfm.data.episodes import EpisodeTable
from sb3_dtfm.data.trajectories import Trajectory

# Steps from which on an episode is read by itself, and most steps of episodes that are read together.
LONG, MOST_STEPS = 64, 2**18


class ShortEpisodes(NamedTuple):
    """
    E episodes of fewer than `LONG` steps, one after the other.

    :param steps: all their steps, as if they were one episode
    :param lengths: (E,) int64
    :param terminated: (E,) bool
    :param truncated: (E,) bool
    :param successes: (E,) float64: 1, 0, or NaN where the data do not tell
    :param one_by_one: function that returns each by itself, where one of them has to be named or left out
    """

    steps: Trajectory
    lengths: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    successes: np.ndarray
    one_by_one: Callable[[], Iterator[Trajectory]]

    def table(self, start: int) -> tuple[EpisodeTable, np.ndarray]:
        """
        Their rows of an `EpisodeTable`, and the returns-to-go of all steps, (T,) float64.

        Episodes of the same length are rows of one matrix: the arithmetic is that of one episode by itself, see
        :func:`~sb3_dtfm.data.trajectories.returns_to_go`.

        :param start: row of the first step in the flat step arrays
        """
        n_episodes, n_columns = len(self.lengths), self.steps.observations.shape[1]
        starts = np.cumsum(self.lengths) - self.lengths
        to_go = np.empty(len(self.steps))
        means, squares = (np.empty((n_episodes, n_columns)) for _ in range(2))
        for length in np.unique(self.lengths):
            episodes = np.flatnonzero(self.lengths == length)
            rows = starts[episodes, None] + np.arange(length)
            rewards = np.asarray(self.steps.rewards, np.float64)[rows]
            accumulated = np.concatenate([rewards.sum(axis=1, keepdims=True), rewards[:, :-1]], axis=1)
            to_go[rows] = np.subtract.accumulate(accumulated, axis=1)
            observations = self.steps.observations[rows].astype(np.float64)
            first = observations[:, :1].copy()
            observations -= first  # so that what is constant has no deviation
            offset = observations.mean(axis=1)
            means[episodes] = first[:, 0] + offset
            squares[episodes] = np.square(observations - offset[:, None]).sum(axis=1)
        scales = np.maximum.reduceat(np.abs(to_go), starts)
        flags = (self.terminated, self.truncated, self.successes)
        return EpisodeTable(start + starts, self.lengths, to_go[starts], *flags, means, squares, scales), to_go


def blocks(stops: np.ndarray) -> Iterator[tuple[int, int]]:
    """
    Choose which episodes to read together: short ones that lie side by side, and each long one by itself.

    :param stops: (E,) int64, the step after each episode's last one
    :return: pairs of the first episode and the one after the last
    """
    long = np.flatnonzero(np.diff(stops, prepend=0) >= LONG)
    first = 0
    while first < len(stops):
        begin = stops[first - 1] if first else 0
        last = int(np.searchsorted(stops, begin + MOST_STEPS, side="right"))
        next_long = np.searchsorted(long, first)
        if next_long < len(long):
            last = min(last, int(long[next_long]))
        end = max(last, first + 1)
        yield first, end
        first = end
