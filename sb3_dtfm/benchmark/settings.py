"""Settings of a profile for one cell: what RL-Zoo's `train` reads from its YAML file."""

import copy
import difflib
import inspect
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import yaml

from sb3_dtfm import DT, DTFM
from sb3_dtfm.zoo.arguments import UsageError
from sb3_dtfm.zoo.registration import OFFLINE_ALGORITHMS, packaged_config

WRAPPER = "sb3_dtfm.envs.ReturnToGoWrapper"
PROFILES = {"paper": None, "small": "small"}
POLICIES = {"dt": DT.policy_aliases["MultiInputPolicy"], "dtfm": DTFM.policy_aliases["MultiInputPolicy"]}
# Keys of the grid; a profile or `-params` that sets them would contradict it.
GRID_KEYS = ("dataset_fraction", "dataset_seed", "seed")
# Keys that RL-Zoo takes for itself; the others go to the constructor.
ZOO_KEYS = {"n_timesteps", "n_envs", "normalize", "env_kwargs", "env_wrapper", "vec_env_wrapper", "callback", "frame_stack"}


class Task(NamedTuple):
    """
    What is asked for one task beside the profile.

    :param env_id: Gymnasium id
    :param dataset: Minari id or robomimic file, None for the profile's
    :param target_return: in reward units, None for the profile's
    :param recorded_from: the agent or demonstrator, None for what the dataset's metadata say
    """

    env_id: str
    dataset: str | None = None
    target_return: float | None = None
    recorded_from: str | None = None


def check_task(env_id: str) -> None:
    """
    :raises UsageError: no environment of that id; names the nearest one
    """
    if env_id not in gym.registry:
        near = difflib.get_close_matches(env_id, gym.registry, n=1)
        raise UsageError(f"{env_id}: no such task{f', did you mean {near[0]}?' if near else '.'}")


def profile_name(profile: str) -> str:
    """What rows call a profile: its own name, or that of its file or folder."""
    return profile if profile in PROFILES else Path(profile).stem


def read_profile(profile: str, algo: str) -> dict[str, dict[str, Any]]:
    """
    Settings by task, as the YAML holds them.

    :param profile: "small", "paper", a YAML file for both algorithms, or a folder with dt.yml and dtfm.yml
    :param algo: "dt" or "dtfm"
    :raises UsageError: no such file, or it holds no mapping of tasks
    """
    if profile in PROFILES:
        path = packaged_config(algo, PROFILES[profile])
    else:
        path = Path(profile) / f"{algo}.yml" if Path(profile).is_dir() else Path(profile)
    if not path.is_file():
        raise UsageError(f"--profile {profile}: {path} does not exist; expected small, paper, a YAML file or a folder.")
    try:
        settings = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise UsageError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(settings, dict) or not all(isinstance(value, dict) for value in settings.values()):
        raise UsageError(f"{path}: expected a mapping from tasks (or `default`) to settings.")
    return settings


def task_settings(
    profile: str, algo: str, task: Task, regime: float, n_timesteps: int | None, hyperparams: dict[str, Any]
) -> dict[str, Any]:
    """
    Everything that RL-Zoo's `train` is to read for one cell, but the seed.

    Head settings that only the other algorithm knows are left out, so that one file or one `-params` serves both.

    :param profile: see :func:`read_profile`
    :param algo: "dt" or "dtfm"
    :param task: the task and its data
    :param regime: share of the episodes
    :param n_timesteps: gradient steps, None for the profile's
    :param hyperparams: replace the profile's; `policy_kwargs` replace entry by entry
    :raises UsageError: settings missing, unknown or not allowed here
    """
    profiles = read_profile(profile, algo)
    if task.env_id not in profiles and "default" not in profiles:
        raise UsageError(f"--profile {profile}: has neither settings for {task.env_id} nor a `default`.")
    settings = copy.deepcopy(profiles.get(task.env_id, profiles.get("default", {})))
    policy_kwargs = {**_policy_kwargs(settings), **_policy_kwargs(hyperparams)}
    settings.update(hyperparams)
    for key in GRID_KEYS:
        if key in settings:
            raise UsageError(f"{key}: the grid sets it; leave it out of the profile and of -params.")
    settings["policy_kwargs"] = _known(policy_kwargs, algo, _policy_parameters)
    settings = _known(settings, algo, _constructor_parameters)
    unknown = set(settings["policy_kwargs"]) - _policy_parameters(algo)
    unknown |= set(settings) - _constructor_parameters(algo) - ZOO_KEYS
    if unknown:
        raise UsageError(f"{', '.join(sorted(map(str, unknown)))}: no setting of {algo} (--profile {profile}, -params).")
    if task.dataset is not None:
        settings["dataset"] = task.dataset
    if task.target_return is not None:
        settings["env_wrapper"] = [{WRAPPER: {"target_return": task.target_return}}]
    if n_timesteps is not None:
        settings["n_timesteps"] = n_timesteps
    needed = {"dataset": "--dataset", "env_wrapper": "--target-return", "n_timesteps": "--n-timesteps"}
    missing = [option for key, option in needed.items() if key not in settings]
    if missing:
        raise UsageError(f"{', '.join(missing)}: needed for {task.env_id}, which --profile {profile} does not list.")
    settings.update(dataset_fraction=regime, dataset_seed=0)
    try:
        yaml.safe_dump(settings)
    except yaml.YAMLError as error:
        raise UsageError(f"{task.env_id}: a setting that YAML cannot hold: {' '.join(str(error).split())}") from error
    return settings


def check_same_trunk(settings: dict[str, dict[str, Any]], task: str) -> None:
    """
    DT and DTFM may differ in what only one of them knows, and in nothing else.

    :param settings: by algorithm
    :param task: for the message
    :raises UsageError: names what differs
    """
    if set(settings) != set(OFFLINE_ALGORITHMS):
        return
    flat = {algo: {**each, **_policy_kwargs(each)} for algo, each in settings.items()}
    own = _only_of("dtfm", _policy_parameters) | _only_of("dtfm", _constructor_parameters) | {"policy_kwargs"}
    for key in sorted((set(flat["dt"]) | set(flat["dtfm"])) - own):
        values = [flat[algo].get(key) for algo in ("dt", "dtfm")]
        if values[0] != values[1]:
            raise UsageError(f"{key} of {task} is {values[0]!r} for dt and {values[1]!r} for dtfm; both need the same.")


def _policy_kwargs(settings: dict[str, Any]) -> dict[str, Any]:
    """
    :raises UsageError: they are no mapping
    """
    found = settings.get("policy_kwargs") or {}
    if not isinstance(found, dict):
        raise UsageError(f"policy_kwargs is {found!r}, expected a mapping.")
    return found


def _known(settings: dict[str, Any], algo: str, parameters: Any) -> dict[str, Any]:
    """The settings without those that another algorithm knows and this one does not."""
    others = set().union(*(_only_of(other, parameters) for other in OFFLINE_ALGORITHMS if other != algo))
    return {key: value for key, value in settings.items() if key not in others}


def _only_of(algo: str, parameters: Any) -> set[str]:
    """Names that one algorithm knows and none of the others."""
    return parameters(algo) - set().union(*(parameters(other) for other in OFFLINE_ALGORITHMS if other != algo))


@cache
def _constructor_parameters(algo: str) -> frozenset[str]:
    return frozenset(inspect.signature(OFFLINE_ALGORITHMS[algo]).parameters)


@cache
def _policy_parameters(algo: str) -> frozenset[str]:
    """Arguments of the policy class; DTFM's own ones stand beside `**kwargs`."""
    policy = POLICIES[algo]
    return frozenset(name for kind in policy.__mro__ for name in inspect.signature(kind).parameters)
