"""Steps one by one, as people collect them: what counts as a step, and what its parts are."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_dtfm.data.ends import DONES, TERMINATIONS, TRUNCATIONS
from sb3_dtfm.data.flat import ACTIONS, OBSERVATIONS, REWARDS, holds_episodes
from sb3_dtfm.data.observations import stacked
from sb3_dtfm.data.trajectories import DatasetError
from sb3_dtfm.envs.success import reported_success

# Parts of a step in an episode that was written down step by step, in order. The next observation may be there, too,
# before the reward or behind it.
STEP = ("observation", "action", "reward", "terminated", "truncated")
SHORT_STEP = ("observation", "action", "reward", "done")
INFO = ("info", "infos")
PARTS = (REWARDS, ACTIONS, OBSERVATIONS)


def is_episodes(dataset: Any) -> bool:
    """Return whether this is a list, or another sequence, of episodes."""
    return isinstance(dataset, Sequence) and not isinstance(dataset, str | bytes | os.PathLike)


def is_steps(dataset: Any) -> bool:
    """Return whether this is a list of steps, of one or of several episodes."""
    if not is_episodes(dataset) or not len(dataset) or not is_step(dataset[0]):
        return False
    return not (isinstance(dataset[0], Mapping) and holds_episodes(dataset[0]))


def is_step(found: Any) -> bool:
    """Return whether this is one step: its reward is a number, or without a reward its action and observation are single."""
    found = _by_name(found)
    if isinstance(found, Mapping):
        reward, action, observation = (next((found[name] for name in names if name in found), None) for names in PARTS)
        if reward is not None:
            return _n_axes(reward) == 0
        if action is None or _n_axes(action) != 1:
            return action is not None and _n_axes(action) == 0
        ends_itself = any(_n_axes(found[name]) == 0 for name in DONES if name in found)
        return _is_single(observation, None if ends_itself else len(action))
    if not is_episodes(found) or not len(found):
        return False
    parts = _parts(found)
    return len(parts) >= len(SHORT_STEP) and not isinstance(parts[-1], Mapping | Sequence) and np.size(parts[-1]) == 1


def _is_single(observation: Any, n_actions: int | None) -> bool:
    """
    Return whether this is an observation of one step, and not one number for each of so many steps.

    :param observation: a vector, an image, or a dictionary of such and of numbers
    :param n_actions: numbers of the action, or steps; None if something else tells that it is one step
    """
    if isinstance(observation, Mapping):
        parts = observation.values()
        told = any(_n_axes(part) != 1 or len(part) != n_actions for part in parts)
        return told and all(_n_axes(part) == 0 or _is_single(part, n_actions) for part in parts)
    return _n_axes(observation) == (3 if getattr(observation, "dtype", None) == np.uint8 else 1)


def _n_axes(found: Any) -> int:
    """Count the axes of an array or of nested lists; lists of different lengths count as a whole episode."""
    shape = _shape(found)
    return 2 if shape is None else len(shape)


def _shape(found: Any) -> tuple[int, ...] | None:
    """Return the shape of an array or of nested lists; None for lists of different lengths."""
    try:
        return np.shape(found)
    except ValueError:
        return None


def _parts(step: Sequence[Any]) -> list[Any]:
    """Return what a step begins with, without its info, and without what comes after the flags."""
    n_first, n_most = len(SHORT_STEP), len(STEP) + 1
    parts = [*step[:n_first], *(part for part in step[n_first:] if not isinstance(part, Mapping))][:n_most]
    return parts[:-1] if len(parts) == n_most and (isinstance(parts[-1], Sequence) or np.size(parts[-1]) != 1) else parts


def arrays_of_steps(steps: Sequence[Any], where: str) -> dict[str, Any]:
    """Arrays by the names of flat ones; of infos only their success, and whether time ran out."""
    steps = [_by_name(step) for step in steps]
    rows = steps if isinstance(steps[0], Mapping) else [_named(step) for step in steps]
    arrays: dict[str, Any] = {}
    for name in rows[0]:
        missing = next((number for number, row in enumerate(rows) if name not in row), None)
        if missing is not None:
            raise DatasetError(f"{where}: step {missing} has no {name!r}, which step 0 has.")
        parts = [row[name] for row in rows]
        arrays[name] = _stacked(parts, f"{where}: {name}") if name in OBSERVATIONS else parts
    infos = next((arrays.pop(name) for name in INFO if name in arrays), None)
    if infos is not None and all(isinstance(info, Mapping) for info in infos):
        reported = [reported_success(info) for info in infos]
        if any(success is not None for success in reported):
            arrays["success"] = [np.nan if success is None else float(success) for success in reported]
        if any("TimeLimit.truncated" in info for info in infos) and not set(TRUNCATIONS) & set(arrays):
            arrays[TRUNCATIONS[0]] = [bool(info.get("TimeLimit.truncated", False)) for info in infos]
    return arrays


def _by_name(step: Any) -> Any:
    """A named tuple as the dictionary of its parts, if all that is needed has known names; anything else as it is."""
    fields = set(getattr(step, "_fields", ()))
    known = {*OBSERVATIONS, *ACTIONS, *REWARDS, *TERMINATIONS, *TRUNCATIONS, *DONES, *INFO}
    unknown = [name for name in fields - known if not name.startswith("next")]
    return step._asdict() if not unknown and all(fields & set(names) for names in PARTS) else step


def _named(step: Sequence[Any]) -> dict[str, Any]:
    """A step's parts by their names, without the next observation."""
    infos = [part for part in step[len(SHORT_STEP) :] if isinstance(part, Mapping)]
    parts = _parts(step)
    if len(parts) > len(SHORT_STEP) and (place := _next_observation(parts)):
        del parts[place]
    names = STEP if len(parts) >= len(STEP) else SHORT_STEP
    return {**dict(zip(names, parts, strict=False)), **({INFO[0]: infos[0]} if infos else {})}


def _next_observation(parts: Sequence[Any]) -> int | None:
    """Return where the next observation is: behind the action as SB3 has it, behind the reward, or nowhere."""
    observation, _, third, fourth, fifth = parts[:5]
    if isinstance(observation, Mapping | tuple):
        return next((place for place in (2, 3) if isinstance(parts[place], Mapping | tuple)), None)
    # If observations are numbers, only the types tell a reward and a flag from two flags.
    told_apart = _n_axes(observation) > 0 or type(fourth) is not type(fifth)
    if _shape(third) == _shape(observation) and not isinstance(fourth, bool | np.bool_) and told_apart:
        return 2
    if not _n_axes(observation) > _n_axes(third) == 0 or _shape(fourth) != _shape(observation):
        return None
    two_flags = _shape(fifth) == _shape(fourth) and np.asarray(fifth).dtype == np.asarray(fourth).dtype
    return None if two_flags else 3


def _stacked(observations: Sequence[Any], where: str) -> Any:
    """One observation after the other as (T, ...), dictionaries as a dictionary of such, tuples by the places of parts."""
    first = observations[0]
    if isinstance(first, Mapping):
        return {key: _stacked([observation[key] for observation in observations], f"{where}, {key}") for key in first}
    if isinstance(first, tuple) and any(isinstance(part, Mapping | tuple) or np.ndim(part) for part in first):
        parts = zip(*observations, strict=True)
        return {place: _stacked(part, f"{where}, {place}") for place, part in enumerate(parts)}
    return stacked(observations, where)
