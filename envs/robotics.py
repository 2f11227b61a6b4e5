"""gymnasium-robotics' tasks: hands, arms that fetch, mazes."""

import contextlib
import io
import os
import warnings
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

# Tasks of the Adroit hand whose version 1 adds a tenth of the distance between palm and object instead of subtracting it,
# with the object: name of the simulator's array and of the task's index into it.
OBJECTS = {
    "AdroitHandDoor": ("site_xpos", "handle_site_id"),
    "AdroitHandHammer": ("xpos", "obj_body_id"),
    "AdroitHandRelocate": ("xpos", "obj_body_id"),
}


def register_gymnasium_robotics() -> None:
    """
    Make the ids of gymnasium-robotics work, as importing it does, where it is installed.

    It is imported when a task may be one of its own, since that takes half a second and MuJoCo, and in silence: its notice
    is about the tasks that :func:`warn_of_reward` warns of.
    """
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            import gymnasium_robotics
    except ImportError:
        return
    except AttributeError as error:  # MuJoCo's, of a library for rendering that is missing
        how = f"MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}"
        warnings.warn(f"MuJoCo cannot be imported with {how} ({error}): is the rendering library installed?", stacklevel=2)
        return
    gym.register_envs(gymnasium_robotics)


def _object(env: gym.Env) -> tuple[str, str] | None:
    """Return where a task with the wrong reward has its object; None for another task."""
    name = type(env.unwrapped).__name__.removesuffix("Env")
    is_dense = not getattr(env.unwrapped, "sparse_reward", True)
    return OBJECTS.get(name) if is_dense and env.spec is not None and env.spec.version == 1 else None


class AdroitReward(gym.RewardWrapper, RecordConstructorArgs):
    """
    The reward of Rajeswaran et al. (2018) for version 1 of Adroit's Door, Hammer and Relocate, as in gymnasium-robotics
    before 1.2.1: the distance between palm and object counts against the hand.

    :param env: environment of one of these tasks, with its dense reward
    :raises ValueError: another task
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        found = _object(env)
        if found is None:
            raise ValueError(f"AdroitReward expects {', '.join(f'{name}-v1' for name in OBJECTS)}, got {env}.")
        self._positions, self._index = found

    def reward(self, reward: SupportsFloat) -> float:
        """
        :param reward: reward of the environment
        :return: reward with the sign of the distance turned
        """
        task: Any = self.env.unwrapped
        palm = task.grasp_site_id if hasattr(task, "grasp_site_id") else task.S_grasp_site_id
        position = getattr(task.data, self._positions)[getattr(task, self._index)]
        return float(reward) - 0.2 * float(np.linalg.norm(task.data.site_xpos[palm] - position))


_warned_of: set[str] = set()  # ids of tasks


def warn_of_reward(env: gym.Env) -> None:
    """
    Warn once of a task whose reward is not the published one, where no :class:`AdroitReward` mends it.

    :param env: environment, with or without wrappers
    """
    inner = env
    while isinstance(inner, gym.Wrapper):
        if isinstance(inner, AdroitReward):
            return
        inner = inner.env
    if env.spec is not None and _object(env) is not None and env.spec.id not in _warned_of:
        _warned_of.add(env.spec.id)
        warnings.warn(
            f"{env.spec.id} rewards distance between palm and object, where its authors punish it, "
            "since gymnasium-robotics 1.2.1. sb3_dtfm.envs.AdroitReward(env) has their reward; data of people have it, too.",
            stacklevel=3,
        )
