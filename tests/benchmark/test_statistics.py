"""Against numbers worked out by hand, and against scipy."""

import math

import numpy as np
import pytest
from scipy import stats

from sb3_dtfm.benchmark.report.statistics import (
    bootstrap,
    interquartile_mean,
    mean_and_deviation,
    n_single_runs,
    probability_of_improvement,
    student_t,
    wilson,
)


def overall_mean(scores) -> float:
    return float(np.concatenate(scores).mean())


def test_wilson_interval_by_hand():
    # 0.5 of 100: center 0.5, half width 1.96 / (1 + 0.038415) * sqrt(0.0025 + 0.000096)
    assert wilson(50, 100) == pytest.approx((0.5, 0.40383, 0.59617), abs=1e-5)
    # No failure in 10: high is 1, low is 10 / (10 + 1.96^2)
    assert wilson(10, 10) == pytest.approx((1.0, 10 / (10 + 1.959964**2), 1.0), abs=1e-6)


@pytest.mark.parametrize(("n_successes", "n_episodes"), [(0, 0), (-1, 5), (6, 5)])
def test_wilson_refuses_impossible_counts(n_successes, n_episodes):
    with pytest.raises(ValueError, match=f"0 to n_episodes.*got {n_successes} of {n_episodes}"):
        wilson(n_successes, n_episodes)


def test_students_interval_by_hand_and_by_scipy():
    # Mean 2, standard deviation 1, t(0.975; 2) = 4.302653
    half = 4.302653 / math.sqrt(3)
    assert student_t([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.0 - half, 2.0 + half), abs=1e-6)
    values = np.random.default_rng(0).normal(size=6)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert student_t(values)[1:] == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize("values", [[5.0], [5.0, 5.0, 5.0]])
def test_what_does_not_spread_has_no_interval(values):
    estimate, low, high = student_t(values)
    assert estimate == 5.0
    assert math.isnan(low)
    assert math.isnan(high)


def test_a_single_run_has_no_deviation():
    mean, deviation = mean_and_deviation([5.0])
    assert mean == 5.0
    assert math.isnan(deviation)


def test_the_deviation_is_the_samples():
    assert mean_and_deviation([1.0, 3.0]) == pytest.approx((2.0, math.sqrt(2)))


def test_interquartile_mean_leaves_out_both_ends_of_all_combinations_together():
    assert interquartile_mean([np.array([1000.0, 1.0]), np.array([3.0, -1000.0])]) == 2.0
    # A quarter of seven values, rounded down, is one at each end
    assert interquartile_mean([np.array([9.0, 1.0, 2.0]), np.array([3.0, 4.0, -9.0, 5.0])]) == 3.0


def test_probability_of_improvement_by_hand():
    # Among 4 pairs 2 > 1 and 2 > 0 win, 0 against 0 is a tie, and 0 against 1 is lost
    assert probability_of_improvement([np.array([2.0, 0.0])], [np.array([1.0, 0.0])]) == 2.5 / 4
    # Tasks count alike, whatever their numbers of runs
    scores, others = [np.array([1.0]), np.array([0.0, 0.0, 0.0])], [np.array([0.0]), np.array([1.0])]
    assert probability_of_improvement(scores, others) == 0.5


def test_probability_of_improvement_is_mann_whitneys():
    generator = np.random.default_rng(0)
    x, y = generator.integers(0, 5, size=8), generator.integers(0, 5, size=6)
    expected = stats.mannwhitneyu(x, y).statistic / (len(x) * len(y))
    assert probability_of_improvement([x], [y]) == pytest.approx(expected)


def test_the_bootstrap_draws_tasks_as_well_as_runs():
    # Runs of a task are equal, so that all there is to draw are tasks. With two, both draws are the first, the second or one
    # each: means 0 and 1 with probability 1/4 each, so that they are the limits.
    scores = [np.zeros(3), np.ones(3)]
    assert bootstrap(overall_mean, ["a", "b"], scores) == (0.5, 0.0, 1.0)


def test_combinations_of_a_task_are_drawn_together():
    # Half and full data of one task are no two tasks: whatever is drawn, both are there.
    scores = [np.zeros(3), np.ones(3)]
    assert bootstrap(overall_mean, ["a", "a"], scores) == (0.5, 0.5, 0.5)


def test_the_bootstrap_over_tasks_agrees_with_scipys_of_their_means():
    means = np.random.default_rng(1).normal(size=30)
    ours = bootstrap(overall_mean, [str(i) for i in range(30)], [np.full(2, mean) for mean in means], n_resamples=4000)
    theirs = stats.bootstrap((means,), np.mean, n_resamples=4000, method="percentile", random_state=0).confidence_interval
    assert ours[1:] == pytest.approx((theirs.low, theirs.high), abs=0.03)


def test_the_bootstrap_of_one_task_agrees_with_scipys_of_its_runs():
    values = np.random.default_rng(1).normal(size=40)
    ours = bootstrap(overall_mean, ["a"], [values], n_resamples=4000)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=4000, method="percentile", random_state=0).confidence_interval
    assert ours[1:] == pytest.approx((theirs.low, theirs.high), abs=0.03)


def test_algorithms_are_drawn_on_the_same_tasks():
    # The second is better by 1 on both tasks, which differ by 100: were tasks drawn for each, it would lose now and then.
    scores, others = [np.array([1.0, 1.0]), np.array([101.0, 101.0])], [np.array([0.0, 0.0]), np.array([100.0, 100.0])]
    assert bootstrap(probability_of_improvement, ["a", "b"], scores, others) == (1.0, 1.0, 1.0)
    assert bootstrap(lambda a, b: overall_mean(a) - overall_mean(b), ["a", "b"], scores, others) == (1.0, 1.0, 1.0)


def test_the_bootstrap_repeats():
    scores, others = [np.array([1.0, 2.0, 4.0])], [np.array([0.0, 3.0])]
    first = bootstrap(probability_of_improvement, ["a"], scores, others)
    assert first == bootstrap(probability_of_improvement, ["a"], scores, others)
    assert first.low <= first.estimate <= first.high


def test_a_combination_with_a_single_run_leaves_no_interval():
    scores, others = [np.array([1.0, 2.0]), np.array([3.0, 4.0])], [np.array([0.0]), np.array([1.0, 5.0])]
    assert (n_single_runs(scores, others), n_single_runs(others), n_single_runs(scores)) == (1, 1, 0)
    estimate, low, high = bootstrap(probability_of_improvement, ["a", "b"], scores, others)
    assert estimate == 0.75
    assert math.isnan(low)
    assert math.isnan(high)
    assert not math.isnan(bootstrap(interquartile_mean, ["a", "b"], scores).low)
