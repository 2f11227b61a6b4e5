"""Episodes longer than the environment's time limit count with their first steps and the returns of these."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import DatasetError, TrajectoryBuffer, load_dataset
from sb3_dtfm.envs import ReturnToGoWrapper
from tests.algorithms.small import make_model
from tests.conftest import EPISODE_LENGTH
from tests.data.small import ACTION_SPACE, OBSERVATION_SPACE, make_buffer, make_trajectory

LENGTHS, LIMIT = [9, 4, 6, 12], 6


def first_steps(seed: int, length: int) -> TrajectoryBuffer:
    """An episode as its recording would be if it had been stopped at the limit."""
    whole, n = make_trajectory(length, seed), min(length, LIMIT)
    arrays = {name: getattr(whole, name)[:n] for name in ("observations", "actions", "rewards")}
    episode = make_trajectory(n, **arrays, truncated=length > LIMIT)
    return TrajectoryBuffer.from_trajectories([episode], ACTION_SPACE, OBSERVATION_SPACE)


@pytest.fixture
def cut() -> TrajectoryBuffer:
    with pytest.warns(UserWarning, match=r"2 of 4 episodes have more than 6 steps, up to 12.*max_episode_steps"):
        return make_buffer(LENGTHS).within(LIMIT)


def test_what_is_left_is_what_a_recording_up_to_the_limit_holds(cut):
    expected = TrajectoryBuffer.join([first_steps(*each) for each in enumerate(LENGTHS)], [1.0] * 4)
    assert cut.episode_lengths.tolist() == [6, 4, 6, 6]
    assert cut.truncated.tolist() == [True, False, False, True]
    for name in ("returns", "observation_means", "observation_squares", "return_scales"):
        np.testing.assert_allclose(getattr(cut.episodes, name), getattr(expected.episodes, name), rtol=1e-5, err_msg=name)
    ends = th.arange(len(cut))
    for ours, theirs in zip(cut.windows(ends, 4, n_ahead=3), expected.windows(ends, 4, n_ahead=3), strict=True):
        th.testing.assert_close(ours, theirs)
    for ours, theirs in zip(cut.transitions(ends, 2, 0.9), expected.transitions(ends, 2, 0.9), strict=True):
        th.testing.assert_close(ours, theirs)


def test_the_buffer_that_was_cut_stays_as_it_was(cut):
    buffer = make_buffer(LENGTHS)
    before = buffer.returns_to_go.clone(), buffer.episode_returns.copy()
    with pytest.warns(UserWarning, match="6 steps"):
        assert buffer.within(LIMIT).stored["observations"] is buffer.stored["observations"]
    assert th.equal(buffer.returns_to_go, before[0])
    np.testing.assert_array_equal(buffer.episode_returns, before[1])
    assert buffer.episode_lengths.tolist() == LENGTHS


def test_an_end_behind_the_limit_is_not_learned_as_one():
    episodes = [make_trajectory(length, terminated=True, success=True) for length in (9, 4)]
    with pytest.warns(UserWarning, match="6 steps"):
        buffer = TrajectoryBuffer.from_trajectories(episodes, ACTION_SPACE).within(LIMIT)
    assert buffer.terminated.tolist() == [False, True]
    np.testing.assert_array_equal(buffer.successes, [np.nan, 1.0])


def test_what_failed_with_more_time_had_failed_by_then():
    """So data of successes within the limit and of failures beyond it can be chosen from."""
    lengths = {3: True, 4: True, 9: False}
    episodes = [make_trajectory(length, success=success) for length, success in lengths.items()]
    buffer = TrajectoryBuffer.from_trajectories(episodes, ACTION_SPACE)
    with pytest.warns(UserWarning, match="6 steps"):
        assert load_dataset(buffer, max_episode_steps=6, success_only=True).episode_lengths.tolist() == [3, 4]


def test_nothing_changes_where_no_episode_is_longer():
    buffer = make_buffer(LENGTHS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert buffer.within(12) is buffer
    for wrong in (0, 2.5, "2"):
        with pytest.raises(ValueError, match="max_episode_steps must be a whole number of at least 1"):
            buffer.within(wrong)


def test_the_best_are_chosen_by_what_counts():
    """The second one has more return, but behind the limit."""
    rewards = {0: np.r_[np.ones(6), np.zeros(3)], 1: np.r_[np.zeros(6), 2 * np.ones(3)]}
    episodes = [make_trajectory(9, seed, rewards=values) for seed, values in rewards.items()]
    buffer = TrajectoryBuffer.from_trajectories(episodes, ACTION_SPACE)
    assert load_dataset(buffer, min_return=6).episode_returns.tolist() == [6, 6]
    with pytest.warns(UserWarning, match="6 steps"):
        assert load_dataset(buffer, max_episode_steps=6, min_return=6).episode_returns.tolist() == [6]
    with pytest.warns(UserWarning, match="6 steps"), pytest.raises(DatasetError, match="largest return is 0"):
        load_dataset(buffer.select(np.array([1])), max_episode_steps=6, min_return=1)


@pytest.mark.filterwarnings("ignore:.*max_episode_steps")
@pytest.mark.parametrize("algorithm", [DT, DTFM])
@pytest.mark.parametrize(
    ("given", "longest"),
    [({}, 20), ({"max_episode_steps": 25}, 25), ({"max_episode_steps": None}, EPISODE_LENGTH)],
)
def test_the_environment_s_time_limit_counts_unless_another_is_given(algorithm, given, longest, cheetah_buffer):
    env = ReturnToGoWrapper(gym.make("HalfCheetah-v5", max_episode_steps=20), target_return=0.0)
    model = make_model(algorithm, cheetah_buffer, env=env, dataset_kwargs=given)
    assert model.buffer.episode_lengths.tolist() == [longest] * cheetah_buffer.n_episodes
    assert model.max_timestep == longest
    assert model.score_reference == cheetah_buffer.score_reference
    model.set_dataset(cheetah_buffer)
    assert model.learn(2).buffer.episode_lengths.max() == longest


@pytest.mark.filterwarnings("ignore:.*max_episode_steps")
def test_a_loaded_model_knows_the_time_limit_that_it_learned_for(cheetah_buffer, tmp_path):
    env = ReturnToGoWrapper(gym.make("HalfCheetah-v5", max_episode_steps=20), target_return=0.0)
    make_model(DT, cheetah_buffer, env=env).save(tmp_path / "model.zip")
    model = DT.load(tmp_path / "model.zip", dataset=cheetah_buffer).learn(1)
    assert model.buffer.episode_lengths.tolist() == [20] * cheetah_buffer.n_episodes
    model = DT.load(tmp_path / "model.zip", dataset=cheetah_buffer, dataset_kwargs={"max_episode_steps": None}).learn(1)
    assert model.buffer.episode_lengths.max() == EPISODE_LENGTH


@pytest.mark.filterwarnings("ignore:.*max_episode_steps")
def test_an_environment_that_tells_of_no_limit_leaves_the_models(cheetah_buffer, tmp_path):
    env = ReturnToGoWrapper(gym.make("HalfCheetah-v5", max_episode_steps=20), target_return=0.0)
    make_model(DT, cheetah_buffer, env=env).save(tmp_path / "model.zip")
    limitless, silent = (gym.make("HalfCheetah-v5", max_episode_steps=-1).unwrapped for _ in range(2))
    silent.spec = None
    for bare, longest in ((limitless, EPISODE_LENGTH), (silent, 20)):
        model = DT.load(tmp_path / "model.zip", ReturnToGoWrapper(bare, target_return=0.0), dataset=cheetah_buffer)
        assert model.learn(1).buffer.episode_lengths.max() == longest


def test_without_an_environment_nothing_is_left_out():
    model = make_model(DT, make_buffer(LENGTHS), env=None)
    assert model.max_timestep == 12
