"""Names of the tasks: Gymnasium's and robomimic's."""

import contextlib
import json

import gymnasium as gym
import numpy as np
import pytest

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError
from sb3_dtfm.envs.robosuite import (
    TASKS,
    RobosuiteEnv,
    arm_motion,
    differences_from_robomimic,
    differences_in_motion,
    env_id_from_robomimic,
    env_kwargs_from_robomimic,
    register_robosuite_envs,
)
from tests.algorithms.small import make_model
from tests.data.test_robomimic import make_demo, write
from tests.envs.robosuite.conftest import rollout

OLD_CONTROLLER = {  # what robomimic's files of robosuite 1.4.1 hold
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "damping": 1,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "damping_limits": [0, 10],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "control_delta": True,
    "interpolation": None,
    "ramp_ratio": 0.2,
}


def test_registered_ids_make_the_tasks_with_their_horizon():
    register_robosuite_envs()
    register_robosuite_envs()
    env = gym.make("robosuite/Lift-v0", horizon=3)
    assert isinstance(env.unwrapped, RobosuiteEnv)
    assert env.unwrapped.task == "Lift"
    assert gym.spec("robosuite/Can-v0").kwargs == {"task": "Can"}
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    env.close()


def test_every_task_has_its_id():
    for task in TASKS:
        spec = gym.spec(f"robosuite/{task}-v0")
        assert spec.kwargs == {"task": task}
        assert spec.max_episode_steps is None


@pytest.mark.parametrize("task", TASKS)
def test_env_args_name_their_task(task):
    env_args = {"env_name": TASKS[task].environment, "type": 1, "env_kwargs": {}}
    assert env_id_from_robomimic(env_args) == f"robosuite/{task}-v0"
    assert env_id_from_robomimic(json.dumps(env_args)) == f"robosuite/{task}-v0"
    assert env_kwargs_from_robomimic(json.dumps(env_args))["task"] == task


@pytest.mark.parametrize(
    "env_args", [{"env_name": "TwoArmTransport", "type": 1}, {"env_name": "Lift", "type": 2}, {"env_name": "Can"}, {}]
)
def test_an_unknown_task_has_no_id(env_args):
    assert env_id_from_robomimic(env_args) is None


def test_controller_of_an_old_robomimic_file_moves_like_the_default(lift):
    env_args = {
        "env_name": "Lift",
        "env_version": "1.4.1",
        "type": 1,
        "env_kwargs": {"robots": ["Panda"], "control_freq": 20, "controller_configs": OLD_CONTROLLER},
    }
    assert differences_from_robomimic(env_args) == {}
    env = RobosuiteEnv(**env_kwargs_from_robomimic(env_args))
    np.testing.assert_array_equal(rollout(env, seed=2), rollout(lift, seed=2))
    env.close()


@pytest.mark.parametrize("value", ["high", None, {}, [[1], [2, 3]], 10**400, [150] * 5 + [151], float("nan")])
def test_whatever_a_file_says_differs_or_not(value):
    ours = arm_motion({})
    assert differences_in_motion({"kp": value, "unheard_of": 1}, ours) == {"kp": (value, 150)}
    assert differences_in_motion({"kp": [150.0] * 6}, ours) == {}


@pytest.mark.parametrize("task", ["Lift", "Can", "Wipe"])
def test_env_args_describe_the_environment(task, environment):
    env = environment(task)
    env_args = json.loads(json.dumps(env.env_args))
    assert env_args["env_name"] == TASKS[task].environment
    assert differences_from_robomimic(env_args) == {}
    arguments = env_kwargs_from_robomimic(env_args)
    assert arguments["task"] == task
    assert arguments["controller_config"]["body_parts"]["right"]["type"] == "OSC_POSE"
    copy = RobosuiteEnv(**arguments)
    np.testing.assert_array_equal(rollout(copy, n_steps=4, seed=2), rollout(env, n_steps=4, seed=2))
    copy.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_name": "TwoArmLift"}, "env_name is 'TwoArmLift'; supported are 'Lift', 'Stack', "),
        ({"env_kwargs": {"robots": ["Sawyer"]}}, "only a single 'Panda'"),
        ({"env_kwargs": {"robots": ["Panda"], "control_freq": 10}}, "control_freq is 10"),
    ],
)
def test_foreign_env_args_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        env_kwargs_from_robomimic({"env_name": "Lift", "env_kwargs": {}, **changes})


@pytest.mark.parametrize("options", [{}, {"cache_dir": "cache"}], ids=["memory", "cache"])
def test_data_are_of_the_environment_s_own_controller(lift, options, tmp_path, monkeypatch):
    """Whichever of them is the stiffer one; data that move the arm as the environment does need no word."""
    monkeypatch.chdir(tmp_path)
    register_robosuite_envs()
    controller = OLD_CONTROLLER | {"kp": 300}
    with contextlib.closing(gym.make("robosuite/Lift-v0", controller_config=controller)) as stiff:
        assert stiff.unwrapped._env.robots[0].part_controllers["right"].kp[0] == 300
        common = write("common.hdf5", {"demo_0": make_demo(12)}, json.loads(json.dumps(lift.env_args)))
        own = write("own.hdf5", {"demo_0": make_demo(12)}, json.loads(json.dumps(stiff.unwrapped.env_args)))
        assert make_model(DT, own, env=stiff, dataset_kwargs=options).buffer.env_id == "robosuite/Lift-v0"
        assert make_model(DT, common, env=lift, dataset_kwargs=options).buffer.env_id == "robosuite/Lift-v0"
        for path, env, found in ((common, stiff, "kp is 150 instead of 300"), (own, lift, "kp is 300 instead of 150")):
            with pytest.raises(DatasetError, match=f"an action does something else than in the environment: {found}"):
                make_model(DT, path, env=env, dataset_kwargs=options)
        insisting = options | {"env_id": "robosuite/Lift-v0"}
        assert make_model(DT, common, env=stiff, dataset_kwargs=insisting).buffer.env_id == "robosuite/Lift-v0"
