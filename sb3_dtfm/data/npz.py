"""Reading flat arrays in one `.npz` file into a `TrajectoryBuffer`."""

import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory

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
    :param storage: where the steps go, memory if not given
    :raises DatasetError: no such file, damaged, arrays missing or of lengths that do not fit together, NaN or infinity, or
        actions out of bounds; names the file, the array, the episode and the step
    """
    path = existing_file(path, EXPECTED)
    source = str(path)
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise DatasetError(f"{source}: holds a single array; {EXPECTED} is expected.")
        with file:
            return _read(file, source, observation_keys, action_bounds, clip_actions, storage)
    except DatasetError:
        raise
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise DatasetError(f"{source}: cannot be read ({error}); {EXPECTED} is expected.") from error


def _read(
    file: Mapping[str, np.ndarray],
    source: str,
    observation_keys: Sequence[str] | None,
    action_bounds: Sequence[Any],
    clip_actions: bool,
    storage: FileStorage | None,
) -> TrajectoryBuffer:
    actions = _array(file, source, ACTIONS)
    if actions.ndim != 2 or not len(actions):
        raise DatasetError(f"{source}: actions have shape {actions.shape}; (N, A) is expected, for at least one step.")
    n_steps = len(actions)
    keys = observation_keys or (_name(file, source, OBSERVATIONS),)
    observations = [_array(file, source, (key,), n_steps).reshape(n_steps, -1) for key in keys]
    observation = observations[0] if len(observations) == 1 else np.concatenate(observations, axis=1)
    terminated, truncated = (_flags(file, source, names, n_steps) for names in (TERMINATIONS, TRUNCATIONS))
    stops = _stops(file, source, n_steps, terminated | truncated)
    has_rewards = any(name in file for name in REWARDS)
    rewards = _array(file, source, REWARDS, n_steps).reshape(n_steps, -1) if has_rewards else np.zeros((n_steps, 1))
    if rewards.shape[1] != 1:
        raise DatasetError(f"{source}: rewards have {rewards.shape[1]} columns; one number a step is expected.")
    if not has_rewards:
        rewards[stops - 1] = 1.0
        terminated[stops - 1] = True
    action_space = _action_space(action_bounds, actions.shape[1], source)
    if clip_actions:
        actions = np.where(np.isfinite(actions), np.clip(actions, action_space.low, action_space.high), actions)

    def trajectories() -> Iterator[Trajectory]:
        for episode, (start, stop) in enumerate(zip((0, *stops[:-1]), stops, strict=True)):
            yield Trajectory(
                observations=observation[start:stop],
                actions=actions[start:stop],
                rewards=rewards[start:stop, 0],
                terminated=bool(terminated[stop - 1]),
                truncated=bool(truncated[stop - 1]),
                name=f"episode {episode}",
            )

    return TrajectoryBuffer.from_trajectories(trajectories(), action_space, n_steps=n_steps, source=source, storage=storage)


def _name(file: Mapping[str, np.ndarray], source: str, names: Sequence[str]) -> str:
    """The first of the names that the file has."""
    for name in names:
        if name in file:
            return name
    accepted = names[0] if len(names) == 1 else f"one of {', '.join(names)}"
    raise DatasetError(f"{source}: has no array {accepted}, only {', '.join(sorted(file)) or 'nothing'}.")


def _array(file: Mapping[str, np.ndarray], source: str, names: Sequence[str], n_steps: int | None = None) -> np.ndarray:
    """The first of the named arrays that is there: numbers, one entry a step."""
    name = _name(file, source, names)
    array = file[name]
    if array.dtype.kind not in "fiub":
        raise DatasetError(f"{source}: {name} holds {array.dtype}; numbers are expected.")
    if n_steps is not None and array.shape[:1] != (n_steps,):
        raise DatasetError(f"{source}: {name} has shape {array.shape} and actions have {n_steps} steps.")
    return array


def _flags(file: Mapping[str, np.ndarray], source: str, names: Sequence[str], n_steps: int) -> np.ndarray:
    """(N,) bool, all False where there is no such array."""
    if not any(name in file for name in names):
        return np.zeros(n_steps, bool)
    return _array(file, source, names, n_steps).reshape(n_steps).astype(bool)


def _stops(file: Mapping[str, np.ndarray], source: str, n_steps: int, ended: np.ndarray) -> np.ndarray:
    """Steps of the file at which each episode has ended, (E,), ascending, the last one N."""
    if ENDS in file:
        name, stops = ENDS, _array(file, source, (ENDS,)).reshape(-1)
    elif LENGTHS in file:
        name, stops = LENGTHS, np.cumsum(_array(file, source, (LENGTHS,)).reshape(-1))
    elif ended.any():
        stops = np.flatnonzero(ended) + 1
        return stops if stops[-1] == n_steps else np.append(stops, n_steps)  # the last recording stopped mid-episode
    else:
        accepted = ", ".join((ENDS, LENGTHS, *TERMINATIONS, *TRUNCATIONS))
        raise DatasetError(f"{source}: does not say where episodes end; one of {accepted} is needed.")
    lengths = np.diff(stops, prepend=0)
    if not len(stops) or (lengths <= 0).any() or stops[-1] != n_steps:
        found = f"{stops[-1] if len(stops) else 0} steps in all"
        if (lengths <= 0).any():
            found = f"{lengths.min()} steps in episode {lengths.argmin()}"
        raise DatasetError(f"{source}: {name} tells of {found}; actions have {n_steps}, and each episode has at least one.")
    return stops.astype(np.int64)


def _action_space(bounds: Sequence[Any], n_actions: int, source: str) -> spaces.Box:
    try:
        low, high = (np.broadcast_to(np.asarray(bound, np.float32), (n_actions,)) for bound in bounds)
        return spaces.Box(low, high, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise DatasetError(
            f"{source}: action_bounds is {bounds!r}; smallest and largest action are expected, numbers or {n_actions} each."
        ) from error
