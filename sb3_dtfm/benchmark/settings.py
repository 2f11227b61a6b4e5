"""Settings of a profile for one run, which RL-Zoo's `train` reads from its YAML file."""

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import yaml

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.rows import BASELINES
from sb3_dtfm.zoo.arguments import UsageError, read_yaml, with_target_return
from sb3_dtfm.zoo.registration import packaged_config, policy_of, with_policy_options

PROFILES = {"default": None, "paper": "paper"}
# Keys of the grid; a profile or `-params` that sets them would contradict it.
GRID_KEYS = ("seed",)
# Keys of `dataset_kwargs` that the grid sets, too.
GRID_DATASET_KEYS = ("fraction", "fraction_seed")
# Keys that RL-Zoo takes for itself; the others go to the constructor.
ZOO_KEYS = {"n_timesteps", "n_envs", "normalize", "env_kwargs", "env_wrapper", "vec_env_wrapper", "callback", "frame_stack"}

# Mappings whose entries replace those of the profile one by one.
MERGED = ("env_kwargs", "dataset_kwargs")
# Settings that behaviour cloning shares with the others, and its own.
CLONING_SHARES = ("dataset", "dataset_kwargs", "env_kwargs", "env_wrapper", "vec_env_wrapper")
CLONING = {"n_timesteps": 5000, "batch_size": 256, "learning_rate": 1e-3, "hidden_sizes": [256, 256, 256]}


class Task(NamedTuple):
    """
    A user's settings of one task beside the profile: an entry of the file of `--datasets`.

    :param name: name of the task with its data in rows and reports
    :param dataset: Minari id, robomimic file or flat arrays, None for the profile's
    :param target_return: target return in reward units, None for the profile's or the data's suggestion
    :param recorded_from: agent or demonstrator, None for that in the dataset's metadata
    :param task: Gymnasium id, None where the name is it
    :param env_kwargs: arguments of `gymnasium.make`, beside the profile's
    :param dataset_kwargs: arguments of :func:`~sb3_dtfm.data.load_dataset`, beside the profile's
    :param fraction: share of the dataset's episodes, in (0, 1], that counts as all of them
    :param gym_packages: modules that register the task
    :param algorithms: algorithms that can learn it, None for all
    :param chosen_with: whether a default was chosen with it, so that it does not judge the defaults
    """

    name: str
    dataset: str | None = None
    target_return: float | None = None
    recorded_from: str | None = None
    task: str | None = None
    env_kwargs: Mapping[str, Any] = MappingProxyType({})
    dataset_kwargs: Mapping[str, Any] = MappingProxyType({})
    fraction: float = 1.0
    gym_packages: Sequence[str] = ()
    algorithms: Sequence[str] | None = None
    chosen_with: bool = False

    @property
    def env_id(self) -> str:
        """Gymnasium id."""
        return self.task or self.name


def profile_name(profile: str) -> str:
    """Name of a profile in rows: its own, or that of its file or folder."""
    return profile if profile in PROFILES else Path(profile).stem


def read_profile(profile: str, algo: str, env_id: str) -> dict[str, Any]:
    """
    Settings of one task, or those for any other.

    :param profile: "default", "paper", a YAML file for all algorithms, or a folder with one for each
    :param algo: name of the algorithm, for example "dtfm"
    :param env_id: Gymnasium id
    :raises UsageError: no such file, or it holds no settings for the task
    """
    if profile in PROFILES:
        path = packaged_config(algo, PROFILES[profile])
    else:
        path = Path(profile) / f"{algo}.yml" if Path(profile).is_dir() else Path(profile)
    if not path.is_file():
        raise UsageError(f"--profile {profile}: {path} does not exist; expected default, paper, a YAML file or a folder.")
    profiles = read_yaml(path)
    settings = profiles.get(env_id, profiles.get("default"))
    if not isinstance(settings, dict):
        raise UsageError(f"--profile {profile}: has neither settings for {env_id} nor a `default`.")
    return copy.deepcopy(settings)


def task_settings(
    profile: str, algo: str, task: Task, data_share: float, n_timesteps: int | None, hyperparams: dict[str, Any]
) -> dict[str, Any]:
    """
    Everything that RL-Zoo's `train` is to read for one run, but the seed.

    Settings that only another algorithm knows are left out, so that one file or one `-params` serves all.

    :param profile: name or path of the profile, see :func:`read_profile`
    :param algo: name of the algorithm, for example "dtfm"
    :param task: task and its data
    :param data_share: share of the episodes, in (0, 1]
    :param n_timesteps: number of gradient steps, None for the profile's
    :param hyperparams: settings that replace the profile's; mappings of keyword arguments replace entry by entry, and
        options of the policy may stand beside the others
    :return: settings, with a target return if the command, the file of datasets or the profile, for its own dataset, has one
    :raises UsageError: settings missing, unknown or not allowed here
    """
    settings = read_profile(profile, algo, task.env_id)
    if task.dataset is not None and "dataset" in settings:  # to which the target return belongs
        settings["env_wrapper"] = with_target_return(None, settings.get("env_wrapper"))
    hyperparams = with_policy_options(hyperparams)
    policy_kwargs = {**_mapping(settings, "policy_kwargs"), **_mapping(hyperparams, "policy_kwargs")}
    merged = {key: {**_mapping(settings, key), **getattr(task, key), **_mapping(hyperparams, key)} for key in MERGED}
    settings.update({**hyperparams, **{key: value for key, value in merged.items() if value}})
    dataset_kwargs = _mapping(settings, "dataset_kwargs")
    for key in (*GRID_KEYS, *GRID_DATASET_KEYS):
        if key in (dataset_kwargs if key in GRID_DATASET_KEYS else settings):
            raise UsageError(f"{key}: the grid sets it; leave it out of the profile and of -params.")
    settings = _known(settings, algo, _constructor_parameters)
    settings["policy_kwargs"] = _known(policy_kwargs, algo, _policy_parameters)
    if task.dataset is not None:
        settings["dataset"] = task.dataset
    if task.target_return is not None:
        settings["env_wrapper"] = with_target_return(task.target_return, settings.get("env_wrapper"))
    if n_timesteps is not None:
        settings["n_timesteps"] = n_timesteps
    needed = {"dataset": "--dataset", "n_timesteps": "--n-timesteps"}
    missing = [option for key, option in needed.items() if key not in settings]
    if missing:
        raise UsageError(f"{', '.join(missing)}: needed for {task.name}, which --profile {profile} does not list.")
    settings["dataset_kwargs"] = {**dataset_kwargs, "fraction": task.fraction * data_share, "fraction_seed": 0}
    try:
        yaml.safe_dump(settings)
    except yaml.YAMLError as error:
        raise UsageError(f"{task.name}: a setting that YAML cannot hold: {' '.join(str(error).split())}") from error
    return settings


def cloning_settings(algo: str, settings: Mapping[str, Any], n_timesteps: int | None) -> dict[str, Any]:
    """
    Settings of a run of behaviour cloning.

    :param algo: key of `BASELINES`
    :param settings: settings of DT or DTFM, whose data and environment it shares
    :param n_timesteps: number of gradient steps, None for 5,000
    """
    shared = {key: settings[key] for key in CLONING_SHARES if key in settings}
    asked = {} if n_timesteps is None else {"n_timesteps": n_timesteps}
    return {**shared, **CLONING, **asked, "best_share": BASELINES[algo]}


def check_same_transformer(settings: dict[str, dict[str, Any]], task: str) -> None:
    """
    Check that algorithms differ only in settings that not all of them know.

    :param settings: settings of all algorithms, by algorithm
    :param task: name of the task in the message
    :raises UsageError: a setting that differs, by name
    """
    flat = {algo: {**each, **_mapping(each, "policy_kwargs")} for algo, each in settings.items()}
    common = [set.intersection(*map(of, ALGORITHMS)) for of in (_constructor_parameters, _policy_parameters)]
    for key in sorted(set.union(*common) - {"policy_kwargs"}):
        values = {algo: each.get(key) for algo, each in flat.items()}
        if any(value != next(iter(values.values())) for value in values.values()):
            found = " and ".join(f"{value!r} for {algo}" for algo, value in values.items())
            raise UsageError(f"{key} of {task} is {found}; one value for all is needed.")


def _mapping(settings: dict[str, Any], key: str) -> dict[str, Any]:
    """
    :raises UsageError: a value that is no mapping
    """
    found = settings.get(key) or {}
    if not isinstance(found, dict):
        raise UsageError(f"{key} is {found!r}, expected a mapping.")
    return found


def _known(settings: dict[str, Any], algo: str, parameters: Callable[[str], set[str]]) -> dict[str, Any]:
    """
    The settings without those that only other algorithms know.

    :raises UsageError: a setting that no algorithm knows
    """
    unknown = set(settings).difference(*map(parameters, ALGORITHMS))
    if unknown:
        raise UsageError(f"{', '.join(sorted(map(str, unknown)))}: no setting of {algo} (--profile, -params).")
    return {key: value for key, value in settings.items() if key in parameters(algo)}


def _constructor_parameters(algo: str) -> set[str]:
    """Keys of a YAML file: arguments of the algorithm, and RL-Zoo's own."""
    return ZOO_KEYS | set(inspect.signature(ALGORITHMS[algo]).parameters)


def _policy_parameters(algo: str) -> set[str]:
    """Keys of an algorithm's `policy_kwargs`."""
    return policy_of(algo).parameter_names()
