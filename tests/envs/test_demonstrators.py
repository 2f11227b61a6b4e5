"""The scripted demonstrators: success, variety, repetition, recovery."""

from dataclasses import replace

import numpy as np
import pytest

from sb3_dtfm.envs.demonstrators import DEMONSTRATORS, DOWNWARD, LiftDemonstrator, _rotation_between
from sb3_dtfm.envs.robosuite import RobosuiteEnv


def demonstrate(env, seed, demonstrator_seed=None):
    observation, _ = env.reset(seed=seed)
    demonstrator = DEMONSTRATORS[env.task](seed if demonstrator_seed is None else demonstrator_seed)
    actions, terminated, truncated = [], False, False
    while not (terminated or truncated):
        actions.append(demonstrator.act(observation))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
    return np.stack(actions), terminated


def test_lift_succeeds(lift):
    runs = [demonstrate(lift, seed) for seed in range(5)]
    assert all(success for _, success in runs)
    assert np.mean([len(actions) for actions, _ in runs]) < 73


def test_can_succeeds():
    env = RobosuiteEnv("Can")
    runs = [demonstrate(env, seed) for seed in range(2)]
    env.close()
    assert all(success for _, success in runs)
    assert np.mean([len(actions) for actions, _ in runs]) < 167


def test_actions_are_smooth_and_within_bounds(lift):
    actions, _ = demonstrate(lift, 0)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    assert np.abs(np.diff(actions[:, :3], axis=0)).mean() < 0.15
    assert set(actions[:, 6]) == {-1.0, 1.0}


def test_seed_decides_and_another_seed_does_otherwise(lift):
    first, _ = demonstrate(lift, 2, demonstrator_seed=5)
    again, _ = demonstrate(lift, 2, demonstrator_seed=5)
    other, _ = demonstrate(lift, 2, demonstrator_seed=6)
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_each_episode_of_one_demonstrator_has_its_own_manner():
    demonstrator = LiftDemonstrator(0)
    first = demonstrator.manner
    demonstrator.reset()
    assert demonstrator.manner.speed != first.speed


def test_cube_pushed_away_from_the_fingers_is_fetched(lift):
    observation, _ = lift.reset(seed=4)
    demonstrator = LiftDemonstrator(4)
    stages, pushed, terminated, truncated = [], False, False, False
    while not (terminated or truncated):
        action = demonstrator.act(observation)
        stages.append(demonstrator.stage)
        if demonstrator.stage == "grasp" and not pushed:
            pushed = True
            sim = lift._env.sim
            position = sim.data.get_joint_qpos("cube_joint0").copy()
            sim.data.set_joint_qpos("cube_joint0", position + np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        observation, _, terminated, truncated, _ = lift.step(action)
    assert terminated
    assert "hover" in stages[stages.index("grasp") :]


def test_rotation_between_orientations_is_the_world_rotation():
    half = 0.15  # of a turn of 0.3 rad around z, which leaves "downward" short by as much
    turn = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
    turned = np.array([turn[3], turn[2], 0.0, 0.0])  # turn * DOWNWARD, as quaternions
    np.testing.assert_allclose(_rotation_between(turned, DOWNWARD), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(_rotation_between(-turned, DOWNWARD), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(_rotation_between(DOWNWARD, DOWNWARD), np.zeros(3), atol=1e-12)


def test_the_hand_pauses_as_long_as_stated():
    at_the_cube = np.zeros(19)
    at_the_cube[3:7], at_the_cube[7:9] = DOWNWARD, (0.04, -0.04)
    pauses = []
    for seed in range(400):
        demonstrator = LiftDemonstrator(seed, pause=20.0)
        demonstrator.stage = "descend"
        demonstrator.manner = replace(demonstrator.manner, grasp_offset=np.zeros(3))
        demonstrator._misjudged_height = 0.0
        pauses.append(0)
        while demonstrator.act(at_the_cube)[6] < 0:
            pauses[-1] += 1
    # Geometric, from 1 on as the first step only begins the pause: mean 21, standard deviation 20.5
    assert np.mean(pauses) == pytest.approx(21.0, abs=3 * 20.5 / 20)
    assert np.std(pauses) == pytest.approx(20.5, rel=0.2)
