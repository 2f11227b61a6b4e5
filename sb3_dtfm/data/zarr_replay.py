"""Reading the zarr replay buffers of Diffusion Policy (Chi et al., 2023) into a `TrajectoryBuffer`."""

import contextlib
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file, files_below
from sb3_dtfm.data.ends import DONES, EPISODES, TERMINATIONS, TRUNCATIONS, told_flags
from sb3_dtfm.data.flat import (
    ACTIONS,
    NOT_NEEDED,
    OBSERVATIONS,
    REWARDS,
    SUCCESSES,
    bounded_space,
    explain_range,
    fitted,
    json_options,
    warn_of_made_up_rewards,
)
from sb3_dtfm.data.observations import observed
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory, check_flags, check_size, wrap_dataset_errors
from sb3_dtfm.files import warn

SUFFIXES = (".zarr", ".zarr.zip")
EXPECTED = "the path of a zarr replay buffer (.zarr, .zarr.zip)"
ENDS = "meta/episode_ends"
# Arrays that are not observed unless they are asked for.
NOT_OBSERVED = {*ACTIONS, *REWARDS, *TERMINATIONS, *TRUNCATIONS, *DONES, *EPISODES, *SUCCESSES, *NOT_NEEDED}
# Files that say how arrays are stored, and codecs that only compress: others, such as numcodecs' pickle, can run code.
METADATA = (".zarray", ".zmetadata", "zarr.json")
CODECS = {"blosc", "bytes", "bz2", "crc32c", "delta", "endian", "gzip", "lz4", "shuffle", "transpose", "zlib", "zstd"}
NUMBERS = re.compile(r"[<>|]?(b|i|u|f|bool|int|uint|float)\d*")
MOST_COUNTED = 10_000  # chunks of an array, which take seconds to count
# A part of an array's columns: "state[:2]".
COLUMNS = re.compile(r"(.+)\[(\d*):(\d*)\]")


def is_zarr(dataset: Any) -> bool:
    """Return whether this is such a path, by its name."""
    return isinstance(dataset, str | os.PathLike) and os.fspath(dataset).rstrip("/").endswith(SUFFIXES)


def fingerprint_zarr(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Take the fingerprint of the folder or zip as it is now.

    :param path: the folder or zip
    :param options: options of :func:`load_zarr`
    :raises DatasetError: there is none
    """
    path = _existing(path)
    return Fingerprint.of(path.name, path, json_options(options))


def _existing(path: str | os.PathLike[str]) -> Path:
    folder = Path(path).expanduser()
    return folder if folder.is_dir() else existing_file(path, EXPECTED)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open the group at the top of a folder or zip while it is read."""
    try:
        import zarr
    except ImportError as error:
        raise ImportError(f'{path} needs zarr: pip install "sb3-dtfm[zarr]"') from error
    if path.is_dir():
        files = files_below(path)  # no link leads out of it
        _check_metadata({str(file): file.read_text for file in files if file.name in METADATA})
        yield zarr.open_group(path, mode="r")
        return
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        named = {name: partial(archive.read, name) for name in names if name.rpartition("/")[2] in METADATA}
        for name in named:
            check_size(archive.getinfo(name).file_size, 0, f"{path}, {name}")
        _check_metadata({f"{path}, {name}": read for name, read in named.items()})
    folders = {name.partition("/")[0] for name in names} - {"__MACOSX"}
    with zarr.storage.ZipStore(path, mode="r") as store:
        # All that is in a zip of a folder's parent is that folder.
        yield zarr.open_group(store, mode="r", path="".join(folders) if len(folders) == 1 else None)


def _check_metadata(read: Mapping[str, Callable[[], str | bytes]]) -> None:
    """
    Refuse arrays that are no numbers, and ways to store them that could run code, before any is opened.

    :param read: functions that return the JSON of each file, by the file's name for messages
    :raises DatasetError: names the file and what it asks for
    """
    for where, content in read.items():
        with wrap_dataset_errors(where):
            found = json.loads(content())
        for name, value in _entries(found):
            codec = name in ("compressor", "compressors", "filters", "codecs", "serializer")
            for each in (value if isinstance(value, list) else [value]) if codec and value is not None else ():
                asked = each.get("id", each.get("name")) if isinstance(each, dict) else each
                if not isinstance(asked, str) or asked not in CODECS:
                    raise DatasetError(f"{where}: codec {asked!r}, expected one of {', '.join(sorted(CODECS))}.")
            if name in ("dtype", "data_type") and not (isinstance(value, str) and NUMBERS.fullmatch(value)):
                raise DatasetError(f"{where}: an array of {value!r}, expected numbers.")


def _entries(found: Any) -> Iterator[tuple[str, Any]]:
    """All names in JSON with their values, at any depth: an array may have the name of a part of its metadata."""
    for each in found if isinstance(found, list) else ():
        yield from _entries(each)
    for name, value in found.items() if isinstance(found, dict) else ():
        yield name, value
        yield from _entries(value)


def load_zarr(
    path: str | os.PathLike[str],
    observation_keys: Sequence[str] | Mapping[str, str] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    observation_space: spaces.Space | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    Read a folder, or a zip, of `data/action` (N, A), of images (N, height, width, channels) and vectors (N, .) in `data`,
    and of `meta/episode_ends` (E,). Images of floats with whole numbers from 0 to 255 become bytes. Episodes are read one by
    one.

    Rewards are `data/rewards` or `data/reward`, (N,) or (N, 1), and episodes end as `data/terminals` and `data/timeouts`
    say, if there are any. Without rewards an episode counts as a success, with a reward of 1 at its last step.

    :param path: path of the folder or zip
    :param observation_keys: names of the arrays of `data` that make up the observation, or of some columns of one, as
        `state[:2]`; or a mapping from the environment's names to them, `{"pixels": "img", "agent_pos": "state[:2]"}`. By
        default all images, and `state` or `obs`, or else everything that has N steps and is no action, reward or end
    :param action_bounds: see :func:`~sb3_dtfm.data.load_flat`
    :param clip_actions: see :func:`~sb3_dtfm.data.load_flat`
    :param action_space: see :func:`~sb3_dtfm.data.load_flat`
    :param observation_space: the environment's observation space
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :raises ImportError: `sb3-dtfm[zarr]` is not installed
    :raises DatasetError: none such, damaged, arrays missing or of lengths that do not fit together, NaN or infinity, or
        actions out of bounds; names array, episode and step
    """
    path = _existing(path)
    source = str(path)
    with wrap_dataset_errors(source), _opened(path) as group:
        data = dict(group["data"].arrays())
        n_stored = path.stat().st_size if path.is_file() else sum(file.stat().st_size for file in files_below(path))
        if not hasattr(group.get(ENDS), "shape"):
            raise DatasetError(f"{source}: has no {ENDS}, which says where episodes end.")
        for name, array in {**data, ENDS: group[ENDS]}.items():
            check_size(math.prod(array.shape) * array.dtype.itemsize, n_stored, f"{source}: {name}")
        with wrap_dataset_errors(f"{source}: {ENDS}"):
            stored_ends = np.asarray(group[ENDS][:])
        with np.errstate(invalid="ignore"):
            ends = stored_ends.astype(np.int64)
        name = _first(data, ACTIONS)
        if name is None:
            raise DatasetError(f"{source}: data has no array {' or '.join(ACTIONS)}, only {', '.join(sorted(data))}.")
        n_steps = next(iter(data[name].shape), 0)
        ascending = ends.ndim == 1 and len(ends) and (ends == stored_ends).all() and (np.diff(ends, prepend=0) > 0).all()
        if not ascending or ends[-1] != n_steps:
            raise DatasetError(
                f"{source}: {ENDS} is {stored_ends}, expected ascending whole numbers of steps, the last one {n_steps}."
            )
        chosen = _chosen(data, observation_keys, n_steps, observation_space, source)
        observed_arrays = sorted({array for array, _ in chosen.values()})
        _check_lengths(data, observed_arrays, n_steps, source)
        _warn_of_missing_chunks(data, [name, *observed_arrays], source)
        rewards = _first(data, REWARDS)
        if rewards is None:
            warn_of_made_up_rewards(set(data) - set(observed_arrays), source)
        elif data[rewards].shape not in ((n_steps,), (n_steps, 1)):
            raise DatasetError(f"{source}: {rewards} has shape {data[rewards].shape}, expected ({n_steps},).")
        # One number a step is a choice only where it can be.
        numbers = isinstance(action_space, spaces.Box) or data[name].dtype.kind == "f"
        alone = len(data[name].shape) == 1 and numbers and not isinstance(action_space, spaces.Discrete)

        def actions_of(steps: slice, where: str) -> np.ndarray:
            actions = _steps(data, name, steps, where)
            return actions[:, None] if alone else actions

        space = bounded_space(action_bounds, action_space, actions_of(slice(0, 1), source), source)

        def trajectory(number: int) -> Trajectory:
            steps, episode = slice(int(ends[number - 1]) if number else 0, int(ends[number])), f"episode {number}"
            where = f"{source}, {episode}"
            entries = {each: _read(data, array, steps, columns, where) for each, (array, columns) in chosen.items()}
            seen = observed(entries, list(entries), observation_space, where)
            length = steps.stop - steps.start
            actions = fitted(actions_of(steps, where), space, clip_actions)
            success = _success(data, steps, where)
            if rewards is None:
                done = success is not False
                marks = done * np.eye(1, length, length - 1)[0]
                return Trajectory(
                    seen.vectors, actions, marks, terminated=done, success=success, name=episode, images=seen.images
                )
            terminal, timeout, done = (_ended(data, names, steps, where) for names in (TERMINATIONS, TRUNCATIONS, DONES))
            return Trajectory(
                seen.vectors,
                actions,
                _steps(data, rewards, steps, where).reshape(-1),
                terminated=terminal or (done and not timeout),
                truncated=timeout,
                success=success,
                name=episode,
                images=seen.images,
            )

        with explain_range(space, action_bounds, action_space):
            return TrajectoryBuffer.from_trajectories(
                map(trajectory, range(len(ends))), space, n_steps=n_steps, source=source, storage=storage,
                on_invalid=on_invalid,
            )  # fmt: skip


def _first(data: Mapping[str, Any], names: Sequence[str]) -> str | None:
    return next((name for name in names if name in data), None)


def _steps(data: Mapping[str, Any], name: str, steps: slice, where: str) -> np.ndarray:
    """Some steps of an array."""
    with wrap_dataset_errors(f"{where}: {name}"):
        return np.asarray(data[name][steps])


def _check_lengths(data: Mapping[str, Any], observed_arrays: Sequence[str], n_steps: int, source: str) -> None:
    """Refuse observations and flags of another number of steps."""
    flags = (_first(data, names) for names in (TERMINATIONS, TRUNCATIONS, DONES, SUCCESSES))
    for name in (*observed_arrays, *filter(None, flags)):
        if data[name].shape[:1] != (n_steps,):
            raise DatasetError(f"{source}: {name} has shape {data[name].shape}, expected {n_steps} steps.")


def _warn_of_missing_chunks(data: Mapping[str, Any], names: Sequence[str], source: str) -> None:
    """Zarr leaves out a chunk that holds its fill value alone, so that no reader can tell it from one that is lost."""
    for name in names:
        with wrap_dataset_errors(f"{source}: {name}"):
            n_chunks = data[name].nchunks
            n_stored = data[name].nchunks_initialized if n_chunks <= MOST_COUNTED else n_chunks
        if n_stored < n_chunks:
            missing = f"{n_chunks - n_stored} of {n_chunks} chunks are not stored, and count as {data[name].fill_value}"
            warn(f"{source}: {name}: {missing}. If other numbers were there, the dataset is incomplete.", stacklevel=3)


def _ended(data: Mapping[str, Any], names: Sequence[str], steps: slice, where: str) -> bool:
    """Whether the first of these arrays marks the last step of an episode."""
    name = _first(data, names)
    if name is None:
        return False
    return bool(check_flags(_steps(data, name, steps, where), steps.stop - steps.start, f"{where}: {name}")[-1])


def _success(data: Mapping[str, Any], steps: slice, where: str) -> bool | None:
    """Whether an episode has succeeded, by its last step; None if nothing tells."""
    name = _first(data, SUCCESSES)
    if name is None:
        return None
    told, silent = told_flags(_steps(data, name, steps, where), steps.stop - steps.start, f"{where}: {name}")
    return None if silent[-1] else bool(told[-1])


def _chosen(
    data: Mapping[str, Any],
    keys: Sequence[str] | Mapping[str, str] | None,
    n_steps: int,
    space: spaces.Space | None,
    source: str,
) -> dict[str, tuple[str, slice]]:
    """The array and its columns of each entry of the observation; beside images only vectors that it shows, too."""
    if keys is None:
        images = [name for name, array in data.items() if len(array.shape) == 4]
        vector = _first(data, OBSERVATIONS)
        others = {name for name, array in data.items() if array.shape[:1] == (n_steps,)} - NOT_OBSERVED - set(images)
        shown = others & set(getattr(space, "spaces", ())) if images and space is not None else others
        keys = [*images, *(sorted(shown) if vector is None else [vector])]
        if not keys:
            raise DatasetError(f"{source}: data has nothing to observe, only {', '.join(sorted(data))}.")
        if images and vector is None and others:
            unread = ", ".join(sorted(others - shown)) or "none"
            warn(
                f"{source}: observed: {', '.join(keys)}; not observed: {unread}. observation_keys=[...] chooses.",
                stacklevel=3,
            )
    found = {}
    # The environment shows its entries in the order of their names.
    for name, wanted in sorted(keys.items()) if isinstance(keys, Mapping) else ((key, key) for key in keys):
        parts = COLUMNS.fullmatch(wanted)
        array = parts[1] if parts else wanted
        if array not in data:
            raise DatasetError(f"{source}: data has no array {array!r}, only {', '.join(sorted(data))}.")
        columns = slice(*(int(number) if number else None for number in parts.groups()[1:])) if parts else slice(None)
        found[name] = (array, columns)
    return found


def _read(data: Mapping[str, Any], name: str, steps: slice, columns: slice, where: str) -> np.ndarray:
    """An episode of an array; images as bytes."""
    values = _steps(data, name, steps, where)
    if values.ndim != 4 or values.dtype == np.uint8:
        return values if columns == slice(None) else values.reshape(len(values), -1)[:, columns]
    with np.errstate(invalid="ignore"):
        images = values.astype(np.uint8)
    if not (images == values).all():
        raise DatasetError(
            f"{where}: {name}: images of {values.dtype} hold others than whole numbers from 0 to 255; scale them and store "
            "uint8, or leave them out with observation_keys=[...]."
        )
    return images
