"""Reading flat arrays in one `.npz` file into a `TrajectoryBuffer`."""

import math
import os
import zipfile
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory, check_flags, check_real, check_size, naming

SUFFIX = ".npz"
EXPECTED = "the path of a file of flat arrays (.npz)"
# What others call the same array: the first that is there is read.
OBSERVATIONS = ("observations", "observation", "obs", "states", "state")
ACTIONS = ("actions", "action")
REWARDS = ("rewards", "reward")
ENDS, LENGTHS = "episode_ends", "episode_lengths"
TERMINATIONS = ("terminations", "terminals", "terminated")
TRUNCATIONS = ("truncations", "timeouts", "truncated")


def is_npz(dataset: Any) -> bool:
    """Whether this is the path of such a file, by its name."""
    return isinstance(dataset, str | os.PathLike) and os.fspath(dataset).endswith(SUFFIX)


def fingerprint_npz(path: str | os.PathLike[str], options: dict[str, Any]) -> Fingerprint:
    """
    Of a file as it is now.

    :param path: the file
    :param options: of :func:`load_npz`
    :raises DatasetError: no such file
    """
    path = existing_file(path, EXPECTED)
    if "action_bounds" in options:  # arrays become lists, as JSON can hold them
        options = {**options, "action_bounds": [np.asarray(bound).tolist() for bound in options["action_bounds"]]}
    return Fingerprint.of(path.name, path, options)


def load_npz(
    path: str | os.PathLike[str],
    observation_keys: Sequence[str] | None = None,
    action_bounds: Sequence[Any] = (-1.0, 1.0),
    clip_actions: bool = False,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    Episodes one after the other in flat arrays of N steps, as `numpy.savez` writes them.

    Read are `observations` (N, O), `actions` (N, A) and `rewards` (N,), or what others call them (`obs`, `state`, `action`,
    `reward`). Episodes end where `episode_ends` says (E,), counting steps from the start of the file, or after
    `episode_lengths` (E,) each, or at the steps of `terminals` or `timeouts` (N,). Without rewards every episode counts as a
    success: a reward of 1 at its last step. Nothing in the file is ever executed: arrays of Python objects are refused. The
    file is read into memory, also to write a cache of it.

    :param path: the file
    :param observation_keys: which arrays make up the observation, in this order, each (N, ...)
    :param action_bounds: smallest and largest action that the environment accepts, numbers or (A,) each
    :param clip_actions: bring actions outside of them to the nearest bound, however far, instead of refusing them
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: where the steps go, memory if not given
    :raises DatasetError: no such file, damaged, arrays missing or of lengths that do not fit together, NaN or infinity, or
        actions out of bounds; names the file, the array, the episode and the step
    """
    path = existing_file(path, EXPECTED)
    source = str(path)
    with naming(source), zipfile.ZipFile(path) as archive:
        arrays = _Arrays(archive, source)
        return _read(arrays, source, observation_keys, action_bounds, clip_actions, on_invalid, storage)


class _Arrays:
    """
    The arrays of a file, none of which is read before its header has been looked at.

    :param archive: the opened file
    :param source: what it is called, for messages
    """

    def __init__(self, archive: zipfile.ZipFile, source: str) -> None:
        self.source = source
        self.n_stored = os.path.getsize(source)
        self._archive = archive
        self._members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}

    def has(self, names: Sequence[str]) -> bool:
        """Whether there is one of these."""
        return any(name in self._members for name in names)

    def name(self, names: Sequence[str]) -> str:
        """The first of the names that is there."""
        for name in names:
            if name in self._members:
                return name
        accepted = names[0] if len(names) == 1 else f"one of {', '.join(names)}"
        found = ", ".join(sorted(self._members)) or "nothing"
        raise DatasetError(f"{self.source}: has no array {accepted}, only {found}.")

    def read(self, names: Sequence[str], n_steps: int | None = None) -> np.ndarray:
        """The first of the named arrays that is there: numbers, one entry a step."""
        name = self.name(names)
        where = f"{self.source}: {name}"
        with naming(where):
            self._check_header(self._members[name], where)
            with self._archive.open(self._members[name]) as stream:
                array = np.lib.format.read_array(stream, allow_pickle=False)
        if n_steps is not None and array.shape[:1] != (n_steps,):
            raise DatasetError(f"{where} has shape {array.shape} and actions have {n_steps} steps.")
        return array

    def _check_header(self, member: zipfile.ZipInfo, where: str) -> None:
        """Refuse what an array claims to be before memory is taken for it."""
        with self._archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read_header(stream)
            n_left = member.file_size - stream.tell()
        check_real(dtype, where)
        n_bytes = math.prod(shape) * dtype.itemsize
        if n_bytes != n_left:
            raise DatasetError(f"{where} has shape {shape}, which takes {n_bytes} bytes; there are {n_left}.")
        check_size(n_bytes, self.n_stored, where)


def _read(
    arrays: _Arrays,
    source: str,
    observation_keys: Sequence[str] | None,
    action_bounds: Sequence[Any],
    clip_actions: bool,
    on_invalid: str,
    storage: FileStorage | None,
) -> TrajectoryBuffer:
    actions = arrays.read(ACTIONS)
    if actions.ndim != 2 or not len(actions):
        raise DatasetError(f"{source}: actions have shape {actions.shape}; (N, A) is expected, for at least one step.")
    n_steps = len(actions)
    keys = observation_keys or (arrays.name(OBSERVATIONS),)
    observations = [arrays.read((key,), n_steps).reshape(n_steps, -1) for key in keys]
    observation = observations[0] if len(observations) == 1 else np.concatenate(observations, axis=1)
    terminated, truncated = (_flags(arrays, names, n_steps) for names in (TERMINATIONS, TRUNCATIONS))
    stops = _stops(arrays, n_steps, terminated | truncated)
    has_rewards = arrays.has(REWARDS)
    rewards = arrays.read(REWARDS, n_steps).reshape(n_steps, -1) if has_rewards else np.zeros((n_steps, 1))
    if rewards.shape[1] != 1:
        raise DatasetError(f"{source}: rewards have {rewards.shape[1]} columns; one number a step is expected.")
    if not has_rewards:
        rewards[stops - 1] = 1.0
        terminated[stops - 1] = True
    action_space = _action_space(action_bounds, actions.shape[1], source)
    if clip_actions:
        actions = np.where(np.isfinite(actions), np.clip(actions, action_space.low, action_space.high), actions)

    def trajectory(episode: int) -> Trajectory:
        start, stop = stops[episode - 1] if episode else 0, stops[episode]
        return Trajectory(
            observations=observation[start:stop],
            actions=actions[start:stop],
            rewards=rewards[start:stop, 0],
            terminated=bool(terminated[stop - 1]),
            truncated=bool(truncated[stop - 1]),
            name=f"episode {episode}",
        )

    return TrajectoryBuffer.from_trajectories(
        map(trajectory, range(len(stops))),
        action_space,
        n_steps=n_steps,
        source=source,
        storage=storage,
        on_invalid=on_invalid,
        n_stored=arrays.n_stored,
    )


def _flags(arrays: _Arrays, names: Sequence[str], n_steps: int) -> np.ndarray:
    """(N,) bool, all False where there is no such array."""
    if not arrays.has(names):
        return np.zeros(n_steps, bool)
    return check_flags(arrays.read(names), n_steps, f"{arrays.source}: {arrays.name(names)}")


def _stops(arrays: _Arrays, n_steps: int, ended: np.ndarray) -> np.ndarray:
    """Steps of the file at which each episode has ended, (E,) int64, ascending, the last one N."""
    told = [_told_stops(arrays, name, n_steps) for name in (ENDS, LENGTHS) if arrays.has((name,))]
    if len(told) == 2 and not np.array_equal(told[0], told[1]):
        raise DatasetError(f"{arrays.source}: {ENDS} and {LENGTHS} tell of other episodes; one of them is enough.")
    if told:
        return told[0]
    if ended.any():
        stops = np.flatnonzero(ended) + 1
        return stops if stops[-1] == n_steps else np.append(stops, n_steps)  # the last recording stopped mid-episode
    accepted = ", ".join((ENDS, LENGTHS, *TERMINATIONS, *TRUNCATIONS))
    raise DatasetError(f"{arrays.source}: does not say where episodes end; one of {accepted} is needed.")


def _told_stops(arrays: _Arrays, name: str, n_steps: int) -> np.ndarray:
    """As :func:`_stops`, from the array of this name."""
    array = arrays.read((name,))
    with np.errstate(invalid="ignore"):
        numbers = array.reshape(-1).astype(np.int64)
    if array.shape[:1] != (array.size,) or not (numbers == array.reshape(-1)).all():
        raise DatasetError(
            f"{arrays.source}: {name} holds {array.dtype} of shape {array.shape}; whole numbers (E,) are expected."
        )
    lengths = np.diff(numbers, prepend=0) if name == ENDS else numbers
    unfit = (lengths <= 0) | (lengths > n_steps)
    if unfit.any() or lengths.sum() != n_steps:
        first = np.flatnonzero(unfit)[:1]
        found = f"{lengths[first[0]]} steps in episode {first[0]}" if len(first) else f"{lengths.sum()} steps in all"
        raise DatasetError(
            f"{arrays.source}: {name} tells of {found}; actions have {n_steps}, and each episode has at least one."
        )
    return np.cumsum(lengths)


def _action_space(bounds: Sequence[Any], n_actions: int, source: str) -> spaces.Box:
    try:
        low, high = (np.broadcast_to(np.asarray(bound, np.float32), (n_actions,)) for bound in bounds)
        return spaces.Box(low, high, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise DatasetError(
            f"{source}: action_bounds is {bounds!r}; smallest and largest action are expected, numbers or {n_actions} each."
        ) from error
