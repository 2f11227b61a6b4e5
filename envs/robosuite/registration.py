"""The names of the tasks: Gymnasium's, and those in robomimic's files."""

import json
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_dtfm.envs.robosuite.scene import CONTROL_FREQUENCY
from sb3_dtfm.envs.robosuite.tasks import TASKS

ROBOSUITE_TYPE = 1  # robomimic's number for robosuite's environments
ROBOTS = ("Panda", ["Panda"])
# Controller of our environments, by robosuite's names; robosuite <= 1.4 had other ones. `input_ref_frame` does not count:
# the arm's base is not turned against the world.
CONTROLLER: dict[str, Any] = {
    "type": "OSC_POSE",
    "output_min": [-0.05] * 3 + [-0.5] * 3,
    "output_max": [0.05] * 3 + [0.5] * 3,
    "kp": 150,
    "damping_ratio": 1,
    "impedance_mode": "fixed",
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "interpolation": None,
}
OLD_NAMES = {"damping_ratio": "damping"}


def register_robosuite_envs() -> None:
    """
    Make `gymnasium.make("robosuite/Lift-v0")` and the other tasks' ids work. Repeated calls change nothing.

    No `max_episode_steps` is registered: the horizon is the environment's own argument.
    """
    for task in TASKS:
        if _env_id(task) not in gym.registry:
            gym.register(_env_id(task), entry_point="sb3_dtfm.envs.robosuite:RobosuiteEnv", kwargs={"task": task})


def env_id_from_robomimic(env_args: str | dict[str, Any]) -> str | None:
    """
    Gymnasium id of the task of a robomimic file.

    :param env_args: the `env_args` attribute of the file's `data` group
    :return: id such as "robosuite/Lift-v0"; None for a task that is not one of ours
    """
    task, _ = _parsed(env_args)
    return None if task is None else _env_id(task)


def env_kwargs_from_robomimic(env_args: str | dict[str, Any]) -> dict[str, Any]:
    """
    Arguments of :class:`~sb3_dtfm.envs.robosuite.RobosuiteEnv` that describe the environment of a robomimic file.

    :param env_args: the `env_args` attribute of the file's `data` group, of robosuite 1.4 or 1.5
    :return: `task`, `controller_config` and `lite_physics`
    :raises ValueError: a task, robot or control frequency other than this module's
    """
    task, arguments = _parsed(env_args)
    kwargs = arguments.get("env_kwargs", {})
    if task is None:
        supported = ", ".join(repr(row.environment) for row in TASKS.values())
        raise ValueError(f"env_name is {arguments.get('env_name')!r}; supported are {supported}.")
    robots = kwargs.get("robots", "Panda")
    if robots not in ROBOTS:
        raise ValueError(f"robots is {robots!r}; only a single 'Panda' is supported.")
    frequency = kwargs.get("control_freq", CONTROL_FREQUENCY)
    if frequency != CONTROL_FREQUENCY:
        raise ValueError(f"control_freq is {frequency!r}; only {CONTROL_FREQUENCY} is supported.")
    config = kwargs.get("controller_configs")
    if isinstance(config, list):
        config = config[0]
    return {"task": task, "controller_config": config, "lite_physics": kwargs.get("lite_physics", True)}


def differences_from_robomimic(
    env_args: str | dict[str, Any], ours: str | dict[str, Any] | None = None
) -> dict[str, tuple[Any, Any]]:
    """
    Compare how actions move the arm in a robomimic file and in an environment of ours.

    :param env_args: see :func:`env_id_from_robomimic`
    :param ours: `RobosuiteEnv.env_args` of the environment; by default a registered one
    :return: value in the file and our value of each field that differs, by name; a field that is missing counts as that of
        a registered environment
    """
    return differences_in_motion(arm_motion(env_args), arm_motion(ours or {}))


def differences_in_motion(motion: dict[str, Any], ours: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """
    Compare what actions do, as :func:`arm_motion` has it.

    :param motion: motion settings of the data; plain values of any kind
    :param ours: motion settings of an environment
    :return: both values of each field that differs, by name
    """
    pairs = {name: (motion.get(name, own), own) for name, own in ours.items()}
    return {name: pair for name, pair in pairs.items() if not _alike(*pair)}


def _alike(value: Any, ours: Any) -> bool:
    try:
        return bool(np.allclose(value, ours))  # one number for all, or for each
    except (TypeError, ValueError, OverflowError):  # no numbers, or not as many
        return bool(value == ours)


def arm_motion(env_args: str | dict[str, Any]) -> dict[str, Any]:
    """
    Robot, controller and control frequency, on which the effect of an action depends, by robosuite's names.

    :param env_args: see :func:`env_id_from_robomimic`
    :return: plain values by name; a field that is missing is that of a registered environment
    """
    kwargs = _parsed(env_args)[1].get("env_kwargs", {})
    arm, robots = arm_controller(kwargs), kwargs.get("robots", "Panda")
    motion = {name: arm.get(name, arm.get(OLD_NAMES.get(name, name), ours)) for name, ours in CONTROLLER.items()}
    motion["robots"] = "Panda" if robots in ROBOTS else robots
    return {**motion, "control_freq": kwargs.get("control_freq", CONTROL_FREQUENCY)}


def arm_controller(env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    The settings of the arm's controller.

    :param env_kwargs: `env_kwargs` of a robomimic file's `env_args`
    :return: settings of robosuite 1.5, or of robosuite <= 1.4; empty where the file has none
    """
    config = env_kwargs.get("controller_configs") or {}
    config = config[0] if isinstance(config, list) else config
    return dict(config.get("body_parts", {}).get("right", config))


def _parsed(env_args: str | dict[str, Any]) -> tuple[str | None, dict[str, Any]]:
    """The task, None for one that is not ours, and all that is said of its environment."""
    arguments: dict[str, Any] = json.loads(env_args) if isinstance(env_args, str) else env_args
    tasks = {(ROBOSUITE_TYPE, row.environment): task for task, row in TASKS.items()}
    return tasks.get((arguments.get("type", ROBOSUITE_TYPE), arguments.get("env_name", ""))), arguments


def _env_id(task: str) -> str:
    return f"robosuite/{task}-v0"
