"""A buffer's table of episodes, and the statistics of any choice of episodes."""

from typing import NamedTuple

import numpy as np
import torch as th

# Standard deviations at which normalised observations are clipped; a dimension with a smaller one than this is constant.
CLIP, SMALLEST_STD = 10.0, 1e-5
# Rows are summed in blocks of about this many bytes, which stay in the processor's cache.
BLOCK_BYTES = 2**18
# A variance below this share of the mean square is computed again, without the mean.
CANCELLATION = 1e-5
# The robust deviation is this quantile of the episodes' deviations, and at least this share of the standard deviation.
ROBUST_QUANTILE = 0.25
SMALLEST_ROBUST_STD = 0.1


class Statistics(NamedTuple):
    """
    Statistics that normalise inputs.

    Shapes: observation_mean (O,) and observation_std (O,) over all steps, float64; observation_robust_std
    (O,), the lower quartile of the episodes' standard deviations, see :meth:`EpisodeTable.statistics`;
    return_scale, the largest absolute return-to-go in environment reward units.
    """

    observation_mean: np.ndarray
    observation_std: np.ndarray
    observation_robust_std: np.ndarray
    return_scale: float

    def normalize(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: (..., O)
        :return: (..., O), distances from the mean in standard deviations, clipped at 10; a constant dimension becomes zero
        """
        mean, std = (th.as_tensor(each, dtype=th.float32) for each in (self.observation_mean, self.observation_std))
        return ((observations - mean) / th.where(std > SMALLEST_STD, std, th.inf)).clamp(-CLIP, CLIP)


class EpisodeTable(NamedTuple):
    """
    One row per episode.

    Shapes: starts (E,) int64, the episodes' first rows in the flat step arrays; lengths (E,) int64 steps; returns (E,)
    float64, environment reward units; terminated (E,) and truncated (E,) bool; successes (E,) float64, 1 or 0, NaN where the
    data do not tell; observation_means (E, O) float64; observation_squares (E, O) float64, sums of squared deviations from
    these means; return_scales (E,) float64, largest absolute returns-to-go.
    """

    starts: np.ndarray
    lengths: np.ndarray
    returns: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    successes: np.ndarray
    observation_means: np.ndarray
    observation_squares: np.ndarray
    return_scales: np.ndarray

    def select(self, episodes: np.ndarray) -> "EpisodeTable":
        """
        The rows of some of the episodes, in the order given.

        :param episodes: (E',) episode indices
        """
        return EpisodeTable(*(column[episodes] for column in self))

    def statistics(self) -> Statistics:
        """
        Combine the statistics of all episodes of the table, without a look at their steps (Chan et al., 1979).

        If agents of several kinds are mixed, one that rolls on its back stretches the standard deviation of the pitch
        tenfold, and the pitch of the others is lost in the input's third digit. The robust deviation is the lower quartile
        over episodes of the root mean square distance of an episode's steps from the median episode's mean.
        """
        n_steps = self.lengths.sum()
        mean = self.lengths @ self.observation_means / n_steps
        squares = self.observation_squares.sum(axis=0) + self.lengths @ np.square(self.observation_means - mean)
        std = np.sqrt(squares / n_steps)
        offsets = self.observation_means - np.median(self.observation_means, axis=0)
        deviations = np.sqrt(self.observation_squares / self.lengths[:, None] + np.square(offsets))
        robust = np.clip(np.quantile(deviations, ROBUST_QUANTILE, axis=0), SMALLEST_ROBUST_STD * std, std)
        return Statistics(mean, std, robust, float(self.return_scales.max()))


def moments(observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Mean, and sum of squared deviations from it, of each dimension.

    :param observations: (T, O)
    :return: (O,) and (O,) float64
    """
    sums, squares = _power_sums(observations)
    mean = sums / len(observations)
    deviations = squares - mean * sums
    # Rounding hides a deviation that is small beside the mean, and gives a constant dimension one. Sums of differences
    # from the first row do not.
    close = np.flatnonzero(deviations < CANCELLATION * squares)
    if len(close):
        first = observations[0, close].astype(np.float64)
        sums, squares = _power_sums(observations[:, close] - first)
        offset = sums / len(observations)
        mean[close] = first + offset
        deviations[close] = np.maximum(squares - offset * sums, 0.0)
    return mean, deviations


def _power_sums(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Sums of the values and of their squares over the first axis, as products: numpy's own sums take several times as long.

    :param values: (T, O)
    :return: (O,) and (O,) float64
    """
    sums, squares = np.zeros(values.shape[1]), np.zeros(values.shape[1])
    n_rows = max(1, BLOCK_BYTES // (8 * max(1, values.shape[1])))
    for start in range(0, len(values), n_rows):
        block = values[start : start + n_rows].astype(np.float64, copy=False)
        weights = np.ones(len(block))
        sums += weights @ block
        squares += weights @ np.square(block)
    return sums, squares
