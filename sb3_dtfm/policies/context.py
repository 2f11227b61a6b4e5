"""
The context that acting carries from step to step.

Pure functions: each returns new arrays and leaves its arguments alone, so a context can serve as SB3's `state`.
"""

import math
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np

from sb3_dtfm.windows import Windows

# Keys of an observation beside those of the environment.
COLUMNS = {"return_to_go": np.float32, "timestep": np.int64}
OBSERVATION_KEYS = ("observation", *COLUMNS)
# The largest time step, as in the wrapper's space.
LAST_TIMESTEP = np.iinfo(np.int32).max
# Rows that a message shows at most.
N_ROWS_SHOWN = 5


class Context(NamedTuple):
    """
    Windows of B environments, newest step last, padded on the left.

    Shapes: observations (B, K, O) as the environment gives them, actions (B, K, A) in [-1, 1], returns_to_go (B, K) in
    environment reward units, timesteps (B, K) int64, mask (B, K) bool, False on padded steps, episode_keys (B,) int64, a
    hash of the bytes of each episode's first observation, plan (B, P, A) in [-1, 1], actions chosen for the next steps,
    n_planned (B,) int64, how many of them are left, keys_values (B, ...), what the policy keeps of its earlier computation,
    (B, 0) if nothing.
    """

    observations: np.ndarray
    actions: np.ndarray
    returns_to_go: np.ndarray
    timesteps: np.ndarray
    mask: np.ndarray
    episode_keys: np.ndarray
    plan: np.ndarray
    n_planned: np.ndarray
    keys_values: np.ndarray

    def __repr__(self) -> str:
        n_rows, n_steps = self.mask.shape
        sizes = (f"{n} {what}{'s' if n != 1 else ''}" for n, what in ((n_rows, "row"), (n_steps, "step")))
        return f"Context({', '.join(sizes)})"

    @property
    def windows(self) -> Windows:
        """The windows alone."""
        return Windows(*(getattr(self, name) for name in Windows._fields))


def empty_context(n_rows: int, context_length: int, observation_dim: int, action_dim: int, plan_length: int = 0) -> Context:
    """A context in which no row has seen a step yet."""
    return Context(
        np.zeros((n_rows, context_length, observation_dim), np.float32),
        np.zeros((n_rows, context_length, action_dim), np.float32),
        np.zeros((n_rows, context_length), np.float32),
        np.zeros((n_rows, context_length), np.int64),
        np.zeros((n_rows, context_length), bool),
        np.zeros(n_rows, np.int64),
        np.zeros((n_rows, plan_length, action_dim), np.float32),
        np.zeros(n_rows, np.int64),
        np.zeros((n_rows, 0), np.float32),
    )


def check_context(state: Any, nothing: Context) -> Context:
    """
    The context that a caller passes back. Its plan, keys and values may come from another way of acting.

    :param state: state that an earlier call returned
    :param nothing: an empty context of the caller's environments
    :raises ValueError: no such state, or one of other environments
    """
    if not isinstance(state, tuple | list) or len(state) != len(nothing):
        found = f"a {type(state).__name__}" + (f" of {len(state)}" if isinstance(state, tuple | list) else "")
        raise ValueError(f"state must be what the last call returned, {len(nothing)} arrays; got {found}.")
    for name, array, expected in zip(Context._fields, state, nothing, strict=True):
        if not isinstance(array, np.ndarray) or array.dtype != expected.dtype:
            found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
            raise ValueError(f"state holds {name} of type {found}; an array of {expected.dtype} is expected.")
        free = name in ("plan", "keys_values") and array.shape[:1] == expected.shape[:1]
        if array.shape != expected.shape and not free:
            raise ValueError(f"state holds {name} of shape {array.shape}; {expected.shape} is expected.")
    return Context(*state)


def check_episode_start(episode_start: Any, n_rows: int) -> np.ndarray:
    """
    :return: (B,) bool, or (1,) for all rows alike
    :raises ValueError: neither one value for each row nor one for all
    """
    starts = np.asarray(episode_start, dtype=bool).reshape(-1)
    if len(starts) not in (1, n_rows):
        raise ValueError(f"episode_start has shape {np.shape(episode_start)}; ({n_rows},) is expected.")
    return starts


def restarts(context: Context, timestep: np.ndarray, episode_start: np.ndarray | None = None) -> np.ndarray:
    """
    Return where a new step begins a context of its own: at the start of an episode, and where it follows nothing.

    :param timestep: (B,) int64
    :param episode_start: (B,) bool, True where the caller starts an episode
    :return: (B,) bool
    """
    follows = context.mask[:, -1] & (timestep == context.timesteps[:, -1] + 1)
    return ~follows if episode_start is None else ~follows | np.asarray(episode_start, dtype=bool)


def push(
    context: Context,
    observation: np.ndarray,
    return_to_go: np.ndarray,
    timestep: np.ndarray,
    episode_start: np.ndarray | None = None,
    frames: Sequence[np.ndarray] | None = None,
) -> Context:
    """
    Add a step to every row; its action stays zero until :func:`with_action`. Rows start anew where :func:`restarts` says so.

    :param observation: (B, O)
    :param return_to_go: (B,)
    :param timestep: (B,) int64
    :param episode_start: (B,) bool
    :param frames: arrays (B, ...) that tell episodes apart at their start; the observation alone if not given
    """
    restart = restarts(context, timestep, episode_start)
    starting = np.flatnonzero(restart)
    if len(starting):
        context = _empty_rows(context, restart)
    for row in starting:
        key = 0
        for frame in (observation.astype(np.float32),) if frames is None else frames:
            key = zlib.crc32((frame[row] + frame.dtype.type(0)).tobytes(), key)  # no negative zeros
        context.episode_keys[row] = key
    return context._replace(
        observations=_shift(context.observations, observation),
        actions=_shift(context.actions, 0.0),
        returns_to_go=_shift(context.returns_to_go, return_to_go),
        timesteps=_shift(context.timesteps, timestep),
        mask=_shift(context.mask, True),
    )


def _empty_rows(context: Context, rows: np.ndarray) -> Context:
    """
    The context with nothing in some rows. A mask does not do: it hides a number and no NaN, since 0 * NaN is NaN.

    :param rows: (B,) bool
    """
    emptied = {}
    for name, array in context._asdict().items():
        # Keys and values are large, and behind the mask any finite number in them is as good as zero.
        if name != "keys_values" or not np.isfinite(array[rows]).all():
            emptied[name] = array.copy()
            emptied[name][rows] = 0
    return context._replace(**emptied)


def with_action(context: Context, action: np.ndarray) -> Context:
    """
    Fill in the newest step's action.

    :param action: (B, A) in [-1, 1]
    """
    actions = context.actions.copy()
    actions[:, -1] = action
    return context._replace(actions=actions)


def with_plan(context: Context, due: np.ndarray, chunk: np.ndarray) -> Context:
    """
    Take the newest step's action from the plan; where none is left, from a new one.

    :param due: (B,) bool, True where the plan is used up
    :param chunk: (number due, P + 1, A) in [-1, 1], actions for this step and the next ones
    """
    actions = np.zeros((len(due), *chunk.shape[1:]), np.float32)
    actions[~due, :-1] = context.plan[~due]
    actions[due] = chunk
    n_planned = np.where(due, chunk.shape[1], context.n_planned) - 1
    return with_action(context, actions[:, 0])._replace(plan=actions[:, 1:], n_planned=n_planned)


def check_chunks(context: Context, due: np.ndarray, chunks: np.ndarray) -> None:
    """
    Say why there is no finite action for some rows, although the numbers that `predict` lets in are finite.

    :param due: (B,) bool, b rows that have new actions
    :param chunks: (b, H, A), their actions
    :raises ValueError: they are not finite
    """
    if (fits := np.isfinite(chunks)).all():
        return
    rows = np.flatnonzero(due)[~fits.all(axis=(1, 2))]
    names = [name for name, array in context._asdict().items() if not np.isfinite(array[rows]).all()]
    largest = np.abs(context.returns_to_go[rows]).max()
    cause = (
        f"state holds NaN or infinity in {', '.join(names)}. Begin these rows anew with episode_start."
        if names
        else f"the policy's weights give none for a return_to_go of {largest:g}. Take a smaller target, or load other "
        "weights."
    )
    raise ValueError(f"There is no finite action in row {', '.join(map(str, rows))}: {cause}")


def _shift(window: np.ndarray, newest: np.ndarray | float) -> np.ndarray:
    shifted = np.empty(window.shape, window.dtype)
    shifted[:, :-1] = window[:, 1:]
    shifted[:, -1] = newest
    return shifted


def unpack_observation(observation: Any, observation_dim: int) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], bool]:
    """
    Take the wrapper's observation apart.

    :param observation: Dict of `observation` (O,), `return_to_go` (1,), `timestep` (1,), or with a leading axis B
    :param observation_dim: O
    :return: observation (B, O) and return-to-go (B,) as float32, time step (B,) as int64; and whether B was there
    :raises ValueError: not such a Dict, another O, not one return-to-go and time step for each observation, or a number that
        cannot be acted on, with key and rows
    """
    if not isinstance(observation, dict) or not set(OBSERVATION_KEYS) <= set(observation):
        found = f"the keys {sorted(observation)}" if isinstance(observation, dict) else type(observation).__name__
        raise ValueError(
            f"The observation must be a dict with the keys {', '.join(OBSERVATION_KEYS)}, as "
            "sb3_dtfm.envs.ReturnToGoWrapper gives it: write ReturnToGoWrapper(env, target_return=model.target_return), or "
            f"take model.get_env(); got {found}."
        )
    given = {key: _array(observation, key) for key in OBSERVATION_KEYS}
    shape = given["observation"].shape
    if len(shape) not in (1, 2) or shape[-1] != observation_dim or shape[0] == 0:
        raise ValueError(
            f"observation['observation'] has shape {shape}; ({observation_dim},) or (n_envs, {observation_dim}) is expected."
        )
    n_rows = 1 if len(shape) == 1 else shape[0]
    for key in COLUMNS:
        if given[key].size != n_rows:
            raise ValueError(f"observation[{key!r}] has shape {given[key].shape}; ({n_rows}, 1) is expected.")
    given = {key: array.reshape(n_rows, 1 if key in COLUMNS else observation_dim) for key, array in given.items()}
    values = _convert(given["observation"], np.float32)
    return_to_go, timestep = (_convert(given[key], dtype) for key, dtype in COLUMNS.items())
    for key, numbers in (("observation", values), ("return_to_go", return_to_go)):
        # A sum of squares is finite where all numbers are, but for huge ones; to look at each takes five times as long.
        if not math.isfinite(np.vdot(numbers, numbers)) and not (fits := np.isfinite(numbers)).all():
            _refuse(key, given[key], ~fits, "finite float32 numbers")
    if timestep.min() < 0 or timestep.max() > LAST_TIMESTEP:
        unfit = (timestep < 0) | (timestep > LAST_TIMESTEP)
        _refuse("timestep", given["timestep"], unfit, f"whole numbers from 0 to {LAST_TIMESTEP}")
    return (values, return_to_go[:, 0], timestep[:, 0]), len(shape) == 2


def _array(observation: dict[str, Any], key: str) -> np.ndarray:
    """
    :raises ValueError: no array of numbers
    """
    try:
        array = np.asarray(observation[key])
    except (TypeError, ValueError) as error:
        raise ValueError(f"observation[{key!r}] must be an array of numbers: {error}") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"observation[{key!r}] must be an array of numbers; got {array.dtype}.")
    return array


def _convert(array: np.ndarray, dtype: type) -> np.ndarray:
    """Convert numbers to a type; those that it cannot hold become infinite, or -1 where they should be whole."""
    if array.dtype == dtype:
        return array
    with np.errstate(over="ignore", invalid="ignore"):
        converted: np.ndarray = array.astype(dtype)
    return converted if dtype is np.float32 else np.where(converted == array, converted, -1)


def _refuse(key: str, given: np.ndarray, unfit: np.ndarray, accepted: str) -> NoReturn:
    """
    :param given: (B, N)
    :param unfit: (B, N) bool
    """
    rows = np.flatnonzero(unfit.any(axis=1))
    where = [(row, np.argmax(unfit[row])) for row in rows[:N_ROWS_SHOWN]]
    found = ", ".join(
        f"row {row} holds {given[row, i]}" + (f" at [{i}]" if key == "observation" else "") for row, i in where
    )
    more = f" and {len(rows) - len(where)} more rows hold others" if len(rows) > len(where) else ""
    raise ValueError(
        f"observation[{key!r}] must hold {accepted}; {found}{more}. Nothing has changed: with other numbers there the same "
        "question can be asked again, and the other rows go on."
    )
