"""Go1Velocity-v0: what Gymnasium and Stable-Baselines3 expect, commands, randomisation, repetition."""

import ctypes.util

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from sb3_dtfm.envs.go1.env import COMMAND_LIMITS, Go1Env, TeacherObservation
from sb3_dtfm.envs.go1.model import HOME
from sb3_dtfm.envs.go1.randomization import NOISE, RANGES, Randomizer, add_noise, draw_push, draw_robot
from tests.envs.robosuite.conftest import run_python


@pytest.fixture(scope="module")
def env() -> Go1Env:
    return Go1Env()


@pytest.mark.filterwarnings("ignore:.*(not within|unwrapped|infinity|render mode)")
def test_the_checkers_of_gymnasium_and_sb3_pass():
    env = gym.make("Go1Velocity-v0")
    assert env.spec is not None
    assert env.spec.max_episode_steps * 0.02 == 20.0
    check_env(env.unwrapped, skip_render_check=True)
    check_sb3_env(env)
    check_sb3_env(TeacherObservation(env))


def play(env: gym.Env, seed: int, n_steps: int = 60) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    shown = [env.reset(seed=seed)[0]]
    for _ in range(n_steps):
        observation, reward, terminated, _, info = env.step(rng.uniform(-0.3, 0.3, 12))
        shown += [observation, np.array(reward), np.array(terminated), info["measured_velocity"]]
    return shown


def test_a_seed_repeats_an_episode_exactly_whatever_was_before(env):
    first = play(env, 3)
    play(env, 4)
    again, elsewhere = play(env, 3), play(Go1Env(), 3)
    for one, two, three in zip(first, again, elsewhere, strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(one, three)
    assert not np.array_equal(first[1], play(env, 5)[1])


def test_an_observation_is_what_the_robot_measures(env):
    env = Go1Env(randomize=False)
    env.reset(seed=0, options={"command": (0.4, -0.2, 0.1)})
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 12)).astype(np.float32)
    for action in actions:
        observation, *_, info = env.step(action)
    motion = env.simulation.motion
    parts = [motion.gyro, motion.gravity, motion.joint_positions - HOME, motion.joint_velocities, actions[-1], env.command]
    np.testing.assert_array_equal(observation, np.concatenate(parts).astype(np.float32))
    np.testing.assert_allclose(env.command, (0.4, -0.2, 0.1))
    np.testing.assert_allclose(info["velocity"], [*motion.velocity[:2], motion.gyro[2]])
    np.testing.assert_array_equal(info["measured_velocity"], motion.velocity.astype(np.float32))


def test_motion_agrees_with_the_sensors_of_mujoco():
    """The IMU's place and frame: a velocimeter and a gyro there measure the same."""
    import mujoco

    from sb3_dtfm.envs.go1.model import IMU, build_spec
    from sb3_dtfm.envs.go1.simulation import Simulation

    spec = build_spec()
    spec.body("trunk").add_site(name="imu", pos=IMU)
    for name, kind in (("velocity", mujoco.mjtSensor.mjSENS_VELOCIMETER), ("gyro", mujoco.mjtSensor.mjSENS_GYRO)):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    simulation = Simulation(spec.compile())
    simulation.reset(yaw=1.0, velocity=np.array([0.3, -0.4, 0.5, 0.6, -0.7, 0.8]))
    for _ in range(3):
        simulation.advance(HOME + 0.3)
    np.testing.assert_allclose(simulation.motion.velocity, simulation.data.sensor("velocity").data, atol=1e-9)
    np.testing.assert_allclose(simulation.motion.gyro, simulation.data.sensor("gyro").data, atol=1e-9)


def test_a_teacher_sees_the_velocity_first():
    env = TeacherObservation(gym.make("Go1Velocity-v0"))
    observation, info = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:3], info["measured_velocity"])
    bare, _ = gym.make("Go1Velocity-v0").reset(seed=0)
    np.testing.assert_array_equal(observation[3:], bare)
    observation, *_, info = env.step(np.zeros(12, np.float32))
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(observation[:3], info["measured_velocity"])


def test_a_fall_ends_an_episode(env):
    env.reset(seed=0)
    env.simulation.data.qpos[3:7] = (0.0, 1.0, 0.0, 0.0)  # on its back
    _, reward, terminated, truncated, info = env.step(np.zeros(12))
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["reward_terms"]["fall"] == -1.0


def test_commands_are_drawn_within_their_limits_and_anew(env):
    commands, lengths, length = [], [], 0
    for seed in range(40):
        env.reset(seed=seed)
        for _ in range(300):
            if commands and np.array_equal(commands[-1], env.command):
                length += 1
            else:
                commands.append(env.command)
                lengths.append(length)
                length = 0
            env._n_steps += 1
            if env._n_steps * 0.02 >= env._next_command:
                env._draw_command()
    drawn = np.array(commands)
    np.testing.assert_array_equal(COMMAND_LIMITS, [1.5, 0.8, 1.2])
    assert (np.abs(drawn) <= COMMAND_LIMITS).all()
    assert (np.abs(drawn).max(axis=0) > 0.9 * COMMAND_LIMITS).all()
    np.testing.assert_allclose(np.mean(drawn != 0.0, axis=0), [0.9, 0.25, 0.5], atol=0.15)
    assert len(commands) > 60  # six seconds, 40 times: a second command in most


def test_starts_are_drawn_within_their_ranges(env):
    starts = []
    for seed in range(200):
        env.reset(seed=seed)
        data = env.simulation.data
        starts.append([*data.qvel[:6], 2 * np.arctan2(data.qpos[6], data.qpos[3])])
        np.testing.assert_array_equal(data.qpos[7:], HOME)
        assert not data.qvel[6:].any()
    largest = np.abs(starts).max(axis=0)
    assert (largest <= [0.5] * 6 + [np.pi]).all()
    assert (largest > [0.45] * 6 + [2.8]).all()


def test_robots_are_drawn_from_all_of_each_range():
    rng = np.random.default_rng(0)
    draws = [draw_robot(rng) for _ in range(500)]
    assert RANGES == {
        "friction": (0.4, 1.0, ()),
        "joint_friction": (0.9, 1.1, (12,)),
        "armature": (1.0, 1.05, (12,)),
        "mass": (0.9, 1.1, (13,)),
        "payload": (-1.0, 1.0, ()),
        "centre": (-0.05, 0.05, (3,)),
        "joint_zero": (-0.05, 0.05, (12,)),
        "delay": (0.0, 1.0, ()),
        "strength": (0.9, 1.1, (12,)),
    }
    for name, (low, high, shape) in RANGES.items():
        values = np.array([getattr(draw, name) for draw in draws])
        assert values.shape == (500, *shape)
        margin = 0.02 * (high - low)
        assert low <= values.min() < low + margin
        assert high - margin < values.max() <= high


def test_the_robot_that_was_drawn_is_simulated():
    env = Go1Env()
    simulation, made = env.simulation, Go1Env(randomize=False).simulation.model
    draw = draw_robot(np.random.default_rng(1))
    randomizer = Randomizer(simulation)
    for _ in range(2):  # the second draw does not add to the first
        randomizer.apply(draw)
    model = simulation.model
    np.testing.assert_allclose(
        model.geom_friction[[model.geom(name).id for name in ("floor", "FR", "RL")], 0], draw.friction
    )
    np.testing.assert_allclose(model.dof_frictionloss[6:], made.dof_frictionloss[6:] * draw.joint_friction)
    np.testing.assert_allclose(model.dof_armature[6:], 0.005 * draw.armature)
    np.testing.assert_allclose(model.body_mass[2:], made.body_mass[2:] * draw.mass[1:])
    assert model.body("trunk").mass[0] == pytest.approx(5.204 * draw.mass[0] + draw.payload)
    np.testing.assert_allclose(model.body_inertia[1] / made.body_inertia[1], model.body_mass[1] / made.body_mass[1])
    np.testing.assert_allclose(model.body("trunk").ipos, made.body("trunk").ipos + draw.centre)
    np.testing.assert_allclose(model.qpos0[7:], draw.joint_zero)
    assert model.body_subtreemass[0] == pytest.approx(model.body_mass.sum())  # MuJoCo's own sums are made anew
    assert simulation.delay == round(float(draw.delay) * 5)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 35.0 * draw.strength)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1], -35.0 * draw.strength)


def test_without_randomisation_the_robot_stays_as_it_was_made():
    env = Go1Env(randomize=False)
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation[6:18], 0.0)
        assert env.simulation.model.body_mass.sum() == pytest.approx(12.743448, abs=1e-6)
        assert env.simulation.delay == 0


def test_noise_lies_within_its_ranges(env):
    env.reset(seed=0)
    motion, rng = env.simulation.motion, np.random.default_rng(0)
    measured = [add_noise(motion, rng) for _ in range(300)]
    published = {"velocity": 0.1, "gyro": 0.2, "gravity": 0.05, "joint_positions": 0.03, "joint_velocities": 1.5}
    assert published == NOISE
    for name, most in NOISE.items():
        deviations = np.abs([getattr(each, name) - getattr(motion, name) for each in measured])
        assert 0.95 * most < deviations.max() <= most
    np.testing.assert_array_equal(measured[0].torques, motion.torques)


def test_pushes_change_the_velocity_within_their_range(env):
    rng = np.random.default_rng(0)
    pushes = [draw_push(rng) for _ in range(300)]
    speeds = [np.linalg.norm(velocity) for velocity, _ in pushes]
    assert 0.48 < max(speeds) <= 0.5
    assert 3.0 <= min(seconds for _, seconds in pushes) < max(seconds for _, seconds in pushes) <= 8.0
    env.reset(seed=0)
    before = env.simulation.motion.velocity
    env.simulation.push(np.array([0.3, 0.4]))
    assert np.linalg.norm(env.simulation.motion.velocity - before) == pytest.approx(0.5)


def test_an_episode_is_pushed(env):
    """At the step when it is time, and at no other."""
    pushed = []
    push = env.simulation.push
    env.simulation.push = lambda velocity: (pushed.append(env._n_steps), push(velocity))
    try:
        env.reset(seed=0)
        first = env._next_push
        for _ in range(450):
            env.simulation.reset()
            env.step(np.zeros(12))
    finally:
        env.simulation.push = push
    assert pushed[0] == pytest.approx(first / 0.02, abs=1.0)
    assert 1 <= len(pushed) <= 3
    assert (np.diff(pushed) >= 149).all()


def test_a_late_target_leaves_the_last_one_in_force():
    env = Go1Env(randomize=False)
    simulation, sent = env.simulation, []
    drive = simulation.drive
    simulation.drive = lambda targets: (sent.append(targets[0]), drive(targets))
    env.reset(seed=0)
    simulation.delay = 2
    env.step(np.full(12, 0.2))
    env.step(np.full(12, -0.2))
    np.testing.assert_allclose(sent, [0.1, 0.1, 0.2, 0.2, 0.2, 0.2, 0.2, 0.0, 0.0, 0.0], atol=1e-7)


RENDER = """
import gymnasium, sb3_dtfm.envs
env = gymnasium.make("Go1Velocity-v0", render_mode="rgb_array", width=800, height=600)
env.reset(seed=0)
image = env.render()
env.close()
print(image.shape, image.dtype, image.std() > 10)
"""


@pytest.mark.skipif(ctypes.util.find_library("OSMesa") is None, reason="needs OSMesa")
def test_renders_without_display():
    result = run_python(RENDER, MUJOCO_GL="osmesa")
    assert result.stdout == "(600, 800, 3) uint8 True\n", result.stderr


@pytest.mark.parametrize("action", [np.zeros(11), np.full(12, np.nan), np.zeros((1, 12))])
def test_impossible_action_is_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be \(12,\) finite numbers"):
        env.step(action)


def test_impossible_arguments_are_refused(env):
    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array', got 'human'"):
        Go1Env(render_mode="human")
    with pytest.raises(ValueError, match=r"command must be \(3,\) finite numbers"):
        env.reset(options={"command": (1.0, 0.0)})
