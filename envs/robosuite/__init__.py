"""robosuite's single-arm tasks as Gymnasium environments: a table of tasks, one environment, demonstrators."""

from sb3_dtfm.envs.robosuite.env import RobosuiteEnv
from sb3_dtfm.envs.robosuite.registration import (
    arm_controller,
    arm_motion,
    differences_from_robomimic,
    differences_in_motion,
    env_id_from_robomimic,
    env_kwargs_from_robomimic,
    register_robosuite_envs,
)
from sb3_dtfm.envs.robosuite.tasks import TASKS, RobosuiteTask

__all__ = [
    "TASKS",
    "RobosuiteEnv",
    "RobosuiteTask",
    "arm_controller",
    "arm_motion",
    "differences_from_robomimic",
    "differences_in_motion",
    "env_id_from_robomimic",
    "env_kwargs_from_robomimic",
    "register_robosuite_envs",
]
