"""Adroit's reward: the one that its authors published, and a warning where the installed one is another."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_dtfm.envs import AdroitReward, ReturnToGoWrapper, register_gymnasium_robotics, robotics

pytest.importorskip("gymnasium_robotics")
register_gymnasium_robotics()
TASKS = ("AdroitHandDoor-v1", "AdroitHandHammer-v1", "AdroitHandRelocate-v1")


@pytest.mark.parametrize("task", TASKS)
def test_the_distance_counts_against_the_hand(task):
    env = AdroitReward(gym.make(task))
    env.reset(seed=0)
    env.action_space.seed(0)
    bare = gym.make(task)
    bare.reset(seed=0)
    for _ in range(5):
        action = env.action_space.sample()
        observation, reward, *_ = env.step(action)
        _, rewarded, *_ = bare.step(action)
        # As the observation has it: palm and hammer, or their differences.
        if "Door" in task:
            distance = np.linalg.norm(observation[35:38])
        elif "Relocate" in task:
            distance = np.linalg.norm(observation[30:33])
        else:
            distance = np.linalg.norm(observation[33:36] - observation[36:39])
        assert reward == pytest.approx(rewarded - 0.2 * distance, abs=1e-9)


def test_a_door_that_is_shut_costs_what_its_authors_say():
    env = AdroitReward(gym.make("AdroitHandDoor-v1"))
    env.reset(seed=0)
    observation, reward, *_ = env.step(np.zeros(28))
    data = env.unwrapped.data
    hinge = data.qpos[env.unwrapped.door_hinge_addrs]
    expected = -0.1 * np.linalg.norm(observation[35:38]) - 0.1 * (hinge - 1.57) ** 2 - 1e-5 * np.sum(data.qvel**2)
    assert reward == pytest.approx(float(expected), abs=1e-9)
    assert reward < 0


@pytest.mark.parametrize("task", TASKS)
def test_the_reward_of_the_installed_version_is_warned_of_once(task, recwarn, monkeypatch):
    monkeypatch.setattr(robotics, "_warned_of", set())  # by tests before
    with pytest.warns(UserWarning, match=rf"{task} rewards distance between palm and object.*AdroitReward\(env\)"):
        ReturnToGoWrapper(gym.make(task), 1.0)
    recwarn.clear()
    ReturnToGoWrapper(gym.make(task), 1.0)
    ReturnToGoWrapper(AdroitReward(gym.make(task)), 1.0)
    ReturnToGoWrapper(gym.make("AdroitHandPen-v1"), 1.0)
    assert not [each for each in recwarn if "palm" in str(each.message)]


@pytest.mark.parametrize("task", ["AdroitHandPen-v1", "AdroitHandDoorSparse-v1", "HalfCheetah-v5"])
def test_other_tasks_keep_their_reward(task):
    with pytest.raises(
        ValueError, match="AdroitReward expects AdroitHandDoor-v1, AdroitHandHammer-v1, AdroitHandRelocate-v1"
    ):
        AdroitReward(gym.make(task))
