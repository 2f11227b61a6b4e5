"""RobosuiteEnv: robomimic's observation, exact repetition, ends of episodes; with robosuite itself."""

import ctypes.util
import hashlib
import os
import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_dtfm.envs.demonstrators import LiftDemonstrator
from sb3_dtfm.envs.robosuite import RobosuiteEnv, env_kwargs_from_robomimic, register_robosuite_envs
from sb3_dtfm.envs.robosuite_scene import set_cube_size

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

FINGERPRINT = """
import hashlib, sys
import numpy as np
from sb3_dtfm.envs.robosuite import RobosuiteEnv
env = RobosuiteEnv(sys.argv[1])
rng = np.random.default_rng(0)
observations = [env.reset(seed=7)[0]]
observations += [env.step(rng.uniform(-1, 1, 7).astype(np.float32))[0] for _ in range(15)]
print(hashlib.sha256(np.stack(observations).tobytes()).hexdigest())
"""

RENDER = """
import gymnasium, sb3_dtfm.envs
env = gymnasium.make("robosuite/Lift-v0", render_mode="rgb_array", width=64, height=48)
env.reset(seed=0)
image = env.render()
print(image.shape, image.dtype, image.std() > 10)
"""


@pytest.fixture(params=["lift", "can"])
def env(request):
    return request.getfixturevalue(request.param)


def rollout(env, n_steps=15, seed=None, options=None):
    rng = np.random.default_rng(0)
    observations = [env.reset(seed=seed, options=options)[0]]
    observations += [env.step(rng.uniform(-1, 1, 7).astype(np.float32))[0] for _ in range(n_steps)]
    return np.stack(observations)


def run_python(code, *arguments, **environment):
    variables = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**variables, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_spaces_are_robomimics(lift, can):
    assert lift.observation_space.shape == (19,)
    assert can.observation_space.shape == (23,)
    for env in (lift, can):
        assert env.observation_space.dtype == np.float32
        assert env.action_space == gym.spaces.Box(-1.0, 1.0, (7,), np.float32)


def test_checkers_accept_it(env):
    sb3_check_env(env)
    gymnasium_check_env(env, skip_render_check=True)


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


def test_observation_is_robosuites_state_after_the_step(env):
    env.reset(seed=3)
    for action in np.random.default_rng(0).uniform(-1, 1, (8, 7)):
        observation, *_ = env.step(action)
    for _ in range(2):  # robosuite computes Can's relative pose from the pose it saw the time before
        expected = env._env._get_observations(force_update=True)
    keys = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "object-state")
    np.testing.assert_array_equal(observation, np.concatenate([expected[key] for key in keys]).astype(np.float32))


def test_step_moves_as_robosuites_own_step_does(env):
    observations = rollout(env, seed=4)
    env.reset(seed=4)
    rng = np.random.default_rng(0)
    for expected in observations[1:]:
        env._env.step(rng.uniform(-1, 1, 7).astype(np.float32).astype(np.float64))
        mujoco.mj_kinematics(env._env.sim.model._model, env._env.sim.data._data)
        np.testing.assert_array_equal(env._observation(), expected)


def test_same_seed_gives_the_same_bits_whatever_ran_before(env):
    first = rollout(env, seed=11)
    rollout(env, seed=12)
    env.reset()
    np.testing.assert_array_equal(rollout(env, seed=11), first)
    assert not np.array_equal(rollout(env, seed=12), first)


@pytest.mark.parametrize("task", ["Lift", "Can"])
def test_another_process_gives_the_same_bits_and_prints_nothing_of_its_own(task, request):
    result = run_python(FINGERPRINT, task)
    expected = hashlib.sha256(rollout(request.getfixturevalue(task.lower()), seed=7).tobytes()).hexdigest()
    assert result.stdout == expected + "\n"
    assert result.stderr == ""


def test_reset_without_seed_goes_on_in_the_stream(env):
    starts = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    again = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    np.testing.assert_array_equal(starts, again)
    assert len(np.unique(np.stack(starts), axis=0)) == 3


def test_recorded_start_is_taken_up_to_the_bit(env):
    first = rollout(env, seed=21)
    env.reset(seed=21)
    options = {"state": env.state, "model_file": env.model_file}
    rollout(env, seed=22)
    np.testing.assert_array_equal(rollout(env, options=options), first)


def test_start_of_another_task_is_refused(lift, can):
    with pytest.raises(ValueError, match=r"state has shape \(71,\), expected \(32,\) for Lift"):
        lift.reset(options={"state": can.state})


def test_model_file_names_no_folder_of_this_machine(env):
    assert 'file="robosuite/models/assets' in env.model_file
    assert 'file="/' not in env.model_file


def test_resized_cube_equals_a_compiled_one(lift):
    size = np.array([0.0203, 0.0217, 0.0209])
    set_cube_size(lift._env, size)
    resized = lift._env.sim.model._model
    compiled = mujoco.MjModel.from_xml_string(lift._env.edit_model_xml(lift.model_file))
    for name in ("geom_size", "geom_rbound", "geom_aabb", "bvh_aabb", "body_mass", "body_inertia", "body_subtreemass"):
        np.testing.assert_allclose(getattr(resized, name), getattr(compiled, name), rtol=1e-12, err_msg=name)
    for name in ("body_invweight0", "dof_invweight0", "dof_M0", "dof_length"):
        np.testing.assert_allclose(getattr(resized, name), getattr(compiled, name), rtol=1e-9, err_msg=name)


def test_horizon_truncates(can):
    short = can.horizon
    can.horizon = 4
    can.reset(seed=0)
    steps = [can.step(np.zeros(7, np.float32)) for _ in range(4)]
    can.horizon = short
    assert [step[1:] for step in steps[:3]] == [(0.0, False, False, {"is_success": False})] * 3
    assert steps[3][1:] == (0.0, False, True, {"is_success": False})


def test_success_terminates_with_reward_one(lift):
    observation, info = lift.reset(seed=1)
    assert info == {"is_success": False}
    demonstrator = LiftDemonstrator(1)
    rewards, done = [], False
    while not done:
        observation, reward, terminated, truncated, info = lift.step(demonstrator.act(observation))
        rewards.append(reward)
        done = terminated or truncated
        assert info["is_success"] is terminated
    assert terminated
    assert not truncated
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    assert observation[11] > 0.84  # robosuite's height of success


@pytest.mark.parametrize("action", [np.zeros(6), np.full(7, np.nan), np.zeros((1, 7))])
def test_impossible_action_is_refused(lift, action):
    lift.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be \(7,\) finite numbers"):
        lift.step(action)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "Stack"}, "task must be one of 'Lift', 'Can', got 'Stack'"),
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"render_mode": "ansi"}, "render_mode must be"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        RobosuiteEnv(**arguments)


def test_missing_robosuite_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "robosuite", None)
    with pytest.raises(ImportError, match=r'pip install "sb3-dtfm\[robosuite\]"'):
        RobosuiteEnv("Lift")


def test_a_machine_without_libgl_needs_no_opencv():
    """robosuite imports OpenCV for a viewer of its own; OpenCV cannot be loaded where libGL is missing."""
    program = "import sys; sys.modules['cv2'] = None\nfrom sb3_dtfm.envs.robosuite import RobosuiteEnv; RobosuiteEnv('Lift')"
    result = run_python(program)
    assert result.returncode == 0, result.stderr


def test_controller_of_an_old_robomimic_file_moves_like_the_default(lift):
    env_args = {
        "env_name": "Lift",
        "env_version": "1.4.1",
        "type": 1,
        "env_kwargs": {"robots": ["Panda"], "control_freq": 20, "controller_configs": OLD_CONTROLLER},
    }
    env = RobosuiteEnv(**env_kwargs_from_robomimic(env_args))
    np.testing.assert_array_equal(rollout(env, seed=2), rollout(lift, seed=2))
    env.close()


def test_env_args_describe_the_environment(env):
    arguments = env_kwargs_from_robomimic(env.env_args)
    assert arguments["task"] == env.task
    assert arguments["controller_config"]["body_parts"]["right"]["type"] == "OSC_POSE"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_name": "ToolHang"}, "env_name is 'ToolHang'; supported are 'Lift', 'PickPlaceCan'"),
        ({"env_kwargs": {"robots": ["Sawyer"]}}, "only a single 'Panda'"),
        ({"env_kwargs": {"robots": ["Panda"], "control_freq": 10}}, "control_freq is 10"),
    ],
)
def test_foreign_env_args_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        env_kwargs_from_robomimic({"env_name": "Lift", "env_kwargs": {}, **changes})


@pytest.mark.skipif(ctypes.util.find_library("OSMesa") is None, reason="needs OSMesa")
def test_renders_without_display():
    result = run_python(RENDER, MUJOCO_GL="osmesa")
    assert result.stdout == "(48, 64, 3) uint8 True\n", result.stderr
