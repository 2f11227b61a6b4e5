"""Environments: the return-to-go wrapper and the tasks that importing this package registers with Gymnasium."""

from typing import TYPE_CHECKING, Any

from sb3_dtfm.envs.go1 import register_go1_env
from sb3_dtfm.envs.robosuite.registration import register_robosuite_envs
from sb3_dtfm.envs.robotics import AdroitReward, register_gymnasium_robotics, warn_of_reward

if TYPE_CHECKING:
    from sb3_dtfm.envs.cameras import RenderWrapper, resize_image
    from sb3_dtfm.envs.observation_spaces import (
        OBSERVATION,
        RETURN_TO_GO,
        TIMESTEP,
        channels_first,
        flatten_observation_space,
        image_spaces,
        return_to_go_space,
        without_images,
    )
    from sb3_dtfm.envs.return_to_go import (
        BETWEEN,
        ReturnToGoWrapper,
        check_vec_env,
        known_task,
        reader_options,
        share_target_return,
    )

register_go1_env()
register_robosuite_envs()

__all__ = [
    "BETWEEN",
    "OBSERVATION",
    "RETURN_TO_GO",
    "TIMESTEP",
    "AdroitReward",
    "RenderWrapper",
    "ReturnToGoWrapper",
    "channels_first",
    "check_vec_env",
    "flatten_observation_space",
    "image_spaces",
    "known_task",
    "reader_options",
    "register_go1_env",
    "register_gymnasium_robotics",
    "register_robosuite_envs",
    "resize_image",
    "return_to_go_space",
    "share_target_return",
    "warn_of_reward",
    "without_images",
]


def __getattr__(name: str) -> Any:
    """The wrapper and what comes with it, when they are asked for: Stable-Baselines3 takes seconds to import."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sb3_dtfm.envs import cameras, observation_spaces, return_to_go

    return next(getattr(module, name) for module in (cameras, observation_spaces, return_to_go) if hasattr(module, name))
