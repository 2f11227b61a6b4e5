"""Promises of every row of the table of tasks, with robosuite itself."""

import hashlib
import json
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_dtfm.envs.robosuite import TASKS, RobosuiteEnv
from tests.envs.robosuite.conftest import rollout, run_python

# Widths of an observation and of an action.
SIZES = {
    "Lift": (19, 7),
    "Stack": (32, 7),
    "NutAssembly": (37, 7),
    "Square": (23, 7),
    "Round": (23, 7),
    "ToolHang": (53, 7),
    "PickPlace": (65, 7),
    "Can": (23, 7),
    "Milk": (23, 7),
    "Bread": (23, 7),
    "Cereal": (23, 7),
    "Door": (23, 7),
    "Wipe": (15, 6),
}

# Poses of objects (joint: x y z w x y z) with which a task is solved, and which hold for a step.
PEGS = {"SquareNut_joint0": (0.23, 0.1, 0.83, 1, 0, 0, 0), "RoundNut_joint0": (0.23, -0.1, 0.83, 1, 0, 0, 0)}
BINS = {
    "Milk_joint0": (0.0025, 0.1575, 0.886, 1, 0, 0, 0),
    "Bread_joint0": (0.1975, 0.1575, 0.846, 1, 0, 0, 0),
    "Cereal_joint0": (0.0025, 0.4025, 0.9, 1, 0, 0, 0),
    "Can_joint0": (0.1975, 0.4025, 0.86, 1, 0, 0, 0),
}
SOLVED = {
    "Lift": {"cube_joint0": (0.0, 0.0, 0.9, 1, 0, 0, 0)},
    "Stack": {"cubeB_joint0": (0, 0.1, 0.825, 1, 0, 0, 0), "cubeA_joint0": (0, 0.1, 0.869, 1, 0, 0, 0)},
    "NutAssembly": PEGS,
    "Square": {"SquareNut_joint0": PEGS["SquareNut_joint0"]},
    "Round": {"RoundNut_joint0": PEGS["RoundNut_joint0"]},
    "PickPlace": BINS,
    **{name: {f"{name}_joint0": BINS[f"{name}_joint0"]} for name in ("Can", "Milk", "Bread", "Cereal")},
    "Door": {"Door_hinge": 0.35},
}

FINGERPRINTS = """
import hashlib, json, sys
import numpy as np
from sb3_dtfm.envs.robosuite import RobosuiteEnv
from tests.envs.robosuite.conftest import rollout
np.random.seed(1)
names = json.loads(sys.argv[1])
print(json.dumps({name: hashlib.sha256(rollout(RobosuiteEnv(name), seed=7).tobytes()).hexdigest() for name in names}))
"""


@pytest.fixture(params=TASKS)
def env(request, environment):
    return environment(request.param)


def test_the_table_is_robosuites_single_arm_tasks():
    assert set(SIZES) <= set(TASKS)
    assert len({row.environment for row in TASKS.values()}) == len(TASKS)


@pytest.mark.parametrize("task", SIZES)
def test_sizes_and_keys_are_robomimics(task, environment):
    env = environment(task)
    n_observations, n_actions = SIZES[task]
    assert env.observation_space == gym.spaces.Box(-np.inf, np.inf, (n_observations,), np.float32)
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (n_actions,), np.float32)
    fingers = {"robot0_gripper_qpos": 2} if n_actions == 7 else {}
    robot = {"robot0_eef_pos": 3, "robot0_eef_quat": 4, **fingers}
    assert list(env.observation_keys.items()) == [*robot.items(), ("object", n_observations - sum(robot.values()))]


def test_checkers_have_nothing_to_say(env):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sb3_check_env(env)
        gymnasium_check_env(env, skip_render_check=True)
    unexpected = [str(warning.message) for warning in caught if "infinity" not in str(warning.message)]
    assert unexpected == []


def test_observation_is_robosuites_state_after_the_step(env):
    env.reset(seed=3)
    for action in np.random.default_rng(0).uniform(-1, 1, (8, *env.action_space.shape)):
        observation, *_ = env.step(action)
    for _ in range(2):  # robosuite computes a relative pose from the pose it saw the time before
        expected = env._env._get_observations(force_update=True)
    keys = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "object-state")
    np.testing.assert_array_equal(observation, np.concatenate([expected[key] for key in keys]).astype(np.float32))


def test_step_moves_as_robosuites_own_step_does(env):
    observations = rollout(env, seed=4)
    env.reset(seed=4)
    rng = np.random.default_rng(0)
    for expected in observations[1:]:
        env._env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32).astype(np.float64))
        mujoco.mj_kinematics(env._env.sim.model._model, env._env.sim.data._data)
        np.testing.assert_array_equal(env._observe(), expected)


def test_same_seed_gives_the_same_bits_whatever_ran_before(env):
    first = rollout(env, seed=11)
    np.random.seed(2)  # noqa: NPY002  (nothing may draw from it)
    rollout(env, seed=12)
    env.reset()
    np.testing.assert_array_equal(rollout(env, seed=11), first)
    assert not np.array_equal(rollout(env, seed=12), first)


def test_reset_without_seed_goes_on_in_the_stream(env):
    starts = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    again = [env.reset(seed=5)[0], env.reset()[0], env.reset()[0]]
    np.testing.assert_array_equal(starts, again)
    assert len(np.unique(np.stack(starts), axis=0)) == 3


def test_another_process_gives_the_same_bits_and_prints_nothing_of_its_own(environment):
    """Whatever the order of the tasks and of strings in a set."""
    names = ["Lift", "Square", "Can", "Door", "Wipe"]
    result = run_python(FINGERPRINTS, json.dumps(names[::-1]), PYTHONHASHSEED="3")
    assert result.stderr == ""
    expected = {name: hashlib.sha256(rollout(environment(name), seed=7).tobytes()).hexdigest() for name in names}
    assert json.loads(result.stdout) == expected


def test_recorded_start_is_taken_up_to_the_bit(env):
    first = rollout(env, seed=21)
    env.reset(seed=21)
    options = {"state": env.state, "model_file": env.model_file}
    rollout(env, seed=22)
    np.testing.assert_array_equal(rollout(env, options=options), first)
    np.testing.assert_array_equal(rollout(env, options={"state": options["state"]}), first)  # in the present scene
    assert env.model_file == options["model_file"]


def test_taking_up_a_recorded_start_draws_nothing(env):
    env.reset(seed=5)
    expected = env.reset()[0]
    env.reset(seed=5)
    env.reset(options={"state": env.state})
    np.testing.assert_array_equal(env.reset()[0], expected)


def test_model_file_compiles_to_the_present_scene(env):
    env.reset(seed=31)
    assert 'file="robosuite/models/assets' in env.model_file
    assert 'file="/' not in env.model_file
    compiled = mujoco.MjModel.from_xml_string(env._env.edit_model_xml(env.model_file))
    assert (compiled.nq, compiled.nv) == (env._env.sim.model.nq, env._env.sim.model.nv)
    data, present = mujoco.MjData(compiled), env._env.sim.data
    data.qpos[:] = present.qpos
    mujoco.mj_kinematics(compiled, data)
    for body in range(1, compiled.nbody):
        name = compiled.body(body).name
        if not name.startswith(("Visual", "bin")):  # robosuite's reset puts them where they belong
            np.testing.assert_allclose(data.xpos[body], present.get_body_xpos(name), atol=1e-9, err_msg=name)


def test_horizon_truncates(env):
    horizon = env.horizon
    env.horizon = 4
    env.reset(seed=0)
    steps = [env.step(np.zeros(env.action_space.shape, np.float32)) for _ in range(4)]
    env.horizon = horizon
    assert [step[1:] for step in steps[:3]] == [(0.0, False, False, {"is_success": False})] * 3
    assert steps[3][1:] == (0.0, False, True, {"is_success": False})


@pytest.mark.parametrize("task", SOLVED)
def test_success_terminates_with_reward_one(task, environment):
    env = environment(task)
    env.reset(seed=1)
    sim = env._env.sim
    for joint, position in SOLVED[task].items():
        sim.data.set_joint_qpos(joint, position)
    env.reset(options={"state": env.state})
    _, *outcome = env.step(np.zeros(env.action_space.shape, np.float32))
    assert outcome == [1.0, True, False, {"is_success": True}]


def test_one_of_several_objects_is_not_enough(environment):
    for task, poses in (("NutAssembly", PEGS), ("PickPlace", BINS)):
        env = environment(task)
        env.reset(seed=1)
        joint, position = next(iter(poses.items()))
        env._env.sim.data.set_joint_qpos(joint, position)
        env.reset(options={"state": env.state})
        _, *outcome = env.step(np.zeros(7, np.float32))
        assert outcome == [0.0, False, False, {"is_success": False}]


def test_wiper_takes_the_dirt_away_until_none_is_left(environment):
    env = environment("Wipe")
    observation, _ = env.reset(seed=0)
    assert observation[7] == 0.0  # share of the dirt that is wiped
    dirt = env._env.sim.data.get_body_xpos("contact50_main")
    for _ in range(100):
        towards_it = np.clip(5.0 * (dirt - observation[:3]), -1.0, 1.0)
        if observation[2] < 0.93:
            towards_it[2] = -1.0  # it takes some pressure
        observation, reward, terminated, *_ = env.step(np.array([*towards_it, 0, 0, 0], np.float32))
        if observation[7] > 0.0:
            break
    assert 0.0 < observation[7] < 1.0
    assert (reward, terminated) == (0.0, False)
    wiped = env._env.wiped_markers
    wiped += [marker for marker in env._env.model.mujoco_arena.markers if marker not in wiped]
    observation, *outcome = env.step(np.zeros(6, np.float32))
    assert outcome == [1.0, True, False, {"is_success": True}]
    assert observation[7] == 1.0
    assert env.reset(options={"state": env.state})[0][7] == 0.0


def test_own_horizon_gives_way_to_the_argument():
    assert [TASKS[task].horizon for task in ("Lift", "NutAssembly", "PickPlace", "ToolHang")] == [400, 800, 1600, 700]
    env = RobosuiteEnv("ToolHang", horizon=5)
    assert env.horizon == 5
    env.close()
