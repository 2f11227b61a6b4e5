"""A model's actions are meant for one robot and controller: every environment that it acts in is compared."""

import argparse
import contextlib
import json

import gymnasium as gym
import pytest
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DTFM
from sb3_dtfm.cli import inspect, push, sweep
from sb3_dtfm.data import DatasetError, load_dataset
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import FinetunedDTFM, ResidualActionVecEnv
from sb3_dtfm.recording.loading import AgentFiles, load_fitting_agent
from sb3_dtfm.zoo.commands import FoundModel, _without_pickles
from tests.algorithms.small import make_model
from tests.data.test_robomimic import make_demo, write
from tests.envs.robosuite.test_registration import OLD_CONTROLLER

LIFT = "robosuite/Lift-v0"
STIFF = {"controller_config": OLD_CONTROLLER | {"kp": 300}}
REFUSED = "an action does something else than in the environment.*: kp is 300 instead of 150"


def wrapped(env):
    return ReturnToGoWrapper(env, target_return=1.0)


@pytest.fixture(scope="module")
def stiff():
    with contextlib.closing(gym.make(LIFT, **STIFF)) as env:
        yield env


@pytest.fixture
def files(stiff, lift, tmp_path):
    """Demonstrations of the stiff controller and of the registered environment's."""
    return {
        name: write(
            tmp_path / f"{name}.hdf5",
            {"demo_0": make_demo(12, success_at=11)},
            json.loads(json.dumps(env.unwrapped.env_args)),
        )
        for name, env in (("stiff", stiff), ("common", lift))
    }


@pytest.fixture
def path(stiff, files, tmp_path):
    """A saved model of the stiff controller."""
    make_model(DTFM, files["stiff"], env=wrapped(stiff)).save(tmp_path / "model.zip")
    return tmp_path / "model.zip"


def test_a_saved_model_knows_its_controller(path, lift, stiff):
    assert DTFM.load(path).controller["kp"] == 300
    assert DTFM.load(path, env=wrapped(stiff)).get_env() is not None
    with pytest.raises(DatasetError, match=f"{REFUSED}.*controller=None"):
        DTFM.load(path, env=wrapped(lift))
    assert DTFM.load(path, env=wrapped(lift), controller=None).get_env() is not None


def test_another_environment_of_a_model_is_compared(files, stiff, lift):
    model = make_model(DTFM, files["stiff"], env=wrapped(stiff))
    env = model.get_env()
    with pytest.raises(DatasetError, match=REFUSED):
        model.set_env(wrapped(lift))
    assert model.get_env() is env
    with pytest.raises(DatasetError, match=REFUSED):
        model.learn(1, callback=EvalCallback(wrapped(lift), eval_freq=1, verbose=0))
    model.learn(1, callback=EvalCallback(wrapped(stiff), eval_freq=0, verbose=0))


@pytest.mark.parametrize("options", [{}, {"cache_dir": "cache"}], ids=["memory", "cache"])
def test_data_of_the_registered_controller_are_known_too(options, files, stiff, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = make_model(DTFM, files["common"], dataset_kwargs=options)
    with pytest.raises(DatasetError, match="kp is 150 instead of 300"):
        model.set_env(wrapped(stiff))
    insisting = make_model(DTFM, files["common"], dataset_kwargs={**options, "env_id": LIFT})
    insisting.set_env(wrapped(stiff))
    assert insisting.controller is None


def test_buffers_keep_the_controller(files, lift):
    buffer = load_dataset(files["stiff"], env_args={"env_kwargs": {"controller_configs": STIFF["controller_config"]}})
    assert buffer.select([0]).controller["kp"] == 300
    with pytest.raises(DatasetError, match=f"stiff.hdf5: {REFUSED}.*dataset_kwargs"):
        make_model(DTFM, buffer, env=wrapped(lift))
    both = [{"dataset": files["common"]}, {"dataset": files["common"]}]
    assert load_dataset(both).controller["kp"] == 150


def test_a_dataset_is_inspected_for_the_environment_s_own_controller(files):
    assert inspect._load_for(LIFT, STIFF, str(files["stiff"]), {}).env_id == LIFT
    with pytest.raises(DatasetError, match="kp is 150 instead of 300"):
        inspect._load_for(LIFT, STIFF, str(files["common"]), {})


def test_environments_of_fine_tuning_are_compared(path, lift, stiff):
    with pytest.raises(DatasetError, match=REFUSED):
        ResidualActionVecEnv(DummyVecEnv([lambda: wrapped(lift)]), path)
    finetuned = FinetunedDTFM.of(DTFM.load(path))
    with pytest.raises(DatasetError, match=REFUSED):
        finetuned.set_env(wrapped(lift))
    finetuned.set_env(wrapped(stiff))


RETURN_TO_GO_WRAPPER = "sb3_dtfm.envs.ReturnToGoWrapper"


def test_environments_of_commands_are_compared(path, lift):
    found = FoundModel("final-model", str(path), str(path.parent))
    options = argparse.Namespace(env=argparse.Namespace(gym_id=LIFT), algo="dtfm", seed=0, n_eval_episodes=1)
    swept = argparse.Namespace(env=LIFT, n_envs=1, episodes=1, env_kwargs=[], seed=0)
    files = AgentFiles(path, wrapper=wrapped)
    for act in (
        lambda: _without_pickles(found, "dtfm", LIFT, n_envs=1, hyperparams={"env_wrapper": RETURN_TO_GO_WRAPPER}),
        lambda: load_fitting_agent("dtfm", files, wrapped(lift), None, "cpu"),
        lambda: sweep.sweep(DTFM.load(path), files, swept, [1.0], argparse.Namespace(n=0)),
        lambda: push.evaluate(found, files, options),
    ):
        with pytest.raises(DatasetError, match=REFUSED):
            act()
