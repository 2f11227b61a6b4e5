"""Returns-to-go of what may be expected: known expectiles, what stays as recorded, and that it repeats."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm.data import Trajectory, TrajectoryBuffer, expected

N_STEPS, PRIZE, N_EPISODES = 6, 8.0, 40


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(expected, "N_TIMESTEPS", 300)
    monkeypatch.setattr(expected, "BATCH_SIZE", 128)


@pytest.fixture
def buffer() -> TrajectoryBuffer:
    """
    All begin at 0. Half go by 1 and earn one a step; half go by -1 and earn at the last step: eight one time in ten.

    So they reach 6 for sure, and e by the expectile: 0.95 of a tenth of 8 - e is 0.05 of nine tenths of e: 0.76 / 0.14.
    """
    episodes = []
    for i in range(N_EPISODES):
        gambles, wins = i % 2 == 1, i % 20 == 1
        observations = np.full((N_STEPS, 1), -1.0 if gambles else 1.0, np.float32)
        observations[0] = 0.0
        rewards = np.zeros(N_STEPS) if gambles else np.ones(N_STEPS)
        rewards[-1] += PRIZE * wins
        episodes.append(Trajectory(observations, np.zeros((N_STEPS, 1), np.float32), rewards, terminated=True))
    return TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (1,)))


def by_episode(buffer: TrajectoryBuffer) -> np.ndarray:
    return buffer.returns_to_go.view(-1, N_STEPS).numpy()


def test_returns_become_expected_returns(buffer):
    found = by_episode(buffer.with_expected_returns(1, seed=0))
    np.testing.assert_allclose(found[::2, 0], 6.0, atol=0.4)
    np.testing.assert_allclose(found[1::2, 0], 0.76 / 0.14, atol=0.4)
    # Within the last n steps nothing comes after them, and the recorded return stays.
    np.testing.assert_array_equal(found[:, -1], by_episode(buffer)[:, -1])
    assert found[1, -1] == PRIZE
    # The rewards of n steps are those of the episode: what lies n before its end has all of them.
    np.testing.assert_allclose(by_episode(buffer.with_expected_returns(N_STEPS, seed=0)), by_episode(buffer))


def test_what_was_recorded_stays(buffer):
    before = buffer.returns_to_go.clone()
    th.manual_seed(5)
    state = th.random.get_rng_state()
    changed = buffer.with_expected_returns(2, seed=0)
    assert th.equal(th.random.get_rng_state(), state)
    assert th.equal(buffer.returns_to_go, before)
    np.testing.assert_array_equal(changed.episode_returns, buffer.episode_returns)
    assert changed.observations is buffer.observations
    assert changed.rewards is buffer.rewards


def test_the_same_seed_gives_the_same_numbers(buffer):
    first, again, other = (buffer.with_expected_returns(2, seed).returns_to_go for seed in (0, 0, 1))
    assert th.equal(first, again)
    assert not th.equal(first, other)


def test_some_of_the_episodes_are_learned_from_alone(buffer):
    """Without the winners no episode that goes by -1 earns anything, and the others' numbers are not touched."""
    chosen = np.array([i for i in range(N_EPISODES) if i % 20 != 1])
    changed = buffer.select(chosen).with_expected_returns(1, seed=0)
    np.testing.assert_allclose(by_episode(changed)[chosen % 2 == 1, 0], 0.0, atol=0.4)
    left_out = slice(N_STEPS, 2 * N_STEPS)
    assert th.equal(changed.stored["returns_to_go"][left_out], buffer.returns_to_go[left_out])


def test_the_rewards_of_n_to_2_n_steps_count_as_they_came(buffer, monkeypatch):
    """If zero is expected, the mean of these sums is left: of 2, 3 and 4 rewards of one, or as many as are left."""
    monkeypatch.setattr(expected, "_regression", lambda steps, statistics, seed: th.zeros(len(steps.rows)))
    found = by_episode(buffer.with_expected_returns(2, seed=0))
    np.testing.assert_allclose(found[0], [3.0, 3.0, 2.5, 2.0, 2.0, 1.0])
    np.testing.assert_allclose(found[1], [0.0, 0.0, 0.0, 0.0, PRIZE, PRIZE])
