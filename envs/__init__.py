"""Environments: the return-to-go wrapper and the tasks that importing this package registers with Gymnasium."""

import contextlib
import io

import gymnasium as gym

from sb3_dtfm.envs.return_to_go import (
    OBSERVATION,
    RETURN_TO_GO,
    TIMESTEP,
    ReturnToGoWrapper,
    check_vec_env,
    flatten_observation_space,
    return_to_go_space,
)
from sb3_dtfm.envs.robosuite import register_robosuite_envs

# On import gymnasium-robotics prints notices about tasks that this project does not use, once in every worker process.
with contextlib.redirect_stderr(io.StringIO()):
    import gymnasium_robotics

gym.register_envs(gymnasium_robotics)
register_robosuite_envs()

__all__ = [
    "OBSERVATION",
    "RETURN_TO_GO",
    "TIMESTEP",
    "ReturnToGoWrapper",
    "check_vec_env",
    "flatten_observation_space",
    "register_robosuite_envs",
    "return_to_go_space",
]
