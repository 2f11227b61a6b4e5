"""The scripted demonstrators: success, variety, repetition, recovery."""

import numpy as np
import pytest

from sb3_dtfm.envs.robosuite import TASKS
from sb3_dtfm.envs.robosuite.demonstrators import LiftDemonstrator
from sb3_dtfm.envs.robosuite.demonstrators.rotations import DOWNWARD, downward, hand_yaw, object_yaw, rotation_between
from sb3_dtfm.envs.robosuite.demonstrators.stack import _grasp_yaw


def demonstrate(env, seed, demonstrator_seed=None):
    observation, _ = env.reset(seed=seed)
    demonstrator = TASKS[env.task].demonstrator(seed if demonstrator_seed is None else demonstrator_seed)
    actions, terminated, truncated = [], False, False
    while not (terminated or truncated):
        actions.append(demonstrator.act(observation))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
    return np.stack(actions), terminated


@pytest.mark.parametrize(
    ("task", "n_episodes", "mean_length"), [("Lift", 5, 73), ("Can", 2, 167), ("Stack", 3, 130), ("Square", 3, 180)]
)
def test_it_succeeds_in_good_time(task, n_episodes, mean_length, environment):
    runs = [demonstrate(environment(task), seed) for seed in range(n_episodes)]
    assert all(success for _, success in runs)
    assert np.mean([len(actions) for actions, _ in runs]) < mean_length


@pytest.mark.slow
@pytest.mark.parametrize(("task", "share"), [("Stack", 0.7), ("Square", 0.5)])
def test_it_succeeds_often(task, share, environment):
    runs = [demonstrate(environment(task), seed) for seed in range(100, 140)]
    assert np.mean([success for _, success in runs]) >= share


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


def testrotation_between_orientations_is_the_world_rotation():
    half = 0.15  # of a turn of 0.3 rad around z, which leaves "downward" short by as much
    turn = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
    turned = np.array([turn[3], turn[2], 0.0, 0.0])  # turn * DOWNWARD, as quaternions
    np.testing.assert_allclose(rotation_between(turned, DOWNWARD), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(rotation_between(-turned, DOWNWARD), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(rotation_between(DOWNWARD, DOWNWARD), np.zeros(3), atol=1e-12)


def test_yaw_is_the_turn_about_the_vertical():
    for angle in (-3.0, -0.4, 0.0, 1.2, 2.9):
        assert hand_yaw(downward(angle)) == pytest.approx(angle)
        assert object_yaw(np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])) == pytest.approx(angle)


def test_fingers_take_faces_of_the_cube_and_leave_out_its_neighbour():
    for cube, neighbour in np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 2)):
        hand = _grasp_yaw(cube, neighbour)
        assert abs(hand) <= np.pi / 2
        assert abs(np.sin(2.0 * (hand - cube))) < 1e-9  # square with the cube
        assert abs(np.cos(hand - neighbour)) >= np.cos(np.pi / 4) - 1e-9  # the fingers are beside that line


def test_the_hand_pauses_as_long_as_stated():
    at_the_cube = np.zeros(19)
    at_the_cube[3:7], at_the_cube[7:9] = DOWNWARD, (0.04, -0.04)
    pauses = []
    for seed in range(400):
        demonstrator = LiftDemonstrator(seed, pause=20.0)
        demonstrator.stage = "descend"
        demonstrator.manner.grasp_offset = np.zeros(3)
        demonstrator._misjudged_height = 0.0
        pauses.append(0)
        while demonstrator.act(at_the_cube)[6] < 0:
            pauses[-1] += 1
    # Geometric, from 1 on as the first step only begins the pause: mean 21, standard deviation 20.5
    assert np.mean(pauses) == pytest.approx(21.0, abs=3 * 20.5 / 20)
    assert np.std(pauses) == pytest.approx(20.5, rel=0.2)
