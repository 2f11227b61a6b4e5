"""Small real things that many tests share."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.utils import set_random_seed

from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.envs import ReturnToGoWrapper
from tests.recorded import minari_folder, workplace  # noqa: F401  (fixtures of the packages that use the command line)

# Decision Transformer's own settings at a tiny size; those that the classes have by default are tested beside them.
TINY_POLICY = dict(
    embed_dim=32,
    n_layers=2,
    n_heads=2,
    dropout=0.1,
    tokens_per_step=3,
    timestep_embedding=True,
    chunk_size=1,
    return_scaling="max",
    clip_return_to_go=False,
    film_return_to_go=False,
    observation_scaling="std",
    return_conditioning=True,
    expected_return_steps=0,
)
TINY_FLOW_POLICY = dict(
    TINY_POLICY,
    flow_hidden_dim=32,
    flow_n_layers=2,
    flow_prediction="velocity",
    flow_tau_exponent=1.0,
    regression_coef=0.0,
    flow_steps=4,
    one_step_policy=True,
)
# Constant learning rate and the newest weights: what a few gradient steps change shows at once.
PLAIN = dict(
    learning_rate=1e-4,
    learning_rate_schedule="constant",
    warmup_steps=0,
    ema_decay=0.0,
    return_weighting=0.0,
)
EPISODE_LENGTH = 30


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first: one that begins last would have a core for itself while the other has nothing left to do."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """
    Tests share the cores with one another; threads that wait for each other would make them slow.

    Before any other fixture: another number of threads adds up in another order, to other bits.
    """
    th.set_num_threads(1)


@pytest.fixture(autouse=True)
def same_random_numbers():
    """Every run of a test draws the same, also where it names no seed."""
    set_random_seed(0)


def make_env(seed: int | None = None) -> gym.Env:
    """HalfCheetah in episodes of 30 steps, with a target return of 5."""
    env = ReturnToGoWrapper(gym.make("HalfCheetah-v5", max_episode_steps=EPISODE_LENGTH), target_return=5.0)
    if seed is not None:
        env.reset(seed=seed)
    return env


def record_random_episodes(n_episodes: int, seed: int = 0) -> list[Trajectory]:
    """Episodes of HalfCheetah under random actions."""
    env = gym.make("HalfCheetah-v5", max_episode_steps=EPISODE_LENGTH)
    env.action_space.seed(seed)
    trajectories = []
    for episode in range(n_episodes):
        observations, actions, rewards, truncated = [], [], [], False
        observation, _ = env.reset(seed=seed + episode)
        while not truncated:
            action = env.action_space.sample()
            observations.append(observation)
            actions.append(action)
            observation, reward, _, truncated, _ = env.step(action)
            rewards.append(reward)
        trajectories.append(
            Trajectory(
                np.array(observations), np.array(actions), np.array(rewards), truncated=True, name=f"episode {episode}"
            )
        )
    return trajectories


@pytest.fixture(scope="session")
def cheetah_buffer() -> TrajectoryBuffer:
    space = gym.make("HalfCheetah-v5").action_space
    return TrajectoryBuffer.from_trajectories(record_random_episodes(6), space, source="random cheetah")
