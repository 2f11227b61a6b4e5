"""Reading flat arrays, episode after episode, into a `TrajectoryBuffer`: of an `.npz` file, an hdf5 file, or memory."""

import contextlib
import itertools
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace, bounds_of, choices_between
from sb3_dtfm.data.arrays import CSV_SUFFIX, ENV_ID, EXPECTED, NPZ_SUFFIX, PARQUET_SUFFIX, Arrays, opened
from sb3_dtfm.data.buffer import IMAGE as STORED_IMAGE
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file
from sb3_dtfm.data.ends import DONES, ENDS, EPISODES, LENGTHS, TERMINATIONS, TRUNCATIONS, Ends, read_ends, told_flags
from sb3_dtfm.data.observations import Observed, is_images, observed, part_of
from sb3_dtfm.data.short_episodes import ShortEpisodes, blocks
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import ActionRangeError, DatasetError, Trajectory
from sb3_dtfm.envs.observation_spaces import CHANNELS, IMAGE
from sb3_dtfm.envs.success import SUCCESS
from sb3_dtfm.files import warn

# Names of each array in other libraries' files: the first that is there is read.
OBSERVATIONS = ("observations", "observation", "obs", "states", "state")
ACTIONS = ("actions", "action", "acts")
REWARDS = ("rewards", "reward", "rews")
SUCCESSES = ("successes", *SUCCESS, *(f"infos/{name}" for name in SUCCESS))
ENDS_OF_EPISODES = {*TERMINATIONS, *TRUNCATIONS, *DONES, *EPISODES, ENDS, LENGTHS}
# Arrays that TrajectoryBuffer.save adds, beside ENV_ID.
LOW, HIGH = "action_low", "action_high"
# Arrays that files often hold, and that add no information.
NOT_NEEDED = ("next_observations", "next_obs", "info", "infos", "metadata")


def warn_of_made_up_rewards(
    names: Iterable[str], source: str, missing: str = f"there is none of {', '.join(REWARDS)}"
) -> None:
    """
    Say what counts where there are no rewards, and which arrays may have been meant as rewards, or as ends.

    :param names: names of all arrays
    :param source: name of the data, for the message
    :param missing: clause that says what is missing, for the message
    """
    names = set(names)
    if names & set(REWARDS):
        return
    read = {*OBSERVATIONS, *ACTIONS, *ENDS_OF_EPISODES, *SUCCESSES, LOW, HIGH, ENV_ID, *NOT_NEEDED}
    unread = sorted(name for name in names - read if not name.startswith(("infos/", STORED_IMAGE)))
    told = names & set(SUCCESSES)
    if told and not unread:
        return
    counts = (
        "so that a success is rewarded" if told else "nor any success, so that every episode counts as a success, rewarded"
    )
    not_read = f" Not read: {', '.join(unread)}." if unread else ""
    warn(f"{source}: {missing}, {counts} by 1 at its last step.{not_read}", stacklevel=2)


def is_flat_file(dataset: Any) -> bool:
    """Return whether this is the path of such a file, by its name, or by actions at the top of an hdf5 file."""
    if not isinstance(dataset, str | os.PathLike):
        return False
    if os.fspath(dataset).endswith((NPZ_SUFFIX, CSV_SUFFIX, PARQUET_SUFFIX)):
        return True
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        path = os.path.expanduser(dataset)
        if os.path.isfile(path) and h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return not set(file).isdisjoint(ACTIONS)
    return False


def is_mapping(dataset: Any) -> bool:
    """Return whether these are arrays by their names."""
    return isinstance(dataset, Mapping)


def holds_episodes(arrays: Mapping[str, Any]) -> bool:
    """Return whether arrays tell of several episodes, by their ends, lengths or numbers."""
    numbers = (np.ravel(arrays[name]) for name in EPISODES if name in arrays)
    counted = any(np.size(arrays[name]) > 1 for name in (ENDS, LENGTHS) if name in arrays)
    return counted or any((array != array[:1]).any() for array in numbers)


def fingerprint_flat_file(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Take the fingerprint of a file as it is now.

    :param path: the file
    :param options: options of :func:`load_flat`
    :raises DatasetError: no such file
    """
    path = existing_file(path, EXPECTED)
    return Fingerprint.of(path.name, path, json_options(options))


def json_options(options: dict[str, Any]) -> dict[str, Any]:
    """
    Options of a reader as JSON can hold them: arrays become lists.

    :param options: options by name, such as `action_bounds` or `action_space`
    """
    options = dict(options)
    space, observed = options.pop("action_space", None), options.pop("observation_space", None)
    if observed is not None and not isinstance(observed, spaces.Box):
        options["observation_space"] = repr(observed)
    if space is not None:  # which counts less than a file's own bounds, and these less than those that are given
        options["environment_bounds"] = bounds_of(space)
    for name in ("action_bounds", "environment_bounds"):
        if options.get(name) is not None:
            options[name] = [np.asarray(bound).tolist() for bound in options[name]]
    return options


def load_flat(
    dataset: Any,
    observation_keys: Sequence[str] | None = None,
    action_keys: Sequence[str] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    observation_space: spaces.Space | None = None,
    max_episode_steps: int | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    Episodes one after the other in flat arrays of N steps: as `numpy.savez` writes them, in D4RL's hdf5 files, or in memory.

    The arrays are `observations` (N, O), `actions` (N, A), or whole numbers (N,) of a Discrete space, and `rewards` (N,), or
    have the names of others (`obs`, `state`, `action`, `reward`). Episodes end where `episode_ends` says (E,), counting
    steps from the start of the file, or after `episode_lengths` (E,) each, or where `episode` (N,) changes, or at the steps
    of `terminals`, `timeouts` or `dones` (N,). If only `terminals` tell of ends, episodes are cut after every
    `max_episode_steps`. `success` tells of each episode (E,), NaN where it is unknown, or of each step (N,), and then an
    episode's last one counts. Without rewards a success has a reward of 1 at its last step, and an episode whose success is
    unknown counts as one.

    A table has a row for each step and a column for each number; columns that begin with `obs`, such as `obs_0`, make up the
    observation. Nothing in a file is ever executed: arrays of Python objects are refused. The arrays are read into memory,
    also to write a cache of them.

    :param dataset: path of the file, arrays by name, or a DataFrame
    :param observation_keys: names of the arrays that make up the observation, in this order, each (N, ...), or of entries
        of dictionary observations. By default the entries of the environment's Dict, if each has an array of its name and
        size
    :param action_keys: names of the arrays that make up the action, in this order, each (N, ...)
    :param action_bounds: smallest and largest action that the environment accepts, numbers or (A,) each; where they are not
        given, a file's own `action_low` and `action_high`, or those of `action_space`, or -1 and 1. For Discrete actions
        the first and the last one
    :param clip_actions: bring actions outside of them to the nearest bound, however far, instead of refusing them
    :param action_space: the environment's action space
    :param observation_space: the environment's observation space, which tells what is a choice, see
        :func:`~sb3_dtfm.data.load_dataset`
    :param max_episode_steps: time limit of the environment, steps
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :raises DatasetError: no such file, damaged, arrays missing or of lengths that do not fit together, NaN or infinity, or
        actions out of bounds; names the file, the array, the episode and the step
    """
    with opened(dataset) as arrays:
        action_keys = list(action_keys or arrays.columns(ACTIONS))
        actions = _actions(arrays, action_keys, action_space)
        images = [name for name in arrays.names if str(name).startswith(STORED_IMAGE)]
        alone = images and not arrays.has(OBSERVATIONS)
        entries = [] if observation_keys else _entries(arrays, observation_space, action_keys)
        keys = list(observation_keys or entries or ([] if alone else arrays.columns(OBSERVATIONS)))
        if observation_keys is None and not entries:
            keys += images
            _warn_of_images(arrays, {*keys, *action_keys, *NOT_NEEDED}, len(actions))
        observations = _observations(arrays, keys, len(actions), observation_space)
        ends = read_ends(arrays, len(actions), max_episode_steps)
        warn_of_made_up_rewards(set(map(str, arrays.names)) - {*keys, *action_keys}, arrays.source)
        return _read(arrays, observations, actions, ends, action_bounds, clip_actions, action_space, on_invalid, storage)


def _entries(arrays: Arrays, space: spaces.Space | None, others: Collection[str]) -> list[str]:
    """Arrays of an environment's entries, sorted by the entry, if each has one of its name and its size."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    if arrays.are_columns:
        own = {*OBSERVATIONS, *itertools.chain(*map(arrays.beginning, OBSERVATIONS))} & set(arrays.names)
        if own - set(parts):  # a table's own observation
            return []
    others = {*others, *ACTIONS, *REWARDS, *SUCCESSES, *ENDS_OF_EPISODES}
    keys = []
    for entry, part in sorted(parts.items()):
        name = entry if entry in arrays.names else f"{STORED_IMAGE}{entry}"
        shape, _ = (arrays.describe(name) if name in arrays.names else None) or (None, None)
        sizes = () if part.shape is None else (math.prod(part.shape), spaces.flatdim(part))
        if shape is None or entry in others or math.prod(shape[1:]) not in sizes:
            return []
        keys.append(name)
    return keys


def _warn_of_images(arrays: Arrays, others: Collection[str], n_steps: int) -> None:
    """Say which arrays are not read though they hold an image for each step."""
    for name in sorted(set(arrays.names) - set(others), key=str):
        shape, dtype = arrays.describe(name) or ((), None)
        if dtype == np.uint8 and len(shape) == 4 and shape[0] == n_steps and {shape[1], shape[3]} & set(CHANNELS):
            warn(
                f"{arrays.source}: {name} has an image of shape {shape[1:]} for each step, and is not read. Call it "
                f"{STORED_IMAGE}{name}, or name it in observation_keys=[...].",
                stacklevel=4,
            )


def _read(
    arrays: Arrays,
    observation: Observed,
    actions: np.ndarray,
    ends: Ends,
    action_bounds: Sequence[Any] | None,
    clip_actions: bool,
    action_space: ActionSpace | None,
    on_invalid: str,
    storage: FileStorage | None,
) -> TrajectoryBuffer:
    source, n_steps = arrays.source, len(actions)
    stops, terminated, truncated = ends
    has_rewards = arrays.has(REWARDS)
    rewards = arrays.read(REWARDS, n_steps).reshape(n_steps, -1) if has_rewards else np.zeros((n_steps, 1))
    if rewards.shape[1] != 1:
        raise DatasetError(f"{source}: rewards have {rewards.shape[1]} columns; one number a step is expected.")
    successes = _successes(arrays, n_steps, stops)
    if not has_rewards:
        done = stops[successes != 0.0] - 1
        rewards[done] = 1.0
        terminated[done], truncated[done] = True, False
    if action_bounds is None and arrays.has((LOW,)):
        action_bounds = arrays.read((LOW,)), arrays.read((HIGH,))
    space = bounded_space(action_bounds, action_space, actions, source)
    actions = fitted(actions, space, clip_actions)

    def steps(first: int, end: int) -> Trajectory:
        """Return the steps of some episodes, one after the other."""
        start, stop = stops[first - 1] if first else 0, stops[end - 1]
        return Trajectory(
            observations=observation.vectors[start:stop],
            actions=actions[start:stop],
            rewards=rewards[start:stop, 0],
            terminated=bool(terminated[stop - 1]),
            truncated=bool(truncated[stop - 1]),
            success=None if np.isnan(successes[first]) else bool(successes[first]),
            name=f"episode {first}",
            images={camera: images[start:stop] for camera, images in observation.images.items()},
        )

    def episodes(first: int, end: int) -> Trajectory | ShortEpisodes:
        if end - first == 1:
            return steps(first, end)
        here, last = slice(first, end), stops[first:end] - 1
        lengths = np.diff(stops[here], prepend=stops[first - 1] if first else 0)
        one_by_one = partial(map, steps, range(first, end), range(first + 1, end + 1))
        return ShortEpisodes(steps(first, end), lengths, terminated[last], truncated[last], successes[here], one_by_one)

    with explain_range(space, action_bounds, action_space):
        return TrajectoryBuffer.from_trajectories(
            itertools.starmap(episodes, blocks(stops)),
            space,
            n_steps=n_steps,
            source=source,
            env_id=arrays.env_id(),
            storage=storage,
            on_invalid=on_invalid,
            n_stored=arrays.n_stored,
        )


def _actions(arrays: Arrays, keys: Sequence[str], space: ActionSpace | None) -> np.ndarray:
    """(N, A), or (N,) of Discrete ones."""
    actions = arrays.read(keys[:1])
    numbers = isinstance(space, spaces.Box) or (arrays.are_columns and actions.dtype.kind == "f")
    if actions.ndim == 1 and (numbers or keys[0] not in ACTIONS):
        actions = actions[:, None]
    if actions.ndim > 2 and arrays.are_columns:  # lists of lists
        actions = actions.reshape(len(actions), -1)
    if len(keys) > 1 and len(actions):
        n_steps = len(actions)
        actions = np.concatenate([arrays.read((key,), n_steps).reshape(n_steps, -1) for key in keys], axis=1)
    check_shape(actions, space, arrays.source)
    return actions


def _observations(arrays: Arrays, keys: Sequence[str], n_steps: int, space: spaces.Space | None) -> Observed:
    """Read observations from arrays, or from entries of dictionary observations."""
    if arrays.has(OBSERVATIONS) and not all(key in arrays.names for key in keys):
        name = arrays.name(OBSERVATIONS)
        parts = {name: observed(arrays.stored(name), keys, space, f"{arrays.source}: {name}")}
    else:
        own_parts = {key: part_of(space, key) for key in keys}
        known = {key: space if part is None and key in OBSERVATIONS else part for key, part in own_parts.items()}
        stored = {key: arrays.stored(arrays.name((key,))) for key in keys}
        parts = {key: observed(stored[key], None, known[key], f"{arrays.source}: {key}") for key in keys}
    images: dict[str, np.ndarray] = {}
    for name, part in parts.items():
        own = name if name not in OBSERVATIONS or part_of(space, name) is not None else IMAGE
        images |= {
            own.removeprefix(STORED_IMAGE) if camera == IMAGE else camera: each for camera, each in part.images.items()
        }
        for array in part:
            found = next(iter(array.values()), part.vectors) if isinstance(array, dict) else array
            if len(found) != n_steps:
                raise DatasetError(f"{arrays.source}: {name} has shape {found.shape} and actions have {n_steps} steps.")
    vectors = [part.vectors for name, part in parts.items() if not is_images(arrays.stored(name))]
    return Observed(np.concatenate(vectors or [np.zeros((n_steps, 1), np.float32)], axis=1), images)


def _successes(arrays: Arrays, n_steps: int, stops: np.ndarray) -> np.ndarray:
    """(E,): 1, 0, or NaN for an episode of unknown success."""
    if not arrays.has(SUCCESSES):
        return np.full(len(stops), np.nan)
    array, where = np.atleast_1d(arrays.read(SUCCESSES)), f"{arrays.source}: {arrays.name(SUCCESSES)}"
    of_steps = len(array) != len(stops)
    told, silent = told_flags(array, n_steps if of_steps else len(stops), where)
    successes = np.where(silent, np.nan, told)
    return successes[stops - 1] if of_steps else successes


def check_shape(actions: np.ndarray, space: ActionSpace | None, where: str) -> None:
    """
    Refuse what are no actions.

    :param actions: (N, A), or (N,) of Discrete ones
    :param space: the environment's action space
    :param where: origin of the actions, for messages
    :raises DatasetError: another shape, or no step
    """
    choices = actions.ndim == 1 and (isinstance(space, spaces.Discrete) or actions.dtype.kind in "iub")
    if not (actions.ndim == 2 or choices) or not len(actions):
        raise DatasetError(
            f"{where}: actions have shape {actions.shape}; (N, A) is expected, or whole numbers (N,) for a Discrete action "
            "space, for at least one step."
        )


def bounded_space(bounds: Sequence[Any] | None, space: ActionSpace | None, actions: np.ndarray, source: str) -> ActionSpace:
    """
    The action space of data that hold numbers alone.

    :param bounds: smallest and largest action, numbers or (A,) each
    :param space: the environment's action space, where `bounds` are not given
    :param actions: actions that :func:`check_shape` accepts
    :param source: origin of the actions, for messages
    :return: the action space; a Box from -1 to 1 where neither is given
    :raises DatasetError: `bounds` are something else, or the number of Discrete actions is unknown
    """
    if bounds is None and space is not None and (isinstance(space, spaces.Discrete) or space.shape == actions.shape[1:]):
        return space
    n_actions = actions.shape[1:]
    if not n_actions and bounds is None:
        raise DatasetError(
            f"{source}: actions are whole numbers, one a step; expected their number, too: give an environment with a "
            "Discrete action space, or action_bounds=(first, last)."
        )
    try:
        if not n_actions:
            first, last = bounds or ()
            return choices_between(first, last)
        low, high = (np.broadcast_to(np.asarray(bound, np.float32), n_actions) for bound in bounds or (-1.0, 1.0))
        return spaces.Box(low, high, dtype=np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        expected = f"numbers or {n_actions[0]} each" if n_actions else "whole numbers"
        raise DatasetError(
            f"{source}: action_bounds is {bounds!r}; smallest and largest action are expected, {expected}."
        ) from error


@contextlib.contextmanager
def explain_range(space: ActionSpace, bounds: Sequence[Any] | None, environment: ActionSpace | None) -> Iterator[None]:
    """
    Explain the default range of actions, and how to give another.

    :param space: action space that is learned
    :param bounds: bounds that the user gave, or None
    :param environment: the environment's action space, or None
    :raises DatasetError: an action lies outside of the space
    """
    try:
        yield
    except ActionRangeError as error:
        if bounds is not None or space is environment:
            raise
        raise ActionRangeError(
            f"{error} This range is the default. Give an environment (inspect: --env ID), or "
            "action_bounds=(smallest, largest), or clip_actions=True."
        ) from error


def fitted(actions: np.ndarray, space: ActionSpace, clip: bool) -> np.ndarray:
    """
    Actions in the shape of their space, where they can be.

    :param actions: (T, A), (T,), or (T, 1) of Discrete ones
    :param space: action space that is learned
    :param clip: whether to clip them to its bounds; numbers that are not finite stay, to be refused
    """
    if isinstance(space, spaces.Discrete) and actions.shape[1:] == (1,):
        actions = actions[:, 0]
    if not clip or actions.shape[1:] != space.shape:
        return actions
    return np.where(np.isfinite(actions), np.clip(actions, *bounds_of(space)), actions)
