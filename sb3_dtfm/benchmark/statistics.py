"""
The statistics of a comparison: intervals, and the aggregates of Agarwal et al. (2021, https://arxiv.org/abs/2108.13264).

Pure functions of numbers. Scores of several tasks come as a list of arrays, one array of runs for each task: tasks may
have different numbers of runs.
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
    low: float
    high: float


def wilson(n_successes: int, n_episodes: int) -> Interval:
    """
    Success rate in [0, 1] with its Wilson score interval.

    :param n_successes: episodes that succeeded
    :param n_episodes: all of them
    :raises ValueError: no episode, or more successes than episodes
    """
    if not 0 <= n_successes <= n_episodes or n_episodes == 0:
        raise ValueError(f"n_successes must lie in [0, n_episodes] and n_episodes be positive: {n_successes}, {n_episodes}.")
    interval = stats.binomtest(n_successes, n_episodes).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(n_successes / n_episodes, float(interval.low), float(interval.high))


def student_t(values: Sequence[float] | np.ndarray) -> Interval:
    """Mean with Student's t interval; a single value has no interval."""
    array = np.asarray(values, float)
    mean = float(array.mean())
    if len(array) < 2:
        return Interval(mean, math.nan, math.nan)
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(array) - 1) * array.std(ddof=1) / math.sqrt(len(array)))
    return Interval(mean, mean - half, mean + half)


def mean_and_deviation(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean and sample standard deviation (n - 1); the deviation of a single value is NaN."""
    array = np.asarray(values, float)
    return float(array.mean()), float(array.std(ddof=1)) if len(array) > 1 else math.nan


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half: a quarter of the values, rounded down, is left out at each end."""
    ordered = np.sort(np.asarray(values, float), axis=None)
    n_cut = len(ordered) // 4
    return float(ordered[n_cut : len(ordered) - n_cut].mean())


def pooled_interquartile_mean(scores: Scores) -> float:
    """Interquartile mean over all runs of all tasks."""
    return interquartile_mean(np.concatenate(scores))


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """
    Probability that a run of the first algorithm beats one of the second, averaged over tasks; a tie counts half.

    :param scores: runs of the first algorithm, one array for each task
    :param others: runs of the second, the tasks in the same order
    """
    shares = []
    for mine, theirs in zip(scores, others, strict=True):
        differences = np.asarray(mine, float)[:, None] - np.asarray(theirs, float)[None, :]
        shares.append(np.mean(differences > 0) + 0.5 * np.mean(differences == 0))
    return float(np.mean(shares))


def stratified_bootstrap(
    statistic: Callable[..., float], *scores: Scores, n_resamples: int = N_BOOTSTRAP, seed: int = 0
) -> Interval:
    """
    Percentile bootstrap that draws runs anew within each task, so that every task keeps its number of runs.

    :param statistic: of as many lists of arrays as are given
    :param scores: for each algorithm, one array of runs for each task
    :param n_resamples: draws
    :param seed: of the draws
    :return: estimate and limits; the limits are NaN where no task has two runs, as nothing is left to draw
    """
    estimate = statistic(*scores)
    if max(len(runs) for algorithm in scores for runs in algorithm) < 2:
        return Interval(estimate, math.nan, math.nan)
    generator = np.random.default_rng(seed)
    draws = [
        statistic(*([runs[generator.integers(len(runs), size=len(runs))] for runs in algorithm] for algorithm in scores))
        for _ in range(n_resamples)
    ]
    low, high = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(estimate, float(low), float(high))
