"""The return that a buffer suggests: hand-made episodes whose returns have a known cause."""

import numpy as np
import pytest

from sb3_dtfm.data import ReturnReference, TrajectoryBuffer, load_dataset
from sb3_dtfm.data.inspection import explained_by_start, return_reference, suggested_target_return


def buffer_of(starts: np.ndarray, returns: np.ndarray, **arrays) -> TrajectoryBuffer:
    """Episodes of three steps with these first observations and returns; observations after the first one are noise."""
    n, rng = len(returns), np.random.default_rng(1)
    observations = rng.normal(size=(n, 3, starts.shape[1]))
    observations[:, 0] = starts
    rewards = np.zeros((n, 3))
    rewards[:, 2] = returns
    flat = {"observations": observations.reshape(3 * n, -1), "actions": rng.uniform(-1, 1, (3 * n, 1))}
    return load_dataset({**flat, "rewards": rewards.ravel(), "episode_lengths": [3] * n, **arrays}, action_bounds=(-1, 1))


def angles(n: int, seed: int = 0) -> np.ndarray:
    """Pendulum's first observations."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, n)
    return np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(-1, 1, n)])


@pytest.mark.parametrize("n", [20, 50, 700])
def test_returns_that_the_start_decides_are_not_to_be_asked_for_at_their_best(n):
    starts = angles(n)
    returns = 100.0 * starts[:, 0] + 20.0 * np.random.default_rng(2).normal(size=n)
    buffer = buffer_of(starts, returns)
    assert 0.7 < explained_by_start(buffer) <= 1.0
    assert suggested_target_return(buffer) == float(f"{returns.mean():.4g}")


@pytest.mark.parametrize("n", [10, 15, 20, 50, 100])
@pytest.mark.parametrize("width", [1, 3, 17])
def test_noise_is_not_decided_by_the_start(n, width):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        buffer = buffer_of(rng.normal(size=(n, width)), rng.normal(size=n))
        assert explained_by_start(buffer) < 0.5, seed


def test_quality_is_not_the_start():
    """Two agents from the same starts: one reaches ten times as much as the other."""
    starts = np.repeat(angles(15), 2, axis=0)
    returns = np.tile([100.0, 1000.0], 15) + starts[:, 1]
    buffer = buffer_of(starts, returns)
    assert explained_by_start(buffer) == 0.0
    assert suggested_target_return(buffer) == pytest.approx(1000.0, abs=1.0)


def test_too_few_episodes_equal_starts_and_equal_returns_say_nothing():
    starts = angles(30)
    assert explained_by_start(buffer_of(starts[:9], starts[:9, 0])) == 0.0
    assert explained_by_start(buffer_of(np.zeros((30, 3)), starts[:, 0])) == pytest.approx(0.0, abs=0.05)
    assert explained_by_start(buffer_of(starts, np.ones(30))) == 0.0


def test_episodes_that_are_there_twice_foretell_nothing_of_each_other():
    rng = np.random.default_rng(0)
    starts, returns = np.tile(rng.normal(size=(20, 3)), (2, 1)), np.tile(rng.normal(size=20), 2)
    assert explained_by_start(buffer_of(starts, returns)) < 0.3


def test_the_return_reference_is_what_was_recorded():
    buffer = buffer_of(angles(20), np.arange(20.0))
    assert return_reference(buffer) == ReturnReference(9.5, 18.5, 19.0, 20)
    told = buffer_of(angles(20), np.arange(20.0), success=np.arange(60) % 12 == 2)
    assert return_reference(told) == ReturnReference(9.5, 18.5, 19.0, 20, success_rate=0.25)
    assert return_reference(buffer_of(angles(20), angles(20)[:, 0])).start_decides


def test_a_share_is_counted_from_random_actions():
    reference = ReturnReference(110.0, 120.0, 130.0, 9, random=10.0)
    assert reference.share(60.0, 110.0) == 0.5
    assert reference._replace(random=-1200.0).share(-700.0, -200.0) == 0.5, "negative returns"
    assert reference._replace(random=None).share(60.0, 110.0) is None
    assert reference.share(60.0, 10.0) is None, "random actions reach the goal"


@pytest.mark.parametrize(
    ("target", "start_decides", "goal"),
    [
        (None, False, (110.0, "the recorded mean")),
        (50.0, False, (50.0, "the target return")),
        (125.0, False, (125.0, "the target return")),
        (130.02, False, (130.02, "the target return")),  # a rounded one
        (20000.0, False, (120.0, "the best tenth")),
        (50.0, True, (50.0, "the target return")),
        (110.0, True, (110.0, "the target return")),
        (120.0, True, (110.0, "the recorded mean")),
        (20000.0, True, (110.0, "the recorded mean")),
    ],
)
def test_the_goal_is_the_target_return_as_far_as_the_data_go(target, start_decides, goal):
    assert ReturnReference(110.0, 120.0, 130.0, 9, start_decides).goal(target) == goal
