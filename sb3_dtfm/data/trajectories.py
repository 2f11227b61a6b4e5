"""One recorded episode: what it holds, what makes it unfit for learning, and the return-to-go of its steps."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from gymnasium import spaces

# Recorded float64 actions may pass a float32 bound by a rounding error; beyond this share of the range they are wrong.
ACTION_TOLERANCE = 1e-4
# Numbers whose squares sum to less than this are all finite in float32; above, each has to be looked at.
SURELY_FINITE = 1e37


class DatasetError(ValueError):
    """A dataset cannot be used. The message names the file, episode and step, what was found and what is accepted."""


@dataclass(frozen=True)
class Trajectory:
    """
    One recorded episode of T steps.

    :param observations: (T, O), the observation each action was chosen on
    :param actions: (T, A), in the environment's own range
    :param rewards: (T,), environment reward units
    :param terminated: the last step reached a terminal state
    :param truncated: the last step hit a time limit; neither flag set means that the recording stopped mid-episode
    :param name: what the file calls this episode, for error messages
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool = False
    truncated: bool = False
    name: str = "episode"

    def __len__(self) -> int:
        return len(self.actions)


class ScoreReference(NamedTuple):
    """Returns that a normalised score maps to 0 and 1, and where that scale comes from."""

    minimum: float
    maximum: float
    scale: str

    def normalize(self, episode_return: float) -> float:
        """Normalised score of a return in environment reward units: 0 at `minimum`, 1 at `maximum`."""
        return (episode_return - self.minimum) / (self.maximum - self.minimum)


def returns_to_go(rewards: np.ndarray) -> np.ndarray:
    """
    Undiscounted return from each step to the end of one episode.

    Starts from the episode's return and subtracts reward by reward, in float64: the arithmetic of
    :class:`~sb3_dtfm.envs.ReturnToGoWrapper`, so that a replayed episode shows exactly these values.

    :param rewards: (T,), environment reward units
    :return: (T,) float64
    """
    rewards = np.asarray(rewards, dtype=np.float64)
    return np.subtract.accumulate(np.concatenate([[rewards.sum()], rewards[:-1]]))


def check_action_space(space: spaces.Space, source: str) -> spaces.Box:
    """
    The action space, if actions from it can be learnt: scaled to [-1, 1] and back in float32.

    :param space: of a dataset or an environment
    :param source: whose it is, for messages
    :raises DatasetError: not a Box of floats of shape (A,), or a dimension without bounds or width
    """
    problem = f"{source}: the action space is {space}"
    accepted = "only a bounded Box of floats of shape (A,), low < high in each dimension, can be learnt"
    is_vector = len(space.shape or ()) == 1 and space.shape != (0,)
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating) or not is_vector:
        raise DatasetError(f"{problem}; {accepted}.")
    with np.errstate(over="ignore", invalid="ignore"):
        widths = space.high.astype(np.float32) - space.low.astype(np.float32)
    unfit = ~((widths > 0.0) & np.isfinite(widths))
    if unfit.any():
        first = int(np.argmax(unfit))
        reach = f"from {space.low[first]:g} to {space.high[first]:g}"
        raise DatasetError(f"{problem}, whose dimension {first} reaches {reach}; {accepted}.")
    return space


def check_trajectory(trajectory: Trajectory, observation_space: spaces.Box, action_space: spaces.Box, source: str) -> None:
    """
    Refuse an episode that training must not see.

    :raises DatasetError: names source, episode and step, what was found and what is accepted
    """
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        found = f"the observation space is {observation_space}"
        raise DatasetError(f"{source}: {found}; only a Box of shape (O,) can be learnt from.")
    where = f"{source}, {trajectory.name}"
    n_steps = len(trajectory)
    if n_steps == 0:
        raise DatasetError(f"{where}: holds no step; at least one is needed.")
    expected = {
        "observations": (n_steps, *observation_space.shape),
        "actions": (n_steps, *action_space.shape),
        "rewards": (n_steps,),
    }
    for name, shape in expected.items():
        array = getattr(trajectory, name)
        if np.shape(array) != shape:
            raise DatasetError(f"{where}: {name} have shape {np.shape(array)}, expected {shape}.")
        # One number per array tells nearly always that all is well; it is NaN or infinite if any entry is.
        if not np.vdot(array, array) < SURELY_FINITE:
            _refuse_infinite(array, name, where)
    slack = ACTION_TOLERANCE * (action_space.high - action_space.low)
    low, high = action_space.low - slack, action_space.high + slack
    if not ((trajectory.actions >= low).all() and (trajectory.actions <= high).all()):
        outside = (trajectory.actions < low) | (trajectory.actions > high)
        step, dimension = (int(i) for i in np.argwhere(outside)[0])
        raise DatasetError(
            f"{where}, step {step}: action {trajectory.actions[step, dimension]:g} in dimension {dimension} lies outside of "
            f"the action space [{action_space.low[dimension]:g}, {action_space.high[dimension]:g}]."
        )


def _refuse_infinite(array: np.ndarray, name: str, where: str) -> None:
    """Name the first number that is NaN or too large for float32, if there is one."""
    bad = ~(np.abs(array) <= np.finfo(np.float32).max)  # also True for NaN
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        column = f", dimension {index[1]}" if len(index) > 1 else ""
        raise DatasetError(
            f"{where}, step {index[0]}: {name} hold {array[index]}{column}; numbers must be finite in float32."
        )
