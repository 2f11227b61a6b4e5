"""RobosuiteEnv: ends of episodes, what it refuses, pictures; with robosuite itself."""

import ctypes.util

import numpy as np
import pytest

from sb3_dtfm.envs.robosuite import RobosuiteEnv
from sb3_dtfm.envs.robosuite.demonstrators import LiftDemonstrator
from tests.envs.robosuite.conftest import run_python

RENDER = """
import gymnasium, sb3_dtfm.envs
env = gymnasium.make("robosuite/Lift-v0", render_mode="rgb_array", width=64, height=48)
env.reset(seed=0)
image = env.render()
print(image.shape, image.dtype, image.std() > 10)
"""


def test_an_episode_ends_with_its_only_reward_when_the_task_is_solved(lift):
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


def test_start_of_another_task_is_refused(lift, can):
    with pytest.raises(ValueError, match=r"state has shape \(71,\), expected \(32,\) for Lift"):
        lift.reset(options={"state": can.state})


@pytest.mark.parametrize("action", [np.zeros(6), np.full(7, np.nan), np.zeros((1, 7))])
def test_impossible_action_is_refused(lift, action):
    lift.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be \(7,\) finite numbers"):
        lift.step(action)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "TwoArmLift"}, "task must be one of 'Lift', 'Stack', .*'Wipe', got 'TwoArmLift'"),
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"render_mode": "ansi"}, "render_mode must be"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        RobosuiteEnv(**arguments)


@pytest.mark.skipif(ctypes.util.find_library("OSMesa") is None, reason="needs OSMesa")
def test_renders_without_display():
    result = run_python(RENDER, MUJOCO_GL="osmesa")
    assert result.stdout == "(48, 64, 3) uint8 True\n", result.stderr
