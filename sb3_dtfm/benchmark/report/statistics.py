"""
The statistics of a comparison: intervals, and the aggregates of Agarwal et al. (2021, https://arxiv.org/abs/2108.13264).

Pure functions of numbers. Scores come as a list of arrays, one array of runs for each combination of a task and a share
of its data, which may have different numbers of runs.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
N_BOOTSTRAP = 2000

Scores = Sequence[np.ndarray]


class Interval(NamedTuple):
    """An estimate and the limits of its 95 % interval, which are NaN where the data give none."""

    estimate: float
    low: float = math.nan
    high: float = math.nan


def wilson(n_successes: int, n_episodes: int) -> Interval:
    """
    Success rate in [0, 1] with its Wilson score interval.

    :raises ValueError: no episode, or more successes than episodes
    """
    if not 0 <= n_successes <= n_episodes or n_episodes == 0:
        raise ValueError(f"n_successes must be in 0 to n_episodes, which is at least 1; got {n_successes} of {n_episodes}")
    interval = stats.binomtest(n_successes, n_episodes).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(n_successes / n_episodes, float(interval.low), float(interval.high))


def student_t(values: Sequence[float] | np.ndarray) -> Interval:
    """Mean with Student's t interval; values that do not spread, as a single one, have no interval."""
    return t_interval(*mean_and_deviation(values), len(values))


def t_interval(mean: float, deviation: float | None, n: int) -> Interval:
    """The same for n values by their mean and sample standard deviation, which a single value does not have."""
    if not deviation or not deviation > 0:
        return Interval(mean)
    half = stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1) * deviation / math.sqrt(n)
    return Interval(mean, mean - float(half), mean + float(half))


def mean_and_deviation(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean and sample standard deviation (n - 1); the deviation of a single value is NaN."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def interquartile_mean(scores: Scores) -> float:
    """Mean of the middle half of all runs of all combinations: a quarter, rounded down, is left out at each end."""
    ordered = np.sort(np.concatenate(scores))
    n_cut = len(ordered) // 4
    return float(ordered[n_cut : len(ordered) - n_cut].mean())


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """
    Probability that a run of the first algorithm beats one of the second, averaged over combinations; a tie counts half.

    :param scores: runs of the first algorithm, one array for each combination
    :param others: runs of the second, the combinations in the same order
    """
    shares = []
    for mine, theirs in zip(scores, others, strict=True):
        differences = np.asarray(mine, float)[:, None] - np.asarray(theirs, float)[None, :]
        shares.append(np.mean(differences > 0) + 0.5 * np.mean(differences == 0))
    return float(np.mean(shares))


def n_single_runs(*scores: Scores) -> int:
    """Combinations in which an algorithm has a single run, which tells no spread."""
    return sum(any(len(runs) < 2 for runs in combination) for combination in zip(*scores, strict=True))


def bootstrap(
    statistic: Callable[..., float], tasks: Sequence[str], *scores: Scores, n_resamples: int = N_BOOTSTRAP, seed: int = 0
) -> Interval:
    """
    Percentile interval of a statistic, for a claim about tasks like these and not about these alone.

    The choice of tasks is chance as well. So tasks are drawn anew, each with all its combinations since those are of a
    kind, and then runs within each combination (the bootstrap over tasks and runs of Agarwal et al., 2021). It errs on the
    wide side: the runs' own spread is in that of the tasks already. For a single task it is the bootstrap over its runs.

    :param statistic: function from as many lists of arrays as are given to a number
    :param tasks: task of each combination
    :param scores: scores of each algorithm, one array of runs for each combination
    :param n_resamples: number of draws
    :param seed: seed of the draws
    :return: estimate and limits; no limits where a combination has a single run, which would count as exact
    """
    estimate = statistic(*scores)
    if n_single_runs(*scores):
        return Interval(estimate)
    generator = np.random.default_rng(seed)
    combinations = [[i for i, each in enumerate(tasks) if each == task] for task in dict.fromkeys(tasks)]
    draws = []
    for _ in range(n_resamples):
        drawn = [i for task in generator.integers(len(combinations), size=len(combinations)) for i in combinations[task]]
        draws.append(
            statistic(*([runs[i][generator.integers(len(runs[i]), size=len(runs[i]))] for i in drawn] for runs in scores))
        )
    low, high = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(estimate, float(low), float(high))
