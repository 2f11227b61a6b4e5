"""Ends of the episodes that lie one after the other in flat arrays, and what tells of them."""

from collections.abc import Sequence
from numbers import Real
from typing import NamedTuple

import numpy as np

from sb3_dtfm.data.arrays import Arrays
from sb3_dtfm.data.trajectories import DatasetError, check_flags
from sb3_dtfm.files import warn

# Names of each array in other libraries' files: the first that is there is read.
ENDS, LENGTHS = "episode_ends", "episode_lengths"
TERMINATIONS = ("terminations", "terminals", "terminated", "terminal")
TRUNCATIONS = ("truncations", "timeouts", "truncated", "timeout")
# Ends of either kind, as SB3 has them.
DONES = ("dones", "done")
# The number, or the name, of each step's episode.
EPISODES = ("episode", "episode_id", "episode_ids", "episode_index")


class Ends(NamedTuple):
    """
    Ends of the episodes.

    :param stops: (E,) int64, ascending: steps of the file at which each has ended, the last one N
    :param terminated: (N,) bool
    :param truncated: (N,) bool
    """

    stops: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray


def read_ends(arrays: Arrays, n_steps: int, max_episode_steps: int | None) -> Ends:
    """
    Find where episodes end, and how.

    :param arrays: arrays of the file
    :param n_steps: N
    :param max_episode_steps: time limit of the environment, steps, after which episodes are cut where terminations alone
        tell of ends; None cuts none
    :raises DatasetError: nothing tells of ends, or no such ends are possible
    """
    terminated, truncated, done = (_flags(arrays, names, n_steps) for names in (TERMINATIONS, TRUNCATIONS, DONES))
    terminated |= done & ~truncated
    stops = _told(arrays, n_steps)
    if stops is None:
        ended = terminated | truncated
        if not ended.any():
            accepted = ", ".join((ENDS, LENGTHS, EPISODES[0], *TERMINATIONS, *TRUNCATIONS, *DONES))
            raise DatasetError(f"{arrays.source}: does not say where episodes end; one of {accepted} is needed.")
        stops = np.flatnonzero(ended) + 1
        if stops[-1] != n_steps:  # the last recording stopped mid-episode
            stops = np.append(stops, n_steps)
        if not arrays.has((*TRUNCATIONS, *DONES)):
            stops = _cut(stops, max_episode_steps, arrays)
    else:
        _warn_of_inner_ends(terminated | truncated, stops, arrays)
    if max_episode_steps is not None and not arrays.has(TRUNCATIONS):
        late = stops[np.diff(stops, prepend=0) == max_episode_steps] - 1
        terminated[late] &= arrays.has(TERMINATIONS)
        truncated[late] = ~terminated[late]
    return Ends(stops, terminated, truncated)


def _warn_of_inner_ends(ended: np.ndarray, stops: np.ndarray, arrays: Arrays) -> None:
    """Say that steps inside an episode are flagged as its end, which other arrays contradict."""
    inner = ended.copy()
    inner[stops - 1] = False
    if inner.any():
        first = int(np.argmax(inner))
        episode = int(np.searchsorted(stops, first, side="right"))
        step = first - (stops[episode - 1] if episode else 0)
        flags = " or ".join(arrays.name(names) for names in (TERMINATIONS, TRUNCATIONS, DONES) if arrays.has(names))
        borders = next(arrays.name(names) for names in ((ENDS,), (LENGTHS,), EPISODES) if arrays.has(names))
        warn(
            f"{arrays.source}: {flags}: {inner.sum()} steps inside episodes are flagged as ends, first step {step} of "
            f"episode {episode}. Episodes end where {borders} says; leave {borders} out if they end earlier.",
            stacklevel=2,
        )


def _cut(stops: np.ndarray, max_episode_steps: int | None, arrays: Arrays) -> np.ndarray:
    """Ends of episodes that only terminations mark: cut after `max_episode_steps`, else joined where time ran out."""
    told = f"{arrays.source}: {arrays.name(TERMINATIONS)} tell of terminal states, and nothing tells of time-outs"
    if max_episode_steps is None:
        warn(
            f"{told}: an episode that ran out of time is joined to the next one. max_episode_steps=... cuts there, and "
            f"{ENDS}, {EPISODES[0]} or {TRUNCATIONS[1]} would tell.",
            stacklevel=2,
        )
        return stops
    starts = np.concatenate(([0], stops[:-1]))
    pieces = [np.append(np.arange(start + max_episode_steps, stop, max_episode_steps), stop) for start, stop in
              zip(starts, stops, strict=True)]  # fmt: skip
    longer = sum(len(piece) > 1 for piece in pieces)
    if longer:
        warn(
            f"{told}: {longer} episodes of more than max_episode_steps={max_episode_steps} are cut after as many steps.",
            stacklevel=2,
        )
    return np.concatenate(pieces)


def _told(arrays: Arrays, n_steps: int) -> np.ndarray | None:
    """Ends of episodes, as in :class:`Ends`, where something tells of all of them."""
    told = [_told_stops(arrays, name, n_steps) for name in (ENDS, LENGTHS) if arrays.has((name,))]
    if len(told) == 2 and not np.array_equal(told[0], told[1]):
        raise DatasetError(f"{arrays.source}: {ENDS} and {LENGTHS} tell of other episodes; one of them is enough.")
    return told[0] if told else _numbered(arrays, n_steps) if arrays.has(EPISODES) else None


def _told_stops(arrays: Arrays, name: str, n_steps: int) -> np.ndarray:
    """Return what :func:`_told` does, from the array of this name."""
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


def _numbered(arrays: Arrays, n_steps: int) -> np.ndarray:
    """Return what :func:`_told` does, from the number or name of each step's episode."""
    name = arrays.name(EPISODES)
    numbers = np.asarray(arrays.stored(name)).reshape(-1)
    if numbers.shape != (n_steps,):
        raise DatasetError(f"{arrays.source}: {name} has {len(numbers)} entries; actions have {n_steps} steps.")
    if not _all_given(numbers):
        raise DatasetError(f"{arrays.source}: {name} is not given at each step; a number or a name is expected.")
    changes = np.flatnonzero(numbers[1:] != numbers[:-1]) + 1
    starts, counts = np.unique(numbers[np.append(0, changes)].astype(str), return_counts=True)
    if (counts > 1).any():
        again = starts[counts > 1][0]
        raise DatasetError(
            f"{arrays.source}: {name} {again} comes in several places; the steps of an episode have to lie side by side, as "
            "after a stable sort."
        )
    return np.append(changes, n_steps)


def _all_given(numbers: np.ndarray) -> bool:
    """Return whether an episode is numbered or named at each step."""
    kind = numbers.dtype.kind
    if kind == "O":
        return all(
            isinstance(each, str | bytes | Real) and each not in ("", b"") and each == each for each in numbers.tolist()
        )
    return bool(np.isfinite(numbers).all()) if kind == "f" else kind != "U" or bool((numbers != "").all())


def _flags(arrays: Arrays, names: Sequence[str], n_steps: int) -> np.ndarray:
    """(N,) bool, all False where there is no such array."""
    if not arrays.has(names):
        return np.zeros(n_steps, bool)
    return check_flags(arrays.read(names), n_steps, f"{arrays.source}: {arrays.name(names)}")


def told_flags(flags: np.ndarray, n: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """
    :param flags: (N,) zeros, ones, and NaN where nothing is told
    :param n: N
    :param where: the file and the array, for messages
    :return: (N,) bool each: the flags, and where they are NaN
    :raises DatasetError: as :func:`~sb3_dtfm.data.trajectories.check_flags`
    """
    silent = np.isnan(flags) if flags.dtype.kind == "f" else np.zeros(flags.shape, bool)
    told = check_flags(np.where(silent, 0, flags), n, where)
    return told, silent.reshape(told.shape)
