"""Reading LeRobot datasets, folders of parquet files, into a `TrajectoryBuffer`."""

import json
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.arguments import COUNT, POSITIVE, Number
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, files_below
from sb3_dtfm.data.flat import bounded_space, fitted, json_options, warn_of_made_up_rewards
from sb3_dtfm.data.lerobot_images import DATA, EPISODE, FRAME, IMAGE, INFO, TIME, VIDEO, Cameras, Columns
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory, check_flags, wrap_dataset_errors
from sb3_dtfm.envs.observation_spaces import SMALLEST_PICTURE
from sb3_dtfm.files import warn

ACTION, REWARDS, SUCCESS, DONE = "action", ("next.reward", "reward"), "next.success", "next.done"
OBSERVATION = "observation."
PIXELS = Number(low=1, whole=True)
EPISODE_NUMBER = Number(low=0, whole=True)
# Data types of a robot's numbers.
NUMBERS = (
    "bool",
    *(f"float{n}" for n in (16, 32, 64)),
    *(f"{kind}{n}" for kind in ("int", "uint") for n in (8, 16, 32, 64)),
)
WHOLE = re.compile("u?int")


def is_lerobot(dataset: Any) -> bool:
    """Return whether this is the path of such a folder."""
    return isinstance(dataset, str | os.PathLike) and (Path(dataset).expanduser() / INFO).is_file()


def fingerprint_lerobot(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Take the fingerprint of a folder as it is now.

    :param path: the folder
    :param options: options of :func:`load_lerobot`
    """
    path = Path(path).expanduser()
    return Fingerprint.of(path.name, path, json_options(options))


def load_lerobot(
    path: str | os.PathLike[str],
    observation_keys: Sequence[str] | Mapping[str, str] | None = None,
    image_size: Sequence[int] | None = None,
    episodes: Sequence[int] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    The episodes of a LeRobot dataset, of its formats 2.0 to 3.0: `meta/info.json`, and parquet files below `data`.

    The observation is made of all features whose names begin with `observation.`: vectors of numbers in the order of their
    names, images, and the frames of videos at the steps' timestamps. Rewards are `next.reward` or `reward`, or else 1 at the
    first step of `next.success`, or else 1 at the last step of every episode. The numbers of all episodes are read into
    memory; images are read episode by episode.

    :param path: the folder
    :param observation_keys: names of the features that make up the observation, in this order, such as `observation.state`;
        or a mapping from the environment's names, `{"pixels": "observation.image", "agent_pos": "observation.state"}`
    :param image_size: (height, width) that all images are resized to, see :func:`~sb3_dtfm.envs.resize_image`; None keeps
        them as they are
    :param episodes: numbers of the episodes to read, in this order; all if not given
    :param action_bounds: smallest and largest action, numbers or (A,) each; where they are not given, those of
        `action_space`, or what has been recorded
    :param clip_actions: bring actions outside of them to the nearest bound, however far, instead of refusing them
    :param action_space: the environment's action space
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :raises DatasetError: files missing or damaged, other numbers of episodes or frames than `meta/info.json` tells of, NaN
        or infinity, or actions out of bounds; names the folder, the feature, the episode and the step
    """
    folder = Path(path).expanduser()
    source = str(folder)
    info = _info(folder, source)
    features = {name: each["dtype"] for name, each in info["features"].items()}
    maps = {name for name, each in info["features"].items() if _is_map(each["dtype"], each.get("shape", []))}
    names = _names(observation_keys, features, maps, source)
    cameras = {name: key for name, key in names.items() if features[key] in (IMAGE, VIDEO)}
    vectors = [key for name, key in names.items() if name not in cameras]
    reward = next((name for name in REWARDS if features.get(name) in NUMBERS), REWARDS[0])
    labels = [name for name in (reward, SUCCESS, DONE, TIME) if features.get(name) in NUMBERS]
    stored = Columns(folder, DATA, [*vectors, ACTION, *labels, EPISODE, FRAME], source)
    columns, n_frames, n_episodes = stored.numbers, info["total_frames"], info["total_episodes"]
    if len(stored) != n_frames:
        raise DatasetError(f"{source}: {INFO} tells of {n_frames} frames; there are {len(stored)}.")
    _check_labels(columns, labels, reward, source)
    size = None if image_size is None else _size(image_size)
    images = Cameras(folder, info, list(cameras.values()), stored.files, size, source)
    order = np.lexsort((columns[FRAME][:, 0], columns[EPISODE][:, 0]))
    columns = {name: values[order] for name, values in columns.items()}
    numbers, starts = np.unique(columns[EPISODE][:, 0], return_index=True)
    stops = np.append(starts[1:], len(order))
    if len(numbers) != n_episodes:
        raise DatasetError(f"{source}: {INFO} tells of {n_episodes} episodes; there are {len(numbers)}.")
    if not {reward, SUCCESS} & set(labels):
        warn_of_made_up_rewards((), source, f"there is no feature {' or '.join(REWARDS)} of numbers")
    wanted = range(len(numbers)) if episodes is None else _places(episodes, numbers, source)
    actions = columns[ACTION]
    if action_bounds is None and action_space is None:
        action_bounds = _recorded(actions)
    space = bounded_space(action_bounds, action_space, actions, source)
    observations = np.concatenate([columns[key] for key in vectors] or [np.zeros((len(order), 1))], axis=1)
    actions = fitted(actions, space, clip_actions)

    def trajectory(place: int) -> Trajectory:
        number, start, stop = int(numbers[place]), int(starts[place]), int(stops[place])
        steps = slice(start, stop)
        frames = columns[FRAME][steps, 0]
        if not np.array_equal(frames, np.arange(stop - start)):
            raise DatasetError(f"{source}, episode {number}: {FRAME} does not count its {stop - start} frames from 0 on.")
        rewards, terminated, success = _rewards({name: columns[name][steps, 0] for name in labels}, reward, stop - start)
        steps = slice(start, start + len(rewards))
        times = columns[TIME][steps, 0] if TIME in columns else frames[: len(rewards)] / info.get("fps", 1)
        return Trajectory(
            observations=observations[steps],
            images={name: images.read(key, number, order[steps], times) for name, key in cameras.items()},
            actions=actions[steps],
            rewards=rewards,
            terminated=terminated,
            truncated=not terminated,
            success=success,
            name=f"episode {number}",
        )

    return TrajectoryBuffer.from_trajectories(
        map(trajectory, wanted),
        space,
        n_steps=int(sum(stops[i] - starts[i] for i in wanted)),
        source=source,
        storage=storage,
        on_invalid=on_invalid,
        n_stored=stored.n_stored,
    )


def _info(folder: Path, source: str) -> dict[str, Any]:
    """Read what the dataset says of itself, so far as that is needed."""
    with wrap_dataset_errors(f"{source}: {INFO}"):
        (path,) = (path for path in files_below(folder, "meta") if path == folder / INFO)
        info: dict[str, Any] = json.loads(path.read_text())
        version = info.get("codebase_version")
        if not re.fullmatch(r"v2\.[01]|v3\.0", str(version)):
            raise DatasetError(f"{source}: {INFO}: codebase_version is {version!r:.20}; v2.0, v2.1 and v3.0 are read.")
        for name in ("total_frames", "total_episodes"):
            if not COUNT.accepts(info[name]):
                raise DatasetError(f"{source}: {INFO}: {name} is {info[name]!r:.20}; {COUNT} is expected.")
        if not POSITIVE.accepts(info.get("fps", 1)):
            raise DatasetError(f"{source}: {INFO}: fps is {info['fps']!r:.20}; {POSITIVE} is expected.")
        for name, each in info["features"].items():
            if not isinstance(each["dtype"], str):
                raise DatasetError(f"{source}: {INFO}: dtype of {name} is {each['dtype']!r:.20}; a word is expected.")
            if not isinstance(each.get("shape", []), list):
                raise DatasetError(f"{source}: {INFO}: shape of {name} is {each['shape']!r:.20}; a list is expected.")
        return info


def _names(
    keys: Sequence[str] | Mapping[str, str] | None, features: Mapping[str, str], maps: Collection[str], source: str
) -> dict[str, str]:
    """The observed features, by their names in the observation; depth maps only where `keys` names them."""
    known = sorted(name for name, dtype in features.items() if dtype in (*NUMBERS, IMAGE, VIDEO))
    offered = [name for name in known if name.startswith(OBSERVATION) and name not in maps]
    chosen = offered if keys is None else keys
    unread = [
        f"{name} ({dtype})" for name, dtype in features.items() if name.startswith(OBSERVATION) and name not in offered
    ]
    if keys is None and unread:
        warn(f"{source}: neither vectors nor images, and not read: {', '.join(unread)}.", stacklevel=3)
    # The environment shows its entries in the order of their names.
    names = dict(sorted(chosen.items())) if isinstance(chosen, Mapping) else {name: name for name in chosen}
    for name in names.values():
        if name not in known:
            raise DatasetError(f"{source}: has no feature {name!r} of numbers or images, only {', '.join(known)}.")
    if features.get(ACTION) not in NUMBERS:
        raise DatasetError(f"{source}: has no feature {ACTION!r} of numbers, only {', '.join(known)}.")
    if not names:
        raise DatasetError(
            f"{source}: no vector or image begins with {OBSERVATION!r}; observation_keys chooses among {', '.join(known)}."
        )
    return names


def _is_map(dtype: str, shape: list[Any]) -> bool:
    """Return whether a feature of numbers has a picture's shape, such as a map of depth."""
    n_large = sum(PIXELS.accepts(side) and side >= SMALLEST_PICTURE for side in shape)
    return dtype in NUMBERS and len(shape) > 1 and (WHOLE.match(dtype) is not None or n_large > 1)


def _size(size: Any) -> tuple[int, int]:
    if not (isinstance(size, Sequence) and len(size) == 2 and all(PIXELS.accepts(each) for each in size)):
        raise ValueError(f"image_size must be height and width, pixels, got {size!r}.")
    return size[0], size[1]


def _check_labels(columns: dict[str, np.ndarray], labels: Sequence[str], reward: str, source: str) -> None:
    """Refuse what is not one number a frame, and of the right kind."""
    for name in (*labels, EPISODE, FRAME):
        if columns[name].shape[1] != 1:
            raise DatasetError(f"{source}: {name} has {columns[name].shape[1]} numbers a frame; one is expected.")
    for name in set(labels) - {reward, TIME}:
        check_flags(columns[name], len(columns[name]), f"{source}: {name}")
    with np.errstate(invalid="ignore"):  # infinity % 1 is NaN
        odd = (columns[EPISODE] % 1 != 0) | (columns[EPISODE] < 0)
    if odd.any():
        raise DatasetError(f"{source}: {EPISODE} is {columns[EPISODE][odd][0]}; {EPISODE_NUMBER} is expected.")


def _rewards(labels: dict[str, np.ndarray], reward: str, n_steps: int) -> tuple[np.ndarray, bool, bool | None]:
    """
    :param labels: labels of an episode, (T,) each, by column name
    :param reward: name of the rewards' column, which may be missing
    :param n_steps: T
    :return: rewards of all steps, or up to the success; whether the task was done then, and whether it ever was
    """
    success = labels[SUCCESS] > 0 if SUCCESS in labels else None
    told = None if success is None else bool(success.any())
    if reward in labels:
        ended = success if success is not None else labels.get(DONE, np.zeros(n_steps))
        return labels[reward], bool(ended[-1]), told
    marks = np.eye(1, n_steps, n_steps - 1)[0] if success is None else success
    return marks[: int(np.argmax(marks)) + 1 if marks.any() else n_steps].astype(float), bool(marks.any()), told


def _places(episodes: Any, numbers: np.ndarray, source: str) -> list[int]:
    """Return where some episodes are among the numbers of all."""
    if isinstance(episodes, str) or not (isinstance(episodes, Iterable) and all(map(EPISODE_NUMBER.accepts, episodes))):
        raise ValueError(f"episodes must be a list of whole numbers of at least 0, or None, got {episodes!r}.")
    place_of = {number: place for place, number in enumerate(numbers.tolist())}
    for number in episodes:
        if number not in place_of:
            raise DatasetError(f"{source}: there is no episode {number!r}, only {numbers[0]:g} to {numbers[-1]:g}.")
    return [place_of[number] for number in episodes]


def _recorded(actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest action of each dimension; 1 around one that never changes."""
    finite = np.where(np.abs(actions) <= np.finfo(np.float32).max, actions, 0.0)  # others are refused by their step
    low, high = finite.min(axis=0), finite.max(axis=0)
    still = low == high
    return low - still, high + still
