"""Against numbers worked out by hand, and against scipy."""

import math

import numpy as np
import pytest
from scipy import stats

from sb3_dtfm.benchmark.statistics import (
    interquartile_mean,
    mean_and_deviation,
    pooled_interquartile_mean,
    probability_of_improvement,
    stratified_bootstrap,
    student_t,
    wilson,
)


def test_wilson_interval_by_hand():
    # 0.5 of 100: center 0.5, half width 1.96 / (1 + 0.038415) * sqrt(0.0025 + 0.000096)
    assert wilson(50, 100) == pytest.approx((0.5, 0.40383, 0.59617), abs=1e-5)
    # No failure in 10: high is 1, low is 10 / (10 + 1.96^2)
    assert wilson(10, 10) == pytest.approx((1.0, 10 / (10 + 1.959964**2), 1.0), abs=1e-6)


@pytest.mark.parametrize(("n_successes", "n_episodes"), [(0, 7), (3, 7), (7, 7), (97, 100), (149, 150)])
def test_wilson_interval_is_scipys(n_successes, n_episodes):
    expected = stats.binomtest(n_successes, n_episodes).proportion_ci(0.95, method="wilson")
    assert wilson(n_successes, n_episodes)[1:] == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize(("n_successes", "n_episodes"), [(0, 0), (-1, 5), (6, 5)])
def test_wilson_refuses_impossible_counts(n_successes, n_episodes):
    with pytest.raises(ValueError, match="n_successes"):
        wilson(n_successes, n_episodes)


def test_students_interval_by_hand_and_by_scipy():
    # Mean 2, standard deviation 1, t(0.975; 2) = 4.302653
    half = 4.302653 / math.sqrt(3)
    assert student_t([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.0 - half, 2.0 + half), abs=1e-6)
    values = np.random.default_rng(0).normal(size=6)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert student_t(values)[1:] == pytest.approx((expected.low, expected.high))


def test_a_single_run_has_neither_interval_nor_deviation():
    estimate, low, high = student_t([5.0])
    assert estimate == 5.0
    assert math.isnan(low)
    assert math.isnan(high)
    mean, deviation = mean_and_deviation([5.0])
    assert mean == 5.0
    assert math.isnan(deviation)


def test_the_deviation_is_the_samples():
    assert mean_and_deviation([1.0, 3.0]) == pytest.approx((2.0, math.sqrt(2)))


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7, 8, 12, 30])
def test_interquartile_mean_is_scipys_trimmed_mean(n):
    values = np.random.default_rng(n).normal(size=n)
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25))


def test_interquartile_mean_leaves_out_both_ends():
    assert interquartile_mean(np.array([-1000.0, 1.0, 3.0, 1000.0])) == 2.0
    assert pooled_interquartile_mean([np.array([1000.0, 1.0]), np.array([3.0, -1000.0])]) == 2.0


def test_probability_of_improvement_by_hand():
    # Of 4 pairs, 2 > 1 and 2 > 0 win, 0 against 0 is a tie, and 0 against 1 is lost
    assert probability_of_improvement([np.array([2.0, 0.0])], [np.array([1.0, 0.0])]) == 2.5 / 4
    # Tasks count alike, whatever their numbers of runs
    scores, others = [np.array([1.0]), np.array([0.0, 0.0, 0.0])], [np.array([0.0]), np.array([1.0])]
    assert probability_of_improvement(scores, others) == 0.5


def test_probability_of_improvement_is_mann_whitneys():
    generator = np.random.default_rng(0)
    x, y = generator.integers(0, 5, size=8), generator.integers(0, 5, size=6)
    expected = stats.mannwhitneyu(x, y).statistic / (len(x) * len(y))
    assert probability_of_improvement([x], [y]) == pytest.approx(expected)


def test_the_bootstrap_draws_within_each_task():
    # Runs of a task are equal: whatever is drawn, each task keeps its value, and so does the mean over both.
    scores = [np.full(3, 1.0), np.full(5, 9.0)]
    assert stratified_bootstrap(lambda tasks: float(np.concatenate(tasks).mean()), scores) == (6.0, 6.0, 6.0)


def test_the_bootstrap_of_a_mean_agrees_with_scipys():
    values = np.random.default_rng(1).normal(size=40)
    ours = stratified_bootstrap(lambda tasks: float(tasks[0].mean()), [values], n_resamples=4000)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=4000, method="percentile", random_state=0).confidence_interval
    assert ours[1:] == pytest.approx((theirs.low, theirs.high), abs=0.03)


def test_the_bootstrap_repeats():
    scores, others = [np.array([1.0, 2.0, 4.0])], [np.array([0.0, 3.0])]
    first = stratified_bootstrap(probability_of_improvement, scores, others)
    assert first == stratified_bootstrap(probability_of_improvement, scores, others)
    assert first.low <= first.estimate <= first.high


def test_nothing_to_draw_gives_no_interval():
    _, low, high = stratified_bootstrap(pooled_interquartile_mean, [np.array([1.0]), np.array([2.0])])
    assert math.isnan(low)
    assert math.isnan(high)
