"""A real task whose pictures are its observation, beside numbers: Gymnasium's Pendulum, drawn small."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import AddRenderObservation, TransformObservation

CAMERA = "pixels"
EPISODE_LENGTH = 20
# Every so many pixels one is kept, of 500.
EVERY = 16


def make_pixels(numbers: bool = True) -> gym.Env:
    """
    :param numbers: show the state beside the picture
    :return: pictures of (32, 32, 3)
    """
    env = AddRenderObservation(
        gym.make("Pendulum-v1", render_mode="rgb_array", max_episode_steps=EPISODE_LENGTH), render_only=not numbers
    )
    image = spaces.Box(0, 255, (32, 32, 3), np.uint8)
    if not numbers:
        return TransformObservation(env, lambda seen: seen[::EVERY, ::EVERY], image)
    space = spaces.Dict({CAMERA: image, "state": env.observation_space["state"]})
    return TransformObservation(env, lambda seen: {**seen, CAMERA: seen[CAMERA][::EVERY, ::EVERY]}, space)


def record(n_episodes: int, numbers: bool = True) -> list[list[tuple]]:
    """Episodes of random actions, as lists of steps."""
    env = make_pixels(numbers)
    env.action_space.seed(0)
    episodes = []
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed)
        steps, over = [], False
        while not over:
            action = env.action_space.sample()
            following, reward, terminated, truncated, _ = env.step(action)
            steps.append((observation, action, reward, terminated, truncated))
            observation, over = following, terminated or truncated
        episodes.append(steps)
    return episodes
