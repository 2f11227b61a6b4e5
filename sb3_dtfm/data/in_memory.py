"""Reading what is already in memory into a `TrajectoryBuffer`: lists of episodes, and SB3's replay buffers."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_dtfm.actions import ActionSpace, unscaled
from sb3_dtfm.data.arrays import NUMBERS_EXPECTED
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.ends import DONES, TERMINATIONS, TRUNCATIONS, told_flags
from sb3_dtfm.data.flat import (
    ACTIONS,
    OBSERVATIONS,
    REWARDS,
    SUCCESSES,
    bounded_space,
    check_shape,
    explain_range,
    fitted,
    load_flat,
    warn_of_made_up_rewards,
)
from sb3_dtfm.data.observations import chosen_space, observed
from sb3_dtfm.data.steps import SHORT_STEP, STEP, arrays_of_steps, is_episodes, is_step
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, Trajectory, check_action_space, wrap_dataset_errors
from sb3_dtfm.envs.success import reported_success
from sb3_dtfm.files import warn

# Rows of a replay buffer that are compared at once: images of all would take its memory twice more.
BLOCK = 1000


def load_steps(
    steps: Sequence[Any],
    observation_keys: Sequence[str] | None = None,
    action_keys: Sequence[str] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    observation_space: spaces.Space | None = None,
    max_episode_steps: int | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    Steps of all episodes in one list, as :func:`load_episodes` takes those of each; flags or numbers tell of the ends.

    :param steps: dictionaries, with the names of :func:`~sb3_dtfm.data.load_flat`, or tuples; the other arguments are those
        of :func:`~sb3_dtfm.data.load_flat`
    :raises DatasetError: as :func:`~sb3_dtfm.data.load_flat`
    """
    with wrap_dataset_errors("steps", NUMBERS_EXPECTED):
        arrays = arrays_of_steps(steps, "steps")
    return load_flat(
        arrays, observation_keys, action_keys, action_bounds, clip_actions, action_space, observation_space,
        max_episode_steps, on_invalid, storage,
    )  # fmt: skip


def load_episodes(
    episodes: Sequence[Any],
    observation_keys: Sequence[str] | None = None,
    action_bounds: Sequence[Any] | None = None,
    clip_actions: bool = False,
    action_space: ActionSpace | None = None,
    observation_space: spaces.Space | None = None,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    Episodes one by one, each of which may be

    - a dictionary of `observations` (T, O) or (T + 1, O), `actions` (T, A), or (T,) of a Discrete space, `rewards` (T,), and
      `terminated`, `truncated` and `success`, for the episode or for each step, or what others call them; observations may
      be dictionaries, too
    - a :class:`~sb3_dtfm.data.Trajectory`
    - a trajectory of the package imitation: `obs`, `acts`, `terminal`, `rews` where it has some
    - a list of steps `(observation, action, reward, terminated, truncated)`, as they come from a Gymnasium environment:
      the observation that the action was chosen on, and what `env.step(action)` then returned, with or without the info,
      which may tell of success; or of `(observation, action, reward, done)`; with the next observation, too, before the
      reward as SB3 has it, or behind it; or of dictionaries or named tuples of these

    Without rewards a success has a reward of 1 at its last step, and an episode of unknown success counts as one.

    :param episodes: list of episodes, at least one
    :param observation_keys: names of the arrays, or entries of dictionary observations, that make up the observation, in
        this order
    :param action_bounds: see :func:`~sb3_dtfm.data.load_flat`
    :param clip_actions: see :func:`~sb3_dtfm.data.load_flat`
    :param action_space: see :func:`~sb3_dtfm.data.load_flat`
    :param observation_space: see :func:`~sb3_dtfm.data.load_flat`
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :raises DatasetError: nothing of the above, arrays missing or of lengths that do not fit together, NaN or infinity, or
        actions out of bounds; names the episode and the step
    """
    source = "episodes"
    unrewarded: dict[int, set[str]] = {}
    read = partial(
        _trajectory, source=source, keys=observation_keys, observation_space=observation_space, unrewarded=unrewarded
    )
    actions = _some_actions(episodes, action_space, read, source, on_invalid)
    space = bounded_space(action_bounds, action_space, actions, source)

    def trajectory(number: int) -> Trajectory:
        found = read(episodes[number], number)
        return replace(found, actions=fitted(found.actions, space, clip_actions))

    numbers = range(len(episodes))
    with explain_range(space, action_bounds, action_space):
        buffer = TrajectoryBuffer.from_trajectories(
            map(trajectory, numbers), space, source=source, storage=storage, on_invalid=on_invalid
        )
    if unrewarded:
        number, names = next(iter(unrewarded.items()))
        n_others = len(unrewarded) - 1
        some = f", episode {number}" + (f" and {n_others} more" if n_others else "")
        warn_of_made_up_rewards(
            names - set(observation_keys or ()), source if len(unrewarded) == len(episodes) else f"{source}{some}"
        )
    return buffer


def _some_actions(
    episodes: Sequence[Any],
    action_space: ActionSpace | None,
    read: Callable[[Any, int], Trajectory],
    source: str,
    on_invalid: str,
) -> np.ndarray:
    """The actions of the first episode, or the first that can be kept."""
    for number, episode in enumerate(episodes):
        try:
            actions = read(episode, number).actions
            check_shape(actions, action_space, f"{source}, episode {number}")
            return actions
        except DatasetError:
            if on_invalid != "drop" or number == len(episodes) - 1:
                raise
    raise DatasetError(f"{source}: the list is empty; at least one episode is needed.")


def _trajectory(
    episode: Any,
    number: int,
    source: str,
    keys: Sequence[str] | None,
    observation_space: spaces.Space | None,
    unrewarded: dict[int, set[str]],
) -> Trajectory:
    """An episode of any of the kinds of :func:`load_episodes`; without rewards its names are kept in `unrewarded`."""
    name = f"episode {number}"
    where = f"{source}, {name}"
    if isinstance(episode, Trajectory):
        return episode
    with wrap_dataset_errors(where, NUMBERS_EXPECTED):
        arrays = _arrays_of_episode(episode, where)
        if not any(key in arrays for key in REWARDS):
            unrewarded[number] = set(map(str, arrays))
        return _of_arrays(arrays, keys, observation_space, name, where)


def _arrays_of_episode(episode: Any, where: str) -> Mapping[str, Any]:
    """An episode's arrays by the names of flat ones."""
    if isinstance(episode, Mapping):
        return episode
    if hasattr(episode, "obs") and hasattr(episode, "acts"):
        ended = bool(episode.terminal)
        infos = getattr(episode, "infos", None)
        info = {} if infos is None else infos[-1]
        late = ended and bool(info.get("TimeLimit.truncated", False))
        arrays = {"obs": episode.obs, "acts": episode.acts, "terminated": ended and not late, "truncated": late}
        arrays["success"] = reported_success(info)
        return {**arrays, **({"rews": episode.rews} if hasattr(episode, "rews") else {})}
    if is_episodes(episode) and len(episode) and all(is_step(step) for step in episode):
        return arrays_of_steps(episode, where)
    steps = " or ".join(f"({', '.join(names)})" for names in (STEP, SHORT_STEP))
    raise DatasetError(
        f"{where} is a {type(episode).__name__}; accepted are a dictionary of arrays, a Trajectory, a trajectory of "
        f"imitation, or a list of steps {steps}, with the next observation before or behind the reward."
    )


def _of_arrays(
    arrays: Mapping[str, Any], keys: Sequence[str] | None, space: spaces.Space | None, name: str, where: str
) -> Trajectory:
    """One episode of arrays by the names of flat ones."""

    def find(names: Sequence[str]) -> Any:
        found = [key for key in names if key in arrays]
        if not found:
            there = ", ".join(map(str, arrays)) or "nothing"
            raise DatasetError(f"{where}: has no array called one of {', '.join(names)}, only {there}.")
        return arrays[found[0]]

    def flag(names: Sequence[str]) -> bool:
        given = [np.asarray(arrays[key]).reshape(-1) for key in names if key in arrays]
        if given and given[0][:-1].any():
            step = int(np.argmax(given[0]))
            raise DatasetError(
                f"{where}: ends at step {step} of {len(given[0])}; arrays of several episodes need no list, "
                "or stand in one as {'dataset': arrays}."
            )
        return bool(given[0][-1]) if given else False

    actions = np.asarray(find(ACTIONS))
    n_steps = len(actions) if actions.ndim else 0
    entries = arrays if keys is not None and all(key in arrays for key in keys) else find(OBSERVATIONS)
    seen = observed(entries, keys, space, f"{where}: observations")
    if len(seen.vectors) == n_steps + 1:  # the last one, after which nobody has acted
        seen = seen.first(n_steps)
    has_rewards = any(key in arrays for key in REWARDS)
    success = _success(arrays, n_steps, where)
    rewards = np.asarray(find(REWARDS)) if has_rewards else (success is not False) * np.eye(1, n_steps, n_steps - 1)[0]
    terminated, truncated, done = flag(TERMINATIONS), flag(TRUNCATIONS), flag(DONES)
    terminated = terminated or (done and not truncated)
    return Trajectory(
        observations=seen.vectors,
        images=seen.images,
        actions=actions,
        rewards=rewards.reshape(n_steps) if rewards.size == n_steps else rewards,
        terminated=terminated or not (has_rewards or truncated or success is False),
        truncated=truncated,
        success=success,
        name=name,
    )


def _success(arrays: Mapping[str, Any], n_steps: int, where: str) -> bool | None:
    """Return what an episode's arrays say of its success."""
    name = next((key for key in SUCCESSES if arrays.get(key) is not None), None)
    if name is None:
        return None
    flags = np.asarray(arrays[name])
    flags = flags.reshape(1) if flags.size == 1 else flags
    told, silent = told_flags(flags, 1 if len(flags) == 1 else n_steps, f"{where}: {name}")
    return None if silent[-1] else bool(told[-1])


def is_replay_buffer(dataset: Any) -> bool:
    """Return whether this is one of SB3's replay buffers, `DictReplayBuffer` and the like included."""
    return isinstance(dataset, ReplayBuffer)


def _breaks(replay_buffer: ReplayBuffer, order: np.ndarray) -> np.ndarray:
    """
    Find breaks between steps: a second `learn()` begins with a reset, which no flag tells of.

    :param order: (T,) rows of the buffer, oldest first
    :return: (T - 1, environments) bool, True where a step does not go on to the next one
    """
    breaks = np.zeros((max(0, len(order) - 1), replay_buffer.n_envs), bool)
    if replay_buffer.optimize_memory_usage:  # one array holds both, and SB3 marks such a step itself
        return breaks
    before: Any = replay_buffer.observations
    after: Any = replay_buffer.next_observations
    for key in before if isinstance(before, dict) else (...,):
        for start in range(0, len(breaks), BLOCK):
            rows = slice(start, start + BLOCK)
            came, seen = after[key][order[:-1][rows]], before[key][order[1:][rows]]
            breaks[rows] |= (came != seen).any(axis=tuple(range(2, seen.ndim)))
    return breaks


def load_replay_buffer(
    replay_buffer: ReplayBuffer,
    observation_keys: Sequence[str] | None = None,
    clip_actions: bool = False,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    The episodes of a replay buffer, such as `model.replay_buffer` of an SB3 model, environment by environment.

    SB3's algorithms store actions of a Box scaled to [-1, 1]; they are brought back into the buffer's action space.
    Observations and rewards are there as the environment gave them, `VecNormalize` or not. An episode at whose end
    `TimeLimit.truncated` was said is truncated. Unfinished episodes, which the buffer's end or a second `learn()` cut off,
    are left out if there are finished ones. The first episode of each environment in a full buffer is left out, since its
    beginning has been written over.

    :param replay_buffer: replay buffer of any number of environments
    :param observation_keys: names of the entries of dictionary observations that make up the observation, in this order
    :param clip_actions: bring actions outside of the action space to the nearest bound
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :raises DatasetError: no whole episode, an observation space that cannot be flattened, NaN or infinity, or actions
        outside of [-1, 1]; names the environment, the episode and the step
    """
    source = "replay buffer"
    shown = replay_buffer.observation_space
    flat_space = chosen_space(shown, observation_keys, source).flat
    space = check_action_space(replay_buffer.action_space, source)
    n_steps = replay_buffer.size()
    order = (np.arange(n_steps) + (replay_buffer.pos if replay_buffer.full else 0)) % max(1, replay_buffer.buffer_size)
    ends = replay_buffer.dones[order] > 0
    ends[:-1] |= _breaks(replay_buffer, order)
    ends[-1:] = True  # so far
    pieces: list[tuple[int, int, int]] = []
    unfinished: list[tuple[int, int, int]] = []
    for env in range(replay_buffer.n_envs):
        stops = np.flatnonzero(ends[:, env]) + 1
        starts = np.concatenate(([0], stops[:-1])) if len(stops) else stops
        for start, stop in list(zip(starts, stops, strict=True))[int(replay_buffer.full) :]:
            finished = replay_buffer.dones[order[stop - 1], env] > 0
            (pieces if finished else unfinished).append((env, start, stop))
    if unfinished:  # their returns are those of their first steps alone
        n_unfinished = sum(stop - start for _, start, stop in unfinished)
        fate = "are left out" if pieces else "are all that there is"
        warn(
            f"{source}: {len(unfinished)} unfinished episodes with {n_unfinished} steps {fate}; another learn(), or the "
            "buffer's end, cut them off.",
            stacklevel=3,
        )
    pieces = pieces or unfinished
    if not pieces:
        raise DatasetError(f"{source}: holds no whole episode in {n_steps} steps of {replay_buffer.n_envs} environments.")

    def trajectory(env: int, start: int, stop: int) -> Trajectory:
        name = f"environment {env}, steps {start} to {stop - 1}"
        steps = order[start:stop]
        done, late = (bool(flags[steps[-1], env]) for flags in (replay_buffer.dones, replay_buffer.timeouts))

        found: Any = replay_buffer.observations
        entries = {key: each[steps, env] for key, each in found.items()} if isinstance(found, dict) else found[steps, env]
        seen = observed(entries, observation_keys, shown, f"{source}, {name}")
        actions = replay_buffer.actions[steps, env]
        if isinstance(space, spaces.Box):
            actions = unscaled(actions.astype(np.float64), space.low, space.high)
        return Trajectory(
            observations=seen.vectors,
            images=seen.images,
            actions=fitted(actions, space, clip_actions),
            rewards=replay_buffer.rewards[steps, env],
            terminated=done and not late,
            truncated=done and late,
            name=name,
        )

    return TrajectoryBuffer.from_trajectories(
        itertools.starmap(trajectory, pieces),
        space,
        flat_space,
        n_steps=sum(stop - start for _, start, stop in pieces),
        source=source,
        storage=storage,
        on_invalid=on_invalid,
    )
