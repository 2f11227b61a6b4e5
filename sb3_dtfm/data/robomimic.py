"""Reading robomimic's hdf5 files into a `TrajectoryBuffer`."""

import json
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory
from sb3_dtfm.envs.robosuite import env_id_from_robomimic

DEFAULT_OBSERVATION_KEYS = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "object")
EXPECTED = "the path of a robomimic hdf5 file"
HDF5_SUFFIXES = (".hdf5", ".h5")
ALIASES = {"object": "object-state", "object-state": "object"}  # robomimic's name and robosuite's
OLD_LAYOUT_TOLERANCE = 1e-3  # metres


def is_robomimic(dataset: Any) -> bool:
    """Whether this is the path of a file: one that exists, or a name that nothing else would have."""
    if not isinstance(dataset, str):
        return isinstance(dataset, os.PathLike)
    looks_like_a_path = dataset.startswith((".", "~", os.sep)) or dataset.endswith(HDF5_SUFFIXES)
    return looks_like_a_path or os.path.isfile(dataset)


def fingerprint_robomimic(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Of a file as it is now.

    :param path: the file
    :param options: of :func:`load_robomimic`
    :raises DatasetError: no such file
    """
    path = existing_file(path, EXPECTED)
    return Fingerprint.of(path.name, path, options)


def load_robomimic(
    path: str | os.PathLike[str],
    filter_key: str | None = None,
    observation_keys: Sequence[str] | None = None,
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    The demonstrations of a robomimic hdf5 file, of robosuite 1.4 or 1.5.

    Rewards are those of :class:`~sb3_dtfm.envs.robosuite.RobosuiteEnv`, whose episode ends at the first success: where a
    file has rewards of 0 and 1 only, an episode is cut after its first 1, so that its return is 1 (robomimic's recordings
    often go on for some steps), and is `terminated`. Without success it is `truncated` if the file marks its end as done.
    Where no episode of the file has any reward, or none has been stored, the first step that is done counts as the
    success, or the last step if nothing is marked as done. Other rewards (dense ones) are kept as they are.

    The `object` observation of robosuite <= 1.4 is brought into the present form, which the environment shows too: Lift's
    gripper-to-cube vector had the opposite sign, and the two poses of Can, Square and the like the opposite order.

    :param path: the file
    :param filter_key: read only the demonstrations listed in `mask/<filter_key>`, such as "train"
    :param observation_keys: which of a demonstration's `obs` make up the observation, in this order; robomimic's
        low-dimensional ones by default
    :param storage: where the steps go, memory if not given
    :return: actions in the controller's input range, [-1, 1] if the file says nothing else
    :raises DatasetError: no such file, not readable, nothing in it, unknown keys, wrong shapes, NaN or infinity, or actions
        out of range; names the file, the demonstration and the step
    """
    path = existing_file(path, EXPECTED)
    source = str(path)
    try:
        if not h5py.is_hdf5(path):
            raise DatasetError(f"{source}: not an hdf5 file; a robomimic hdf5 file is expected.")
        with h5py.File(path, "r") as file:
            return _read(file, source, filter_key, tuple(observation_keys or DEFAULT_OBSERVATION_KEYS), storage)
    except OSError as error:
        raise DatasetError(f"{source}: cannot be read to the end ({error}); is the file cut off?") from error


def _read(
    file: h5py.File, source: str, filter_key: str | None, observation_keys: tuple[str, ...], storage: FileStorage | None
) -> TrajectoryBuffer:
    data = file.get("data")
    if not isinstance(data, h5py.Group):
        raise DatasetError(f"{source}: has no group 'data', only {_listed(file)}; a robomimic hdf5 file is expected.")
    all_demos = sorted((name for name in data if isinstance(data[name], h5py.Group)), key=_number)
    if not all_demos:
        raise DatasetError(f"{source}: group 'data' holds no demonstration; at least one ('demo_0') is needed.")
    demos = all_demos if filter_key is None else _filtered(file, source, filter_key, all_demos)
    env_args = _env_args(data, source)
    steps = {name: _n_steps(data[name], f"{source}, {name}") for name in all_demos}
    labels = {name: _labels(data[name], f"{source}, {name}", steps[name]) for name in all_demos}
    rewards = _rewards(labels, steps)
    n_actions = data[demos[0]]["actions"].shape[1]

    def trajectories() -> Iterator[Trajectory]:
        for name in demos:
            length, dones = len(rewards[name]), labels[name][1]
            observations = _observations(data[name], f"{source}, {name}", steps[name], observation_keys)
            success = bool(rewards[name][-1] >= 1.0)
            done = dones is not None and bool(dones[length - 1])
            yield Trajectory(
                observations=_present_object_state(observations, observation_keys, env_args)[:length],
                actions=np.asarray(data[name]["actions"][:length]),
                rewards=rewards[name],
                terminated=success,
                truncated=done and not success,
                name=name,
            )

    return TrajectoryBuffer.from_trajectories(
        trajectories(),
        action_space=_action_space(env_args, n_actions, source),
        n_steps=sum(len(rewards[name]) for name in demos),
        source=source,
        env_id=env_id_from_robomimic(env_args),
        storage=storage,
    )


def _number(name: str) -> tuple[int, str]:
    """Order of "demo_2" before "demo_10"."""
    digits = re.search(r"(\d+)$", name)
    return (int(digits[1]) if digits else -1, name)


def _listed(names: Any) -> str:
    return ", ".join(map(repr, sorted(names))) or "nothing"


def _filtered(file: h5py.File, source: str, filter_key: str, demos: list[str]) -> list[str]:
    masks = file.get("mask", {})
    if filter_key not in masks:
        raise DatasetError(f"{source}: has no filter key {filter_key!r}; available: {_listed(masks)}.")
    listed = np.asarray(masks[filter_key][()]).reshape(-1).tolist()
    names = [name.decode() if isinstance(name, bytes) else str(name) for name in listed]
    missing = sorted(set(names) - set(demos), key=_number)
    if missing:
        raise DatasetError(f"{source}: filter key {filter_key!r} lists {missing[0]!r}, which is not in group 'data'.")
    if not names:
        raise DatasetError(f"{source}: filter key {filter_key!r} lists no demonstration; at least one is needed.")
    return sorted(set(names), key=_number)


def _env_args(data: h5py.Group, source: str) -> dict[str, Any]:
    text = data.attrs.get("env_args", "{}")
    try:
        env_args = json.loads(text)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{source}: attribute 'env_args' of group 'data' is not JSON ({error}).") from error
    return env_args if isinstance(env_args, dict) else {}


def _n_steps(demo: h5py.Group, where: str) -> int:
    actions = demo.get("actions")
    if not isinstance(actions, h5py.Dataset):
        raise DatasetError(f"{where}: has no 'actions', only {_listed(demo)}.")
    if actions.ndim != 2 or len(actions) == 0:
        raise DatasetError(
            f"{where}: actions have shape {actions.shape}, expected (steps, dimensions) of at least one step."
        )
    return len(actions)


def _labels(demo: h5py.Group, where: str, n_steps: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Rewards and dones, (T,) each, None where the file has none."""
    labels: list[np.ndarray | None] = []
    for name in ("rewards", "dones"):
        if name not in demo:
            labels.append(None)
            continue
        array = np.asarray(demo[name][()])
        if array.size != n_steps:
            raise DatasetError(f"{where}: {name} have shape {array.shape}, expected ({n_steps},), one for each action.")
        labels.append(array.reshape(n_steps))
    return labels[0], labels[1]


def _rewards(labels: dict[str, tuple[np.ndarray | None, np.ndarray | None]], steps: dict[str, int]) -> dict[str, np.ndarray]:
    """Rewards as the environment gives them, cut after the first success; see :func:`load_robomimic`."""
    stored = {name: np.zeros(steps[name]) if array is None else array.astype(float) for name, (array, _) in labels.items()}
    if not all(np.isin(array, (0.0, 1.0)).all() for array in stored.values()):
        return stored
    rewarded = any(array.any() for array in stored.values())
    rewards = {}
    for name, array in stored.items():
        dones = labels[name][1]
        marks = array if rewarded or dones is None else dones
        successes = np.flatnonzero(marks)
        if len(successes) == 0 and rewarded:
            rewards[name] = array
            continue
        length = int(successes[0]) + 1 if len(successes) else steps[name]
        rewards[name] = np.zeros(length)
        rewards[name][-1] = 1.0
    return rewards


def _observations(demo: h5py.Group, where: str, n_steps: int, keys: tuple[str, ...]) -> np.ndarray:
    """The chosen observations side by side, (T, O)."""
    group = demo.get("obs")
    if not isinstance(group, h5py.Group):
        raise DatasetError(f"{where}: has no group 'obs', only {_listed(demo)}; observations must be in the file.")
    parts = []
    for key in keys:
        name = key if key in group else ALIASES.get(key, key)
        if name not in group:
            raise DatasetError(f"{where}: has no observation {key!r}; available: {_listed(group)}.")
        array = np.asarray(group[name][()])
        if array.ndim == 1:
            array = array[:, None]
        if array.ndim != 2 or len(array) != n_steps:
            raise DatasetError(
                f"{where}: observation {name!r} has shape {array.shape}, expected ({n_steps}, dimensions), "
                "one row for each action."
            )
        parts.append(array)
    return np.concatenate(parts, axis=1)


def _present_object_state(observations: np.ndarray, keys: tuple[str, ...], env_args: dict[str, Any]) -> np.ndarray:
    """
    The object's part as robosuite 1.5 has it, where the numbers show that an older robosuite wrote it.

    :param observations: (T, O)
    """
    version = [int(number) for number in re.findall(r"\d+", str(env_args.get("env_version", "")))[:2]]
    if keys != DEFAULT_OBSERVATION_KEYS or not version or version >= [1, 5]:
        return observations
    hand, quaternion, state = observations[:, :3], observations[:, 3:7], observations[:, 9:]
    if (
        env_args.get("env_name") == "Lift"
        and state.shape[1] == 10
        and np.allclose(state[:, 7:], hand - state[:, :3], atol=OLD_LAYOUT_TOLERANCE)
    ):
        return np.concatenate([observations[:, :16], -observations[:, 16:]], axis=1)
    if state.shape[1] == 14:  # one object's two poses: Can, Milk, Bread, Cereal, Square, Round
        in_hand = _in_frame(state[:, :3] - hand, quaternion)
        if np.allclose(state[:, 7:10], in_hand, atol=OLD_LAYOUT_TOLERANCE):
            return np.concatenate([observations[:, :9], state[:, 7:], state[:, :7]], axis=1)
    return observations


def _in_frame(vectors: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """
    World vectors seen from rotated frames.

    :param vectors: (T, 3)
    :param quaternions: (T, 4) orientations of the frames, x y z w
    """
    axes, scalars = -quaternions[:, :3], quaternions[:, 3:]
    crossed = 2.0 * np.cross(axes, vectors)
    return np.asarray(vectors + scalars * crossed + np.cross(axes, crossed))


def _action_space(env_args: dict[str, Any], n_actions: int, source: str) -> spaces.Box:
    """The controller's input range for the arm, [-1, 1] for the gripper and where the file says nothing."""
    config = env_args.get("env_kwargs", {}).get("controller_configs") or {}
    config = config[0] if isinstance(config, list) else config
    arm = config.get("body_parts", {}).get("right", config)
    if arm.get("input_type", "delta") != "delta" or arm.get("control_delta", True) is False:
        raise DatasetError(f"{source}: actions are absolute poses; only files with a delta controller are accepted.")
    low, high = -np.ones(n_actions, np.float32), np.ones(n_actions, np.float32)
    low[: n_actions - 1], high[: n_actions - 1] = arm.get("input_min", -1.0), arm.get("input_max", 1.0)
    return spaces.Box(low, high, dtype=np.float32)
