"""A task of Discrete actions that a small model learns in seconds, and episodes of it."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_dtfm.data import Trajectory
from sb3_dtfm.envs import ReturnToGoWrapper

START, N = 5, 3


class Signs(gym.Env):
    """The right choice is the sign of what is observed, -1, 0 or 1, and is rewarded with 1; ten steps."""

    observation_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, action_space: spaces.Space | None = None) -> None:
        self.action_space = action_space or spaces.Discrete(N, start=START)
        self.n_steps, self.sign = 0, 0

    def see(self) -> np.ndarray:
        self.sign = int(self.np_random.integers(-1, 2))
        return np.array([self.sign], np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.n_steps = 0
        return self.see(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert self.action_space.contains(action), repr(action)
        right = action == self.sign + START + 1
        self.n_steps += 1
        return self.see(), float(right), False, self.n_steps == 10, {}


def make_env() -> gym.Env:
    return ReturnToGoWrapper(Signs(), target_return=10.0)


def record(n_episodes: int = 20, error: float = 0.0) -> list[Trajectory]:
    """Right choices, but for a share of `error` that is one too small."""
    env, generator, episodes = Signs(), np.random.default_rng(0), []
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed)
        observations, actions, rewards, truncated = [], [], [], False
        while not truncated:
            wrong = generator.random() < error and env.sign > -1
            actions.append(np.int64(env.sign + START + 1 - wrong))
            observations.append(observation)
            observation, reward, _, truncated, _ = env.step(actions[-1])
            rewards.append(reward)
        episodes.append(Trajectory(np.array(observations), np.array(actions), np.array(rewards), truncated=True))
    return episodes
