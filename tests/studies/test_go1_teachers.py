"""Disturbed teachers of the Go1: which forces they feel, and how long their commands hold."""

import itertools

import numpy as np
import pytest
from go1.teachers import Damping, Drag, Dragged, Gentle, Moderate, Restless

from sb3_dtfm.envs.go1.env import Go1Env


def test_a_dragged_robot_feels_its_forces_along_the_floor_and_a_new_episode_none_before_its_first_step():
    env = Drag(Go1Env(randomize=False))
    env.reset(seed=0)
    data = env.unwrapped.simulation.data
    pulls = set()
    for _ in range(300):
        velocity = data.qvel[:2].copy()
        env.step(np.zeros(12, np.float32))
        force = data.body("trunk").xfrc_applied
        np.testing.assert_allclose(force[:2], env._pull - env._drag * velocity)
        np.testing.assert_array_equal(force[2:], 0.0)
        pulls.add(env._drag)
    assert 1 < len(pulls) < 12
    assert all(-20.0 <= drag <= 60.0 for drag in pulls)
    env.reset(seed=0)
    np.testing.assert_array_equal(data.body("trunk").xfrc_applied, 0.0)
    teacher = Dragged(Go1Env(randomize=False))
    assert teacher.reset(seed=0)[0].shape == (48,)
    assert isinstance(teacher.env, Drag)


def test_a_robot_that_is_held_back_moves_less():
    moved = []
    for drag in (0.0, 200.0):
        env = Drag(Go1Env(randomize=False))
        env.reset(seed=0)
        env.SHARE, env._pull, env._drag = 0.0, np.array([40.0, 0.0]), drag
        for _ in range(10):
            env.step(np.zeros(12, np.float32))
        moved.append(env.unwrapped.simulation.data.qvel[0])
    assert moved[0] > 2 * moved[1] > 0.0


def test_damping_is_drawn_anew_in_each_episode_for_all_joints_alike():
    env = Damping(Go1Env(randomize=False))
    model, seen = env.unwrapped.simulation.model, []
    made = model.dof_damping.copy()
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        np.testing.assert_array_equal(model.dof_damping[:6], made[:6])
        factors = model.dof_damping[6:] / made[6:]
        np.testing.assert_allclose(factors, factors[0])
        assert 1.0 <= factors[0] <= 4.0
        seen.append(factors[0])
    assert seen[0] == seen[2] != seen[1]


def test_restless_commands_hold_half_a_second():
    env = Restless(Go1Env(randomize=False))
    env.reset(seed=0)
    commands = []
    for _ in range(1000):
        env.unwrapped.simulation.reset()
        observation, *_ = env.step(np.zeros(12, np.float32))
        commands.append(tuple(observation[-3:]))
    n_changes = sum(one != two for one, two in itertools.pairwise(commands))
    assert 25 <= n_changes <= 70


@pytest.mark.parametrize(("wrapper", "share"), [(Gentle, 1 / 3), (Moderate, 2 / 3)])
def test_a_slow_teacher_is_told_a_share_of_the_command(wrapper, share):
    """The robot's own observation, which is recorded, holds all of it."""
    env = wrapper(Go1Env(randomize=False))
    command = np.array([0.9, -0.3, 0.6])
    for told in (env.reset(seed=0, options={"command": command})[0], env.step(np.zeros(12))[0]):
        np.testing.assert_allclose(told[-3:], share * command, rtol=1e-6)
        assert told.shape == (48,)
    np.testing.assert_allclose(env.unwrapped.command, command)
