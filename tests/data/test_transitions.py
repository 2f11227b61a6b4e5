"""Transitions: rewards, discounts and what follows, at each end that an episode can have."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm.data import Trajectory, TrajectoryBuffer

SPACE = spaces.Box(-1.0, 1.0, (1,), np.float32)
GAMMA = 0.5


def episode(first: float, n_steps: int, **end: bool) -> Trajectory:
    """Observation, a tenth as an action and reward are the numbers from `first` on."""
    numbers = np.arange(first, first + n_steps)
    return Trajectory(numbers[:, None], numbers[:, None] / 100, numbers, **end)


@pytest.fixture
def buffer() -> TrajectoryBuffer:
    """An episode that goes on, too, where the recording ends."""
    return TrajectoryBuffer.from_trajectories(
        [episode(1, 3, terminated=True), episode(11, 2, truncated=True), episode(21, 1)], SPACE
    )


def test_one_step(buffer):
    batch = buffer.transitions(th.arange(6), 1, GAMMA)
    assert batch.observations.flatten().tolist() == [1, 2, 3, 11, 12, 21]
    assert batch.actions.flatten().mul(100).round().tolist() == [1, 2, 3, 11, 12, 21]
    assert batch.rewards.tolist() == [1, 2, 3, 11, 12, 21]
    assert batch.discounts.tolist() == [0.5, 0.5, 0, 0.5, 0, 0]
    assert batch.mask.tolist() == [True, True, True, True, False, False]
    assert batch.next_observations.flatten()[batch.discounts > 0].tolist() == [2, 3, 12]


def test_two_steps_as_one(buffer):
    batch = buffer.transitions(th.arange(6), 2, GAMMA)
    assert batch.actions.mul(100).round().tolist() == [[1, 2], [2, 3], [3, 3], [11, 12], [12, 12], [21, 21]]
    assert batch.rewards.tolist() == [2, 3.5, 3, 17, 12, 21]
    assert batch.discounts.tolist() == [0.25, 0, 0, 0, 0, 0]
    assert batch.mask.tolist() == [True, True, True, False, False, False]
    assert batch.next_observations[0] == 3


def test_a_selection_has_transitions_of_its_own_episodes(buffer):
    batch = buffer.select(np.array([1, 0])).transitions(th.tensor([0, 4]), 1, GAMMA)
    assert batch.rewards.tolist() == [11, 3]
    assert batch.mask.tolist() == [True, True]


def test_the_largest_discounted_return(buffer):
    assert buffer.largest_discounted_return(GAMMA) == 21
    assert buffer.select(np.array([0])).largest_discounted_return(GAMMA) == pytest.approx(3.5)
    assert buffer.select(np.array([0])).largest_discounted_return(0.99) == pytest.approx(1 + 0.99 * 2 + 0.99**2 * 3)


def test_draws_repeat(buffer):
    drawn = [buffer.sample_transitions(50, 1, GAMMA, th.Generator().manual_seed(0)) for _ in range(2)]
    assert th.equal(drawn[0].rewards, drawn[1].rewards)
    assert len(drawn[0].rewards.unique()) == 6
