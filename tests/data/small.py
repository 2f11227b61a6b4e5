"""Small episodes and buffers of random numbers."""

import numpy as np
from gymnasium import spaces

from sb3_dtfm.data import Trajectory, TrajectoryBuffer

ACTION_SPACE = spaces.Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 2.0], np.float32))
OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (3,), np.float32)


def make_trajectory(n_steps: int, seed: int = 0, **changes: object) -> Trajectory:
    rng = np.random.default_rng(seed)
    arrays: dict = {
        "observations": rng.normal(size=(n_steps, 3)),
        "actions": rng.uniform(ACTION_SPACE.low, ACTION_SPACE.high, size=(n_steps, 2)),
        "rewards": rng.normal(size=n_steps),
    }
    return Trajectory(**{**arrays, **changes})


def make_buffer(lengths: list[int]) -> TrajectoryBuffer:
    trajectories = [make_trajectory(length, seed) for seed, length in enumerate(lengths)]
    return TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE, OBSERVATION_SPACE)
