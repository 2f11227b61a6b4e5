"""The loop and its recorder: what is kept is what the environment itself gave and was given."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_dtfm.envs import register_gymnasium_robotics
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes


class Sum(gym.Env):
    """Observes the sum of all actions so far, which is also the reward, and ends when it reaches 3."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.sum = np.zeros(1)
        return self.sum, {}

    def step(self, action):
        self.sum += action
        return self.sum, self.sum[0], bool(self.sum >= 3.0), False, {}


class Disguise(gym.Wrapper):
    """Shows and takes everything ten-fold, and ends an episode after `limit` steps on its own."""

    def __init__(self, env, limit):
        super().__init__(env)
        self.limit = limit

    def reset(self, **kwargs):
        self.n_steps = 0
        observation, info = self.env.reset(**kwargs)
        return 10 * observation, info

    def step(self, action):
        self.n_steps += 1
        observation, reward, terminated, truncated, info = self.env.step(action / 10)
        return 10 * observation, 10 * reward, terminated or self.n_steps == self.limit, truncated, info


def run(limit, seeds=(7,)):
    seen = []

    def act(observations, starts, numbers):
        seen.append(observations.copy())
        return np.full((len(numbers), 1), 10.0)

    envs = [Disguise(EpisodeRecorder(Sum()), limit) for _ in range(2)]
    return list(run_episodes(envs, act, seeds)), seen


def test_wrappers_change_what_the_agent_sees_and_not_what_is_recorded():
    (episode,), seen = run(limit=5)
    assert [observations[0, 0] for observations in seen] == [0.0, 10.0, 20.0]
    assert np.concatenate(episode.observations).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert np.concatenate(episode.actions).tolist() == [1.0, 1.0, 1.0]
    assert episode.actions[0].dtype == np.float32
    assert episode.rewards == [1.0, 2.0, 3.0]
    assert (episode.seed, episode.terminated, episode.truncated) == (7, True, False)


def test_an_episode_that_a_wrapper_ends_is_truncated():
    (episode,), _ = run(limit=2)
    assert episode.rewards == [1.0, 2.0]
    assert (episode.terminated, episode.truncated) == (False, True)


def test_episodes_come_in_the_order_of_their_seeds():
    episodes, _ = run(limit=5, seeds=(3, 1, 4, 1, 5))
    assert [episode.seed for episode in episodes] == [3, 1, 4, 1, 5]


@pytest.mark.parametrize(("env_id", "success"), [("AdroitHandDoor-v1", False), ("HalfCheetah-v5", None)])
def test_success_is_what_the_environment_says_or_nothing(env_id: str, success: bool | None):
    register_gymnasium_robotics()
    with EpisodeRecorder(gym.make(env_id, max_episode_steps=2)) as env:
        (episode,) = run_episodes([env], lambda _, __, numbers: np.zeros((len(numbers), *env.action_space.shape)), [0])
    assert episode.truncated
    assert episode.success is success
