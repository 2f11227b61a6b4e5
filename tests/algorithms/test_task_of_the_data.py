"""Data are of one task: another task's are refused though all shapes are equal."""

import gymnasium as gym
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import DatasetError, TrajectoryBuffer
from sb3_dtfm.envs import ReturnToGoWrapper
from tests.algorithms.small import make_model
from tests.conftest import make_env, record_random_episodes

CHEETAH, WALKER = "HalfCheetah-v5", "Walker2d-v5"
BOTH_NAMED = rf"(?s){CHEETAH}.*{WALKER}|{WALKER}.*{CHEETAH}"


@pytest.fixture(scope="module")
def episodes():
    return record_random_episodes(2)


@pytest.fixture
def make_buffer(episodes, cheetah_buffer):
    """A buffer of HalfCheetah, said to be of the task given."""

    def make(env_id):
        return TrajectoryBuffer.from_trajectories(episodes, cheetah_buffer.action_space, source="some data", env_id=env_id)

    return make


def make_walker():
    return ReturnToGoWrapper(gym.make(WALKER), target_return=0.0)


def test_the_two_tasks_differ_in_nothing_that_arrays_show():
    assert make_walker().observation_space == make_env().observation_space
    assert make_walker().action_space == make_env().action_space


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_the_data_of_another_task_are_refused(algorithm, make_buffer):
    with pytest.raises(DatasetError, match=BOTH_NAMED) as refusal:
        make_model(algorithm, make_buffer(CHEETAH), env=make_walker())
    assert "some data" in str(refusal.value)
    assert "env_id" in str(refusal.value)


def test_a_buffer_says_of_which_task_it_is(make_buffer):
    buffer = make_buffer(CHEETAH)
    assert buffer.env_id == CHEETAH
    assert buffer.random_fraction(0.5, seed=0).env_id == CHEETAH
    assert make_buffer(None).env_id is None


@pytest.mark.parametrize("env_id", [WALKER, "Walker2d-v4", "Walker2d-v2", None])
def test_another_version_an_unknown_task_and_the_same_are_accepted(env_id, make_buffer):
    model = make_model(DT, make_buffer(env_id), env=make_walker())
    assert model.learn(1).num_timesteps == 1


def test_a_name_that_only_begins_alike_is_another_task(make_buffer):
    with pytest.raises(DatasetError, match=rf"(?s)Walker2dHard-v5.*{WALKER}|{WALKER}.*Walker2dHard-v5"):
        make_model(DT, make_buffer("Walker2dHard-v5"), env=make_walker())


def test_later_data_and_data_for_a_loaded_model_are_checked_too(make_buffer, tmp_path):
    model = make_model(DT, make_buffer(WALKER), env=make_walker())
    with pytest.raises(DatasetError, match=BOTH_NAMED):
        model.set_dataset(make_buffer(CHEETAH))
    assert model.buffer.env_id == WALKER
    model.set_dataset(make_buffer("Walker2d-v4"))
    model.save(tmp_path / "model")
    with pytest.raises(DatasetError, match=BOTH_NAMED):
        DT.load(tmp_path / "model", env=make_walker(), dataset=make_buffer(CHEETAH)).learn(1)


def test_an_env_that_comes_after_the_data_is_checked_too(make_buffer):
    """Also the one of an evaluation, which becomes the model's where it has none."""
    model = make_model(DT, make_buffer(CHEETAH))
    with pytest.raises(DatasetError, match=BOTH_NAMED):
        model.set_env(make_walker())
    with pytest.raises(DatasetError, match=BOTH_NAMED):
        model.learn(1, callback=EvalCallback(Monitor(make_walker()), eval_freq=1, verbose=0))
    assert model.get_env() is None
    model.set_env(make_env())
    assert model.get_env() is not None


@pytest.mark.filterwarnings("ignore:.*is set to None:UserWarning")  # what else Minari would like to know
def test_who_insists_says_so(episodes, tmp_path, monkeypatch):
    """A recorded file knows its task; another name given with it is taken instead."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    recorded = [
        EpisodeBuffer(
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=np.zeros(len(episode), bool),
            truncations=np.arange(len(episode)) == len(episode) - 1,
        )
        for episode in episodes
    ]
    minari.create_dataset_from_buffers("local/halfcheetah-v0", recorded, env=CHEETAH)
    with pytest.raises(DatasetError, match=BOTH_NAMED) as refusal:
        make_model(DT, "local/halfcheetah-v0", env=make_walker())
    assert "local/halfcheetah-v0" in str(refusal.value)
    assert "dataset_kwargs" in str(refusal.value)
    assert "env_id" in str(refusal.value)
    insisting = make_model(DT, "local/halfcheetah-v0", env=make_walker(), dataset_kwargs={"env_id": WALKER})
    assert insisting.learn(1).num_timesteps == 1
