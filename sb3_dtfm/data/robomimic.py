"""Reading robomimic's hdf5 files into a `TrajectoryBuffer`."""

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file
from sb3_dtfm.data.flat import bounded_space, explain_range, fitted, json_options, warn_of_made_up_rewards
from sb3_dtfm.data.hdf5 import listed, open_group, open_hdf5, read_hdf5, read_names
from sb3_dtfm.data.observations import Observed, is_images, observed
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory, check_finite, check_flags, wrap_dataset_errors
from sb3_dtfm.envs.robosuite import arm_controller, arm_motion, differences_in_motion, env_id_from_robomimic
from sb3_dtfm.envs.robosuite.registration import ROBOSUITE_TYPE

DEFAULT_OBSERVATION_KEYS = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "object")
EXPECTED = "the path of a robomimic hdf5 file"
HDF5_SUFFIXES = (".hdf5", ".h5")
ALIASES = {"object": "object-state", "object-state": "object"}  # robomimic's name and robosuite's
OLD_LAYOUT_TOLERANCE = 1e-3  # metres


def is_robomimic(dataset: Any) -> bool:
    """Return whether this is the path of an hdf5 file, or looks like a path where no file is."""
    if not isinstance(dataset, str | os.PathLike):
        return False
    path = os.path.expanduser(os.fspath(dataset))
    if path.endswith(HDF5_SUFFIXES):
        return True
    if os.path.isfile(path):
        return h5py.is_hdf5(path)
    return not isinstance(dataset, str) or dataset.startswith((".", "~", os.sep))


def fingerprint_robomimic(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Take the fingerprint of a file as it is now.

    :param path: the file
    :param options: options of :func:`load_robomimic`
    :raises DatasetError: no such file, or one of another robot or controller, see :func:`load_robomimic`
    """
    options = dict(options)
    known = {name: options.pop(name, None) for name in ("env_id", "env_args")}  # which a cache does not hold
    with _opened(path) as (file, source):
        if "data" in set(file):
            env_args = _env_args(open_group(file, "data", source), source)
            _env_id(env_args, source, **known)
            if _is_robosuite(env_args):
                options.pop("action_space", None)
    return Fingerprint.of(Path(source).name, Path(source), json_options(options))


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[tuple[h5py.File, str]]:
    """Open a file while it is read, and return its name, too."""
    path = existing_file(path, EXPECTED)
    if not h5py.is_hdf5(path):
        raise DatasetError(f"{path}: not an hdf5 file; a robomimic hdf5 file is expected.")
    with wrap_dataset_errors(str(path)), h5py.File(path, "r") as file:
        yield file, str(path)


def load_robomimic(
    path: str | os.PathLike[str],
    filter_key: str | None = None,
    observation_keys: Sequence[str] | Mapping[str, str] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    env_id: str | None = None,
    env_args: dict[str, Any] | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    The demonstrations of a robomimic hdf5 file, of robosuite 1.4 or 1.5.

    Rewards are those of :class:`~sb3_dtfm.envs.robosuite.RobosuiteEnv`, whose episode ends at the first success: where a
    file has rewards of 0 and 1 only, an episode is cut after its first 1, so that its return is 1 (robomimic's recordings
    often go on for some steps), and is `terminated`. Any other episode is `truncated` if the file marks its end as done.
    If no episode of the file has any reward, or none has been stored, the first step that is done counts as the
    success, or the last step if nothing is marked as done. Other rewards (dense ones) are kept as they are; they
    tell of success in robosuite's files, where it is rewarded by 1.

    The `object` observation of robosuite <= 1.4 is brought into the present form, which the environment shows too: Lift's
    gripper-to-cube vector had the opposite sign, and the two poses of Can, Square and the like the opposite order.

    :param path: the file
    :param filter_key: name of the list `mask/<filter_key>` of demonstrations to read, such as "train"; None reads all
    :param observation_keys: names of the arrays in a demonstration's `obs` that make up the observation, in this order; or a
        mapping from the environment's names, `{"pixels": "agentview_image"}`; robomimic's low-dimensional ones by default
    :param action_bounds: see :func:`~sb3_dtfm.data.load_flat`; only for files of other simulators than robosuite
    :param clip_actions: bring actions outside of the range to the nearest bound
    :param action_space: the environment's action space; robosuite's files tell of their range themselves
    :param env_id: Gymnasium id of the environment that the file's actions are meant for; by default ours of the file's task,
        and a file of another robot or controller is refused
    :param env_args: `RobosuiteEnv.env_args` of the environment whose robot and controller have to be the file's; by default
        those of the registered ones
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :return: buffer with actions in the controller's input range, or in that of `action_bounds` or `action_space`; [-1, 1]
        if nothing tells
    :raises DatasetError: no such file, not readable, nothing in it, unknown keys, wrong shapes, NaN or infinity, or actions
        out of range; names the file, the demonstration and the step
    """
    keys = observation_keys or DEFAULT_OBSERVATION_KEYS
    # The environment shows its entries in the order of their names.
    names = dict(sorted(keys.items())) if isinstance(keys, Mapping) else {key: key for key in keys}
    with _opened(path) as (file, source):
        bounds = action_bounds, action_space
        return _read(file, source, filter_key, names, bounds, clip_actions, (env_id, env_args), on_invalid, storage)


class _Labels(NamedTuple):
    """Rewards and dones of one demonstration of T steps, (T,) each, None where the file has none."""

    rewards: np.ndarray | None
    dones: np.ndarray | None
    n_steps: int
    n_actions: int


def _read(
    file: h5py.File,
    source: str,
    filter_key: str | None,
    observation_keys: dict[str, str],
    bounds: tuple[Sequence[Any] | None, ActionSpace | None],
    clip_actions: bool,
    meant_for: tuple[str | None, dict[str, Any] | None],
    on_invalid: str,
    storage: FileStorage | None,
) -> TrajectoryBuffer:
    data = open_group(file, "data", source)
    all_demos = sorted(data, key=_number)
    if not all_demos:
        raise DatasetError(f"{source}: group 'data' holds no demonstration; at least one ('demo_0') is needed.")
    demos = all_demos if filter_key is None else _filtered(file, source, filter_key, all_demos)
    env_args = _env_args(data, source)
    groups: dict[str, h5py.Group] = {}
    labels: dict[str, _Labels] = {}
    refused: dict[str, DatasetError] = {}
    for name in all_demos:  # what counts as a success is seen in all of them
        try:
            groups[name] = open_group(data, name, source)
            labels[name] = _labels(groups[name], f"{source}, {name}")
        except DatasetError as error:
            refused[name] = error
    if not refused:
        _check_count(data, "total", sum(demo.n_steps for demo in labels.values()), source)
    env_id = _env_id(env_args, source, *meant_for)
    if not any(demo.rewards is not None and demo.rewards.any() for demo in labels.values()):
        all_zero = any(demo.rewards is not None for demo in labels.values())
        warn_of_made_up_rewards((), source, "there is no reward but 0" if all_zero else "there are no rewards")
    n_actions = next((labels[name].n_actions for name in demos if name in labels), None)
    if n_actions is None:
        raise refused[demos[0]]
    action_space = _action_space(env_args, n_actions, bounds, source)
    of_robosuite = _is_robosuite(env_args)
    rewards, tells_success = _rewards(labels, of_robosuite)

    def trajectory(name: str) -> Trajectory:
        if name in refused:
            raise refused[name]
        where = f"{source}, {name}"
        with wrap_dataset_errors(where):
            length, dones = len(rewards[name]), labels[name].dones
            seen = _observations(groups[name], where, labels[name].n_steps, observation_keys)
            success = bool(rewards[name][-1] >= 1.0) if tells_success else None
            done = dones is not None and bool(dones[length - 1])
            return Trajectory(
                observations=_present_object_state(seen.vectors, tuple(observation_keys.values()), env_args)[:length],
                images=seen.first(length).images,
                actions=fitted(read_hdf5(groups[name], "actions", where)[:length], action_space, clip_actions),
                rewards=rewards[name],
                terminated=bool(success),
                truncated=done and not success,
                success=success,
                name=name,
            )

    with contextlib.nullcontext() if of_robosuite else explain_range(action_space, *bounds):
        buffer = TrajectoryBuffer.from_trajectories(
            map(trajectory, demos),
            action_space=action_space,
            n_steps=sum(len(rewards[name]) for name in demos if name in rewards),
            source=source,
            env_id=env_id,
            storage=storage,
            on_invalid=on_invalid,
            n_stored=os.path.getsize(source),
        )
    buffer.controller = None if env_id is None else arm_motion(env_args)
    return buffer


def _number(name: str) -> tuple[int, str]:
    """Sort key that puts "demo_2" before "demo_10"."""
    digits = re.search(r"(\d+)$", name)
    return (int(digits[1]) if digits else -1, name)


def _filtered(file: h5py.File, source: str, filter_key: str, demos: list[str]) -> list[str]:
    masks = open_group(file, "mask", source) if "mask" in set(file) else {}
    if filter_key not in set(masks):
        raise DatasetError(f"{source}: has no filter key {filter_key!r}; available: {listed(masks)}.")
    names = read_names(masks, filter_key, f"{source}: mask")
    missing = sorted(set(names) - set(demos), key=_number)
    if missing:
        raise DatasetError(f"{source}: filter key {filter_key!r} lists {missing[0]!r}, which is not in group 'data'.")
    if not names:
        raise DatasetError(f"{source}: filter key {filter_key!r} lists no demonstration; at least one is needed.")
    return sorted(set(names), key=_number)


def _env_args(data: h5py.Group, source: str) -> dict[str, Any]:
    with wrap_dataset_errors(f"{source}: attribute 'env_args' of group 'data' is not JSON"):
        env_args = json.loads(data.attrs.get("env_args", "{}"))
    return env_args if isinstance(env_args, dict) else {}


def _env_id(recorded: dict[str, Any], source: str, env_id: str | None, env_args: dict[str, Any] | None) -> str | None:
    """Return the id of our environment of the file's task; check robot and controller if `env_id` is not given."""
    with wrap_dataset_errors(f"{source}: attribute 'env_args' of group 'data'"):
        own_id = env_id_from_robomimic(recorded)
        if own_id is not None and not env_id:
            name = "the environment" if env_args else own_id
            check_controller(arm_motion(recorded), env_args or {}, name, source)
    return own_id


def check_controller(
    controller: dict[str, Any] | None,
    env_args: dict[str, Any] | None,
    name: str = "the environment",
    source: str | None = None,
) -> None:
    """
    Refuse an environment in which an action does something else than where the data were recorded.

    :param controller: controller of the data, see :class:`~sb3_dtfm.data.TrajectoryBuffer`; None where they do not tell
    :param env_args: the environment's description, see :func:`load_robomimic`; None where it does not tell
    :param name: name of the environment, for messages
    :param source: name of the data, for messages; None for the data of a model
    :raises DatasetError: robot, controller or control frequency differ
    """
    if controller is None or env_args is None:
        return
    if differences := differences_in_motion(controller, arm_motion(env_args)):
        found = ", ".join(f"{field} is {theirs!r} instead of {ours!r}" for field, (theirs, ours) in differences.items())
        insist = "say what the actions are meant for, dataset_kwargs={'env_id': ...}"
        if source is None:
            source, insist = "The model's data", "load the model with controller=None, to act there all the same"
        raise DatasetError(
            f"{source}: an action does something else than in {name}: {found}. Give an environment with the data's settings "
            f"(sb3_dtfm.envs.robosuite.env_kwargs_from_robomimic), or {insist}."
        )


def _check_count(group: h5py.Group, name: str, n_steps: int, where: str) -> None:
    """Compare the number of steps with the one that the file tells of, if it does."""
    told = group.attrs.get(name, n_steps)
    if not np.array_equal(told, n_steps):
        raise DatasetError(f"{where}: attribute {name!r} tells of {told} steps; there are {n_steps}.")


def _labels(demo: h5py.Group, where: str) -> _Labels:
    _, shape, _ = open_hdf5(demo, "actions", where)
    if len(shape) != 2 or 0 in shape:
        raise DatasetError(f"{where}: actions have shape {shape}, expected (steps, dimensions) of at least one step.")
    n_steps, n_actions = shape
    rewards = dones = None
    if "rewards" in set(demo):  # a link into nothing, too
        rewards = read_hdf5(demo, "rewards", where)
        if rewards.size != n_steps or rewards.shape[:1] != (n_steps,):
            raise DatasetError(f"{where}: rewards have shape {rewards.shape}, expected ({n_steps},), one for each action.")
        rewards = rewards.reshape(n_steps)
        check_finite(rewards, "rewards", where)
    if "dones" in set(demo):
        dones = check_flags(read_hdf5(demo, "dones", where), n_steps, f"{where}: dones")
    with wrap_dataset_errors(where):
        _check_count(demo, "num_samples", n_steps, where)
    return _Labels(rewards, dones, n_steps, n_actions)


def _rewards(labels: dict[str, _Labels], of_robosuite: bool) -> tuple[dict[str, np.ndarray], bool]:
    """
    Rewards as the environment gives them, cut after the first success, and whether they tell of success: robosuite's do,
    also dense ones, which reach 1 then; of others those that are 0 and 1, unless 1 is there from the first step on.
    """
    stored = {
        name: np.zeros(demo.n_steps) if demo.rewards is None else demo.rewards.astype(float) for name, demo in labels.items()
    }
    if not all(np.isin(array, (0.0, 1.0)).all() for array in stored.values()):
        return stored, of_robosuite
    if not of_robosuite and any(array[:-1][:1].any() for array in stored.values()):
        return stored, False
    rewarded = any(array.any() for array in stored.values())
    rewards = {}
    for name, array in stored.items():
        dones = labels[name].dones
        marks = array if rewarded or dones is None else dones
        successes = np.flatnonzero(marks)
        if len(successes) == 0 and rewarded:
            rewards[name] = array
            continue
        length = int(successes[0]) + 1 if len(successes) else len(array)
        rewards[name] = np.zeros(length)
        rewards[name][-1] = 1.0
    return rewards, True


def _observations(demo: h5py.Group, where: str, n_steps: int, keys: dict[str, str]) -> Observed:
    """The chosen observations by the environment's names, vectors side by side and images by camera."""
    group = open_group(demo, "obs", where)
    names, entries = set(group), {}
    for own, key in keys.items():
        name = key if key in names else ALIASES.get(key, key)
        if name not in names:
            raise DatasetError(
                f"{where}: has no observation {key!r}; available: {listed(group)}. Choose with observation_keys=[...]."
            )
        array = read_hdf5(group, name, where)
        if array.ndim == 1:
            array = array[:, None]
        if len(array) != n_steps or not (array.ndim == 2 or is_images(array)):
            raise DatasetError(
                f"{where}: observation {name!r} is {array.dtype} of shape {array.shape}, expected ({n_steps}, dimensions), "
                f"one row for each action, or uint8 images ({n_steps}, height, width, channels)."
            )
        entries[own] = array
    return observed(entries, list(entries), None, where)


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


def _is_robosuite(env_args: dict[str, Any]) -> bool:
    """Return whether robosuite recorded a file: robomimic's number of it, or a task or a controller as robosuite has it."""
    controller = arm_controller(env_args.get("env_kwargs", {}))
    return bool(env_args.get("type") == ROBOSUITE_TYPE or env_id_from_robomimic(env_args) or controller)


def _action_space(
    env_args: dict[str, Any], n_actions: int, bounds: tuple[Sequence[Any] | None, ActionSpace | None], source: str
) -> ActionSpace:
    """The controller's input range for robosuite's arm, [-1, 1] for its gripper; others' range as :func:`bounded_space`."""
    with wrap_dataset_errors(f"{source}: attribute 'env_args' of group 'data'"):
        if not _is_robosuite(env_args):
            return bounded_space(*bounds, np.zeros((1, n_actions)), source)
        if bounds[0] is not None:
            raise DatasetError(
                f"{source}: action_bounds is {bounds[0]!r}; robosuite's controller, which the file describes, has its own "
                "range. Leave action_bounds out; clip_actions=True brings actions into that range."
            )
        arm = arm_controller(env_args.get("env_kwargs", {}))
        if arm.get("input_type", "delta") != "delta" or arm.get("control_delta", True) is False:
            raise DatasetError(f"{source}: actions are absolute poses; only files with a delta controller are accepted.")
        low, high = -np.ones(n_actions, np.float32), np.ones(n_actions, np.float32)
        low[: n_actions - 1], high[: n_actions - 1] = arm.get("input_min", -1.0), arm.get("input_max", 1.0)
        return spaces.Box(low, high, dtype=np.float32)
