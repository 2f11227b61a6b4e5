"""
Windows of K consecutive steps: the one type of them, and the context that acting carries from step to step.

Pure functions: each returns new arrays and leaves its arguments alone, so a context can serve as SB3's `state`.
"""

import zlib
from typing import Any, NamedTuple

import numpy as np

# What an observation holds beside the numbers of the environment.
COLUMNS = {"return_to_go": np.float32, "timestep": np.int64}
OBSERVATION_KEYS = ("observation", *COLUMNS)


class Windows(NamedTuple):
    """
    B windows of K consecutive steps, newest last, padded on the left; padded entries are zero and False in `mask`.

    Tensors on their way through a network, arrays in a :class:`Context`. Shapes: observations (B, K, O), actions (B, K, A),
    returns_to_go (B, K) in environment reward units, timesteps (B, K) int64 counted from the episode's start, mask (B, K)
    bool. Whoever hands windows on says in which units observations and actions are. A batch to learn chunks from has more
    actions, (B, K + H - 1, A): those after the newest step.
    """

    observations: Any
    actions: Any
    returns_to_go: Any
    timesteps: Any
    mask: Any


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

    @property
    def windows(self) -> Windows:
        """The steps alone."""
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


def restarts(context: Context, timestep: np.ndarray, episode_start: np.ndarray | None = None) -> np.ndarray:
    """
    Where a new step begins a context of its own: at the start of an episode, and where it follows nothing.

    :param timestep: (B,) int64
    :param episode_start: (B,) bool, True where the caller says so
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
) -> Context:
    """
    Add a step to every row; its action stays zero until :func:`with_action`. Rows start anew where :func:`restarts` says so.

    :param observation: (B, O)
    :param return_to_go: (B,)
    :param timestep: (B,) int64
    :param episode_start: (B,) bool
    """
    restart = restarts(context, timestep, episode_start)
    keep = ~restart[:, None]
    episode_keys = context.episode_keys.copy()
    for row in np.flatnonzero(restart):
        episode_keys[row] = zlib.crc32(observation[row].astype(np.float32) + 0.0)  # no negative zeros
    return Context(
        _shift(context.observations, observation),
        _shift(context.actions, np.zeros_like(context.actions[:, 0])),
        _shift(context.returns_to_go, return_to_go),
        _shift(context.timesteps, timestep),
        np.concatenate((context.mask[:, 1:] & keep, np.ones_like(keep)), axis=1),
        episode_keys,
        context.plan,
        np.where(restart, 0, context.n_planned),
        context.keys_values,
    )


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


def _shift(window: np.ndarray, newest: np.ndarray) -> np.ndarray:
    return np.concatenate((window[:, 1:], newest[:, None]), axis=1)


def unpack_observation(observation: Any, observation_dim: int) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], bool]:
    """
    Take the wrapper's observation apart.

    :param observation: Dict of `observation` (O,), `return_to_go` (1,), `timestep` (1,), or with a leading axis B
    :param observation_dim: O
    :return: observation (B, O) and return-to-go (B,) as float32, time step (B,) as int64; and whether B was there
    :raises ValueError: not such a Dict, another O, or not one return-to-go and time step for each observation
    """
    if not isinstance(observation, dict) or not set(OBSERVATION_KEYS) <= set(observation):
        found = f"the keys {sorted(observation)}" if isinstance(observation, dict) else type(observation).__name__
        raise ValueError(
            f"The observation must be a dict with the keys {', '.join(OBSERVATION_KEYS)}, as "
            f"sb3_dtfm.envs.ReturnToGoWrapper gives it; got {found}."
        )
    values = np.asarray(observation["observation"], dtype=np.float32)
    if values.ndim not in (1, 2) or values.shape[-1] != observation_dim:
        raise ValueError(
            f"observation['observation'] has shape {values.shape}; "
            f"({observation_dim},) or (n_envs, {observation_dim}) is expected."
        )
    vectorized = values.ndim == 2
    values = values.reshape(-1, observation_dim)
    return_to_go, timestep = (np.asarray(observation[name], kind) for name, kind in COLUMNS.items())
    for name, column in zip(COLUMNS, (return_to_go, timestep), strict=True):
        if column.size != len(values):
            raise ValueError(f"observation[{name!r}] has shape {column.shape}; ({len(values)}, 1) is expected.")
    return (values, return_to_go.reshape(-1), timestep.reshape(-1)), vectorized
