"""robomimic's hdf5 files: read into a `TrajectoryBuffer`, and written in the layout of robomimic 1.5."""

import json
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_dtfm.data.trajectories import DatasetError, Trajectory, TrajectoryBuffer

DEFAULT_OBSERVATION_KEYS = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "object")
ALIASES = {"object": "object-state", "object-state": "object"}  # robomimic's name and robosuite's
VALIDATION_SHARE = 0.1
OLD_LAYOUT_TOLERANCE = 1e-3  # metres


def load_robomimic(
    path: str | os.PathLike[str], filter_key: str | None = None, observation_keys: Sequence[str] | None = None
) -> TrajectoryBuffer:
    """
    The demonstrations of a robomimic hdf5 file, of robosuite 1.4 or 1.5.

    Rewards are those of :class:`~sb3_dtfm.envs.robosuite.RobosuiteEnv`, whose episode ends at the first success: where a file
    has rewards of 0 and 1 only, an episode is cut after its first 1, so that its return is 1 (robomimic's recordings often
    go on for some steps), and is `terminated`. Without success it is `truncated` if the file marks its end as done. Where no
    episode of the file has any reward, or none has been stored, the first step that is done counts as the success, or the
    last step if nothing is marked as done. Other rewards (dense ones) are kept as they are.

    The `object` observation of robosuite <= 1.4 is brought into the present form, which the environment shows too: Lift's
    gripper-to-cube vector had the opposite sign, and Can's two poses the opposite order.

    :param path: the file
    :param filter_key: read only the demonstrations listed in `mask/<filter_key>`, such as "train"
    :param observation_keys: which of a demonstration's `obs` make up the observation, in this order; robomimic's
        low-dimensional ones by default
    :return: actions in the controller's input range, [-1, 1] if the file says nothing else
    :raises DatasetError: no such file, not readable, nothing in it, unknown keys, wrong shapes, NaN or infinity, or actions out
        of range; names the file, the demonstration and the step
    """
    source = str(path)
    try:
        with _open(source) as file:
            return _read(file, source, filter_key, tuple(observation_keys or DEFAULT_OBSERVATION_KEYS))
    except OSError as error:
        raise DatasetError(f"{source}: cannot be read to the end ({error}); is the file cut off?") from error


def _open(source: str) -> h5py.File:
    if not os.path.isfile(source):
        raise DatasetError(f"{source}: no such file; the path of a robomimic hdf5 file is expected.")
    if not h5py.is_hdf5(source):
        raise DatasetError(f"{source}: not an hdf5 file; a robomimic hdf5 file is expected.")
    return h5py.File(source, "r")


def _read(file: h5py.File, source: str, filter_key: str | None, observation_keys: tuple[str, ...]) -> TrajectoryBuffer:
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
    labels = _sparse_on_success(labels)
    n_actions = data[demos[0]]["actions"].shape[1]

    def trajectories() -> Iterator[Trajectory]:
        for name in demos:
            rewards, dones = labels[name]
            observations = _observations(data[name], f"{source}, {name}", steps[name], observation_keys, env_args)
            success = bool(rewards[-1] == 1.0)
            done = bool(dones is not None and dones[len(rewards) - 1])
            yield Trajectory(
                observations=observations[: len(rewards)],
                actions=np.asarray(data[name]["actions"][: len(rewards)]),
                rewards=rewards,
                terminated=success,
                truncated=done and not success,
                name=name,
            )

    return TrajectoryBuffer.from_trajectories(
        trajectories(),
        action_space=_action_space(env_args, n_actions, source),
        lengths=[len(labels[name][0]) for name in demos],
        source=source,
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
        raise DatasetError(f"{where}: actions have shape {actions.shape}, expected (steps, dimensions) of at least one step.")
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


def _sparse_on_success(
    labels: dict[str, tuple[np.ndarray | None, np.ndarray | None]],
) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Rewards as the environment gives them, cut after the first success; see :func:`load_robomimic`."""
    rewarded = any(rewards is not None and np.any(rewards != 0) for rewards, _ in labels.values())
    binary = all(rewards is None or np.isin(rewards, (0, 1)).all() for rewards, _ in labels.values())
    sparse: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
    for name, (rewards, dones) in labels.items():
        return
    return sparse
