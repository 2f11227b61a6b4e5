"""Reading LeRobot datasets, folders of parquet files, into a `TrajectoryBuffer`."""

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.arguments import COUNT
from sb3_dtfm.data.arrow import as_numbers, import_pyarrow
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, files_below
from sb3_dtfm.data.flat import bounded_space, fitted, json_options, warn_of_made_up_rewards
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory, check_flags, check_size, wrap_dataset_errors

INFO, DATA = "meta/info.json", "data"
ACTION, REWARD, SUCCESS, DONE = "action", "next.reward", "next.success", "next.done"
EPISODE, FRAME = "episode_index", "frame_index"
OBSERVATION = "observation."
# What numbers of a robot are stored as; images, videos and words are others.
NUMBERS = ("float32", "float64", "float16", "int64", "int32", "bool")


def is_lerobot(dataset: Any) -> bool:
    """Whether this is the path of such a folder."""
    return isinstance(dataset, str | os.PathLike) and (Path(dataset).expanduser() / INFO).is_file()


def fingerprint_lerobot(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Of a folder as it is now.

    :param path: the folder
    :param options: of :func:`load_lerobot`
    """
    path = Path(path).expanduser()
    return Fingerprint.of(path.name, path, json_options(options))


def load_lerobot(
    path: str | os.PathLike[str],
    observation_keys: Sequence[str] | None = None,
    episodes: Sequence[int] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    The episodes of a LeRobot dataset, of its formats 2.0 to 3.0: `meta/info.json`, and parquet files below `data`.

    The observation is made of all vectors of numbers whose names begin with `observation.`, in the order of their names;
    images and videos are left out. Rewards are `next.reward`, or else 1 at the first step of `next.success`, or else 1 at
    the last step of every episode. The numbers of all episodes are read into memory.

    :param path: the folder
    :param observation_keys: which features make up the observation, in this order, as `observation.state`
    :param episodes: numbers of the episodes to read, in this order; all if not given
    :param action_bounds: smallest and largest action, numbers or (A,) each; where they are not given, those of
        `action_space`, or what has been recorded
    :param clip_actions: bring actions outside of them to the nearest bound, however far, instead of refusing them
    :param action_space: the environment's
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: where the steps go, memory if not given
    :raises DatasetError: files missing or damaged, other numbers of episodes or frames than `meta/info.json` tells of, NaN
        or infinity, or actions out of bounds; names the folder, the feature, the episode and the step
    """
    folder = Path(path).expanduser()
    source = str(folder)
    features, told = _info(folder, source)
    keys = list(observation_keys or sorted(name for name in features if name.startswith(OBSERVATION)))
    for name in (*keys, ACTION):
        if name not in features:
            raise DatasetError(f"{source}: has no feature {name!r} of numbers, only {', '.join(sorted(features))}.")
    if not keys:
        raise DatasetError(
            f"{source}: no feature of numbers begins with {OBSERVATION!r}, only {', '.join(sorted(features))}."
        )
    labels = [name for name in (REWARD, SUCCESS, DONE) if name in features]
    columns, n_stored = _read(folder, [*keys, ACTION, *labels, EPISODE, FRAME], told["total_frames"], source)
    _check_labels(columns, labels, source)
    order = np.lexsort((columns[FRAME][:, 0], columns[EPISODE][:, 0]))
    columns = {name: values[order] for name, values in columns.items()}
    numbers, starts = np.unique(columns[EPISODE][:, 0], return_index=True)
    stops = np.append(starts[1:], len(order))
    if len(numbers) != told["total_episodes"]:
        told_of = f"{INFO} tells of {told['total_episodes']} episodes"
        raise DatasetError(f"{source}: {told_of}; there are {len(numbers)}.")
    if not labels or labels == [DONE]:
        warn_of_made_up_rewards((), source)
    wanted = range(len(numbers)) if episodes is None else [_place(number, numbers, source) for number in episodes]
    actions = columns[ACTION]
    if action_bounds is None and action_space is None:
        action_bounds = _recorded(actions)
    space = bounded_space(action_bounds, action_space, actions, source)
    observations = np.concatenate([columns[key] for key in keys], axis=1)
    actions = fitted(actions, space, clip_actions)

    def trajectory(place: int) -> Trajectory:
        number, start, stop = int(numbers[place]), int(starts[place]), int(stops[place])
        steps = slice(start, stop)
        frames = columns[FRAME][steps, 0]
        if not np.array_equal(frames, np.arange(stop - start)):
            raise DatasetError(f"{source}, episode {number}: {FRAME} does not count its {stop - start} frames from 0 on.")
        success = columns[SUCCESS][steps, 0] > 0 if SUCCESS in columns else None
        if REWARD in columns:
            rewards = columns[REWARD][steps, 0]
            ended = success if success is not None else columns.get(DONE, np.zeros((len(order), 1)))[steps, 0]
            terminated = bool(ended[-1])
        else:
            marks = np.eye(1, stop - start, stop - start - 1)[0] if success is None else success
            terminated = bool(marks.any())
            steps = slice(start, start + int(np.argmax(marks)) + 1 if terminated else stop)
            rewards = marks[: steps.stop - start].astype(float)
        return Trajectory(
            observations=observations[steps],
            actions=actions[steps],
            rewards=rewards,
            terminated=terminated,
            truncated=not terminated,
            success=None if success is None else bool(success.any()),
            name=f"episode {number}",
        )

    return TrajectoryBuffer.from_trajectories(
        map(trajectory, wanted),
        space,
        n_steps=int(sum(stops[i] - starts[i] for i in wanted)),
        source=source,
        storage=storage,
        on_invalid=on_invalid,
        n_stored=n_stored,
    )


def _info(folder: Path, source: str) -> tuple[dict[str, tuple[int, ...]], dict[str, int]]:
    """Shapes of the features that are numbers, and how many frames and episodes there should be."""
    with wrap_dataset_errors(f"{source}: {INFO}"):
        (path,) = (path for path in files_below(folder, "meta") if path == folder / INFO)
        info = json.loads(path.read_text())
        version = info.get("codebase_version")
        if not re.fullmatch(r"v[23]\.\d+", str(version)):
            raise DatasetError(f"{source}: {INFO}: codebase_version is {version!r:.20}; formats v2.0 to v3.0 are read.")
        told = {name: info[name] for name in ("total_frames", "total_episodes")}
        for name, count in told.items():
            if not COUNT.accepts(count):
                raise DatasetError(f"{source}: {INFO}: {name} is {count!r:.20}; {COUNT} is expected.")
        return {name: tuple(each["shape"]) for name, each in info["features"].items() if each["dtype"] in NUMBERS}, told


def _check_labels(columns: dict[str, np.ndarray], labels: Sequence[str], source: str) -> None:
    """Refuse what is not one number a frame, and of the right kind."""
    for name in (*labels, EPISODE, FRAME):
        if columns[name].shape[1] != 1:
            raise DatasetError(f"{source}: {name} has {columns[name].shape[1]} numbers a frame; one is expected.")
    for name in set(labels) - {REWARD}:
        check_flags(columns[name], len(columns[name]), f"{source}: {name}")
    odd = columns[EPISODE] % 1 != 0
    if odd.any():
        raise DatasetError(f"{source}: {EPISODE} is {columns[EPISODE][odd][0]}; whole numbers are expected.")


def _read(folder: Path, names: Sequence[str], n_frames: int, source: str) -> tuple[dict[str, np.ndarray], int]:
    """
    The columns of all parquet files, (N, .) each, and how many bytes are stored of them.

    :param names: of the columns
    :param n_frames: N, as the dataset tells
    """
    paths = [path for path in files_below(folder, DATA) if path.suffix == ".parquet"]
    if not paths:
        raise DatasetError(f"{source}: there is no parquet file below {DATA}.")
    pyarrow = import_pyarrow(source)
    n_stored = sum(path.stat().st_size for path in paths)
    parts: list[dict[str, np.ndarray]] = []
    n_found = n_numbers = 0
    for path in paths:
        with wrap_dataset_errors(str(path)), pyarrow.parquet.ParquetFile(path) as file:
            missing = sorted(set(names) - set(file.schema_arrow.names))
            if missing:
                raise DatasetError(f"{path}: has no column {', '.join(missing)}.")
            n_found += file.metadata.num_rows
            groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
            n_numbers += sum(group.column(i).num_values for group in groups for i in range(group.num_columns))
            check_size(8 * n_numbers, n_stored, f"{source}: {n_found} frames")
            table = file.read(columns=list(names))
            table.validate(full=True)
            parts.append({name: as_numbers(table[name].combine_chunks(), f"{path}: {name}") for name in names})
    if n_found != n_frames:
        raise DatasetError(f"{source}: {INFO} tells of {n_frames} frames; there are {n_found}.")
    with wrap_dataset_errors(source):
        return {name: np.concatenate([part[name] for part in parts]) for name in names}, n_stored


def _place(number: int, numbers: np.ndarray, source: str) -> int:
    found = np.flatnonzero(numbers == number)
    if len(found) != 1:
        raise DatasetError(f"{source}: there is no episode {number!r}, only {numbers[0]:g} to {numbers[-1]:g}.")
    return int(found[0])


def _recorded(actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest action of each dimension; 1 around one that never changes."""
    finite = np.where(np.isfinite(actions), actions, 0.0)  # others are refused by their step
    low, high = finite.min(axis=0), finite.max(axis=0)
    still = low == high
    return low - still, high + still
