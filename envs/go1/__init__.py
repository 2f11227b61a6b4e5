"""Unitree's Go1, told how to walk: the task, its model, and a second simulation to transfer to."""

import gymnasium as gym

ENV_ID = "Go1Velocity-v0"
EPISODE_STEPS = 1000  # 20 seconds


def register_go1_env() -> None:
    """Make `gymnasium.make("Go1Velocity-v0")` work. Repeated calls change nothing."""
    if ENV_ID not in gym.registry:
        gym.register(ENV_ID, entry_point="sb3_dtfm.envs.go1.env:Go1Env", max_episode_steps=EPISODE_STEPS)
