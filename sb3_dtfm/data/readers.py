"""The table of readers, and one function that finds the right one for a dataset."""

import copy
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import gymnasium as gym
from gymnasium import spaces
from minari import MinariDataset
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.arguments import BOOLEAN, POSITIVE, Number, Rule, check_arguments, with_nearest
from sb3_dtfm.data.arrays import is_table
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, load_cached
from sb3_dtfm.data.flat import fingerprint_flat_file, holds_episodes, is_flat_file, is_mapping, load_flat
from sb3_dtfm.data.in_memory import (
    is_replay_buffer,
    load_episodes,
    load_replay_buffer,
    load_steps,
)
from sb3_dtfm.data.lerobot import fingerprint_lerobot, is_lerobot, load_lerobot
from sb3_dtfm.data.minari import fingerprint_minari, is_minari, load_minari
from sb3_dtfm.data.observations import check_order
from sb3_dtfm.data.pickles import unpickled, without_pickles
from sb3_dtfm.data.robomimic import fingerprint_robomimic, is_robomimic, load_robomimic
from sb3_dtfm.data.steps import is_episodes, is_steps
from sb3_dtfm.data.trajectories import DatasetError
from sb3_dtfm.data.zarr_replay import fingerprint_zarr, is_zarr, load_zarr

# All that is accepted as a dataset; load_dataset says more.
Dataset: TypeAlias = (
    str | os.PathLike[str] | MinariDataset | Mapping[str, Any] | Sequence[Any] | ReplayBuffer | TrajectoryBuffer
)
# Options that load_dataset itself applies to a dataset of any kind.
COMMON_OPTIONS = (
    *("env_id", "env_args", "action_space", "observation_space", "max_episode_steps", "min_return", "best_share"),
    *("success_only", "fraction", "fraction_seed", "allow_pickle"),
)
# Rules for options that readers do not check themselves.
ACCEPTED: dict[str, Rule] = {
    "clip_actions": BOOLEAN,
    "success_only": BOOLEAN,
    "allow_pickle": BOOLEAN,
    "min_return": Number(optional=True),
    "max_episode_steps": Number(low=1, whole=True, optional=True),
    "best_share": Number(low=0.0, high=1.0, above_low=True, optional=True),
    "fraction": Number(low=0.0, high=1.0, above_low=True),
    "fraction_seed": Number(low=0, whole=True, optional=True),
}


class Reader(NamedTuple):
    """
    A reader of datasets of one kind.

    :param kind: description of such a dataset, for messages
    :param accepts: function that tells whether something is such a dataset
    :param load: function that reads one; its other parameters are the options that users have, and `storage` of the steps
    :param fingerprint: function from the dataset and the options for `load` to a cache's fingerprint; None for no caches
    """

    kind: str
    accepts: Callable[[Any], bool]
    load: Callable[..., TrajectoryBuffer]
    fingerprint: Callable[[Any, dict[str, Any]], Fingerprint] | None


def is_several(dataset: Any) -> bool:
    """Return whether this is a list of datasets, by any entry that cannot be an episode."""
    return is_episodes(dataset) and any(_is_no_episode(each) for each in dataset)


def _is_no_episode(dataset: Any) -> bool:
    if is_mapping(dataset):
        return "dataset" in dataset or holds_episodes(dataset)
    return is_table(dataset) or isinstance(dataset, str | os.PathLike | MinariDataset | ReplayBuffer | TrajectoryBuffer)


def load_several(
    datasets: Sequence[Any],
    action_space: ActionSpace | None = None,
    observation_space: spaces.Space | None = None,
    env_id: str | None = None,
    env_args: dict[str, Any] | None = None,
    max_episode_steps: int | None = None,
    allow_pickle: bool = False,
    observation_keys: Sequence[str] | Mapping[str, str] | None = None,
    clip_actions: bool = False,
) -> TrajectoryBuffer:
    """
    Several datasets of one task as one, in memory.

    :param datasets: anything that :func:`load_dataset` takes, or `{"dataset": it, "weight": 2.0, ...}` with its other
        arguments; a step of one of weight 2 is learned from twice as often as one of weight 1
    :param action_space: see :func:`load_dataset`; like the next ones it counts for each that has none of its own
    :param observation_space: see :func:`load_dataset`
    :param env_id: see :func:`load_dataset`
    :param env_args: see :func:`load_dataset`
    :param max_episode_steps: see :func:`load_dataset`
    :param allow_pickle: see :func:`load_dataset`
    :param observation_keys: see the reader of each
    :param clip_actions: see the reader of each
    :raises DatasetError: one of them cannot be read, or is of another task; a weight that is no positive number
    """
    buffers, weights = [], []
    shared: dict[str, Any] = {"action_space": action_space, "observation_space": observation_space, "env_id": env_id}
    shared.update(env_args=env_args, max_episode_steps=max_episode_steps, allow_pickle=allow_pickle)
    of_readers = {"observation_keys": observation_keys, "clip_actions": clip_actions}
    shared.update({name: value for name, value in of_readers.items() if value})
    for each in datasets:
        options = without_pickles(each) if is_mapping(each) and "dataset" in each else {"dataset": each}
        dataset, weight = options.pop("dataset"), options.pop("weight", 1.0)
        if not POSITIVE.accepts(weight):
            raise DatasetError(f"dataset {dataset!s}: weight is {weight!r}; a positive number is accepted.")
        buffers.append(load_dataset(dataset, **{**shared, **options}))
        weights.append(float(weight))
    return TrajectoryBuffer.join(buffers, weights)


# The first one that accepts a dataset reads it.
READERS = (
    Reader(
        "the path of a file of flat arrays (.npz, .hdf5) or of a table (.csv, .parquet)",
        is_flat_file,
        load_flat,
        fingerprint_flat_file,
    ),
    Reader("the path of a LeRobot dataset (a folder)", is_lerobot, load_lerobot, fingerprint_lerobot),
    Reader("the path of a zarr replay buffer (.zarr, .zarr.zip)", is_zarr, load_zarr, fingerprint_zarr),
    Reader("the path of a robomimic file (.hdf5)", is_robomimic, load_robomimic, fingerprint_robomimic),
    Reader("a Minari id (namespace/name-vN) or MinariDataset", is_minari, load_minari, fingerprint_minari),
    Reader("a dictionary of flat arrays", is_mapping, load_flat, None),
    Reader("a DataFrame", is_table, load_flat, None),
    Reader("a list of steps", is_steps, load_steps, None),
    Reader("a list of datasets", is_several, load_several, None),
    Reader("a list of episodes", is_episodes, load_episodes, None),
    Reader("an SB3 ReplayBuffer", is_replay_buffer, load_replay_buffer, None),
    Reader("a TrajectoryBuffer", lambda dataset: isinstance(dataset, TrajectoryBuffer), lambda dataset: dataset, None),
)

# Readers whose observation_keys may be a mapping.
RENAMING = (load_lerobot, load_zarr, load_robomimic, load_several)


def load_dataset(
    dataset: Dataset,
    cache_dir: str | os.PathLike[str] | None = None,
    env_id: str | None = None,
    env_args: dict[str, Any] | None = None,
    action_space: ActionSpace | None = None,
    observation_space: spaces.Space | None = None,
    max_episode_steps: int | None = None,
    min_return: float | None = None,
    best_share: float | None = None,
    success_only: bool = False,
    fraction: float = 1.0,
    fraction_seed: int = 0,
    allow_pickle: bool = False,
    **kwargs: Any,
) -> TrajectoryBuffer:
    """
    Read recorded episodes from wherever they are.

    :param dataset: a Minari id (`namespace/name-vN`), an opened Minari dataset, the path of a robomimic hdf5 file; flat
        arrays, as the path of an `.npz` or of D4RL's hdf5, or a dictionary, see :func:`load_flat`; a table, as the path of a
        `.csv` or `.parquet` or a DataFrame, see there too; the folder of a LeRobot dataset, see :func:`load_lerobot`; a list
        of episodes, see :func:`load_episodes`, or of steps, see :func:`load_steps`; an SB3 replay buffer, see
        :func:`load_replay_buffer`; a list of several datasets, see :func:`load_several`; a buffer
    :param cache_dir: folder of memory-mapped files to learn from, for datasets larger than memory; they are written at the
        first call and whenever the dataset has changed. None reads everything into memory
    :param env_id: Gymnasium id of the environment that the episodes count as coming from, whatever the dataset says
    :param env_args: the environment's description in robomimic's words, for robomimic files, see :func:`load_robomimic`
    :param action_space: the environment's action space, for data that do not tell of a range of actions
    :param observation_space: the environment's observation space, for data that do not tell what is a choice: a Discrete
        part becomes a one-hot vector, as :class:`~sb3_dtfm.envs.ReturnToGoWrapper` shows it
    :param max_episode_steps: number of steps after which the rest of an episode is left out, with a warning; see
        :meth:`TrajectoryBuffer.within`. None keeps all
    :param min_return: smallest return of an episode that is kept, environment reward units; None keeps all
    :param best_share: share of the episodes that is kept, those of the largest returns, in (0, 1]; None keeps all
    :param success_only: whether to keep only successes, by what the data say of each episode's last step; see
        :attr:`TrajectoryBuffer.successes`
    :param fraction: share of the episodes that is kept, randomly drawn, in (0, 1]
    :param fraction_seed: seed of that draw alone, so that different runs learn from the same episodes
    :param allow_pickle: whether to read pickles, which can run code: files of SB3's replay buffers (`.pkl`), and arrays of
        objects in `.npz`; not accepted from `dataset_kwargs`, which files of others may hold
    :param kwargs: options of the reader: `on_invalid`, which is "raise" unless "drop" leaves episodes out that would be
        refused, with a warning that names their number and the first reason; `observation_keys` and `clip_actions`;
        `filter_key` for robomimic files and `episodes` for LeRobot datasets, see also :func:`load_flat`
    :raises DatasetError: `dataset` is nothing of the above, its reader refuses it, or its cache cannot be used
    :raises TypeError: the reader has no such option, or renames nothing
    """
    named = {"cache_dir": cache_dir, "env_id": env_id, "max_episode_steps": max_episode_steps, "min_return": min_return}
    named |= {"best_share": best_share, "success_only": success_only, "fraction": fraction, "fraction_seed": fraction_seed}
    check_options({**kwargs, **named, "allow_pickle": allow_pickle})
    dataset = unpickled(dataset, allow_pickle)
    reader = _find_reader(dataset)
    parameters = inspect.signature(reader.load).parameters
    own = [name for name in parameters if name not in ("storage", *COMMON_OPTIONS)][1:]
    given = kwargs if cache_dir is None else {**kwargs, "cache_dir": cache_dir}
    accepted = [*own, *(["cache_dir"] if reader.fingerprint else []), *COMMON_OPTIONS]
    unknown = sorted(set(given) - set(accepted))
    if unknown:
        is_path = isinstance(dataset, str | os.PathLike) and reader.load is not load_minari
        if is_path and not Path(dataset).expanduser().exists():
            raise DatasetError(f"{Path(dataset).expanduser().absolute()} does not exist; {reader.kind} is expected.")
        name = reader.kind if is_mapping(dataset) or is_episodes(dataset) or is_table(dataset) else str(dataset)
        of_one = f" Those of a single one: {{'dataset': ..., {unknown[0]!r}: ...}}." if is_several(dataset) else ""
        raise TypeError(
            f"dataset {name}: unknown option {with_nearest(unknown, accepted)}; accepted: {', '.join(accepted)}.{of_one}"
        )
    if isinstance(kwargs.get("observation_keys"), Mapping) and reader.load not in RENAMING:
        raise TypeError(
            "observation_keys: a mapping renames entries of LeRobot, robomimic and zarr datasets; give a list of names, and "
            "rename the entries of other data themselves."
        )
    common: dict[str, Any] = {"action_space": action_space, "observation_space": observation_space, "env_id": env_id}
    common.update(env_args=env_args, max_episode_steps=max_episode_steps, allow_pickle=allow_pickle)
    kwargs.update((name, value) for name, value in common.items() if name in parameters)
    if cache_dir is None or reader.fingerprint is None:
        buffer = reader.load(dataset, **kwargs)
    else:
        fingerprint = reader.fingerprint(dataset, kwargs)
        buffer = load_cached(
            Path(cache_dir).expanduser(), fingerprint, lambda storage: reader.load(dataset, storage=storage, **kwargs)
        )
    check_order(kwargs.get("observation_keys"), buffer.image_spaces, observation_space, buffer.source)
    if env_id is not None:
        buffer = copy.copy(buffer)
        buffer.env_id, buffer.controller = env_id, None
    if max_episode_steps is not None:
        buffer = buffer.within(max_episode_steps)
    return buffer.best(min_return, best_share, success_only).random_fraction(fraction, fraction_seed)


def load_dataset_for(env: gym.Env, dataset: Dataset, **options: Any) -> TrajectoryBuffer:
    """
    Read all episodes of a dataset as `train` reads them for an environment: up to its time limit.

    :param env: environment in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
    :param dataset: see :func:`load_dataset`
    :param options: further arguments of that function
    :raises DatasetError: it cannot be read, or was recorded on another task; versions may differ
    """
    known = {"action_space": env.action_space, **env.get_wrapper_attr("reader_options")}
    buffer = load_dataset(dataset, **{**known, **options})
    if (task := env.get_wrapper_attr("known_task")) is not None:
        buffer.check_task(task.env_id)
    return buffer


def check_options(given: dict[str, Any]) -> None:
    """
    Check options of :func:`load_dataset` before anything is read.

    :param given: values by name
    :raises ValueError: names the option, what was given and what is accepted
    """
    check_arguments(given, {name: rule for name, rule in ACCEPTED.items() if name in given})
    for name in ("cache_dir", "env_id"):
        value = given.get(name)
        kinds = str if name == "env_id" else (str, os.PathLike)
        if value is not None and not (isinstance(value, kinds) and str(value)):
            expected = "the path of a folder" if name == "cache_dir" else "the id of an environment"
            raise ValueError(f"{name} must be {expected}, or None, got {value!r}.")
    for name in ("observation_keys", "action_keys"):
        value = given.get(name)
        listed: Any = list(value.values()) if isinstance(value, Mapping) else value
        names = isinstance(listed, Sequence) and not isinstance(listed, str) and all(isinstance(x, str) for x in listed)
        if value is not None and not (names and value):
            raise ValueError(f"{name} must be a list of names, or None, got {value!r}.")


def _find_reader(dataset: Any) -> Reader:
    for reader in READERS:
        if reader.accepts(dataset):
            return reader
    found = repr(str(dataset)) if isinstance(dataset, str | os.PathLike) else f"a {type(dataset).__name__}"
    kinds = ", ".join(reader.kind for reader in READERS)
    raise DatasetError(f"dataset is {found}; accepted are {kinds}.")
