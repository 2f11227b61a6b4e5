"""Adroit's tasks with the reward of their authors."""

import importlib

import gymnasium as gym
import pytest

from sb3_dtfm.envs import AdroitReward
from sb3_dtfm.envs.robotics import OBJECTS

pytest.importorskip("gymnasium_robotics")
importlib.import_module("adroit_tasks")  # registers them


@pytest.mark.parametrize("name", OBJECTS)
def test_a_task_differs_from_the_packaged_one_by_its_reward_alone(name):
    plain, mended, published = gym.make(f"{name}-v1"), AdroitReward(gym.make(f"{name}-v1")), gym.make(f"{name}Published-v1")
    for env in (plain, mended, published):
        env.reset(seed=1)
    for _ in range(3):
        steps = [env.step(published.action_space.high) for env in (plain, mended, published)]
        seen, rewards = zip(*(step[:2] for step in steps), strict=True)
        assert (seen[2] == seen[0]).all()
        assert rewards[2] == rewards[1] != rewards[0]
    assert published.spec.max_episode_steps == gym.spec(f"{name}-v1").max_episode_steps
