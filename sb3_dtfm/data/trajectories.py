"""One recorded episode: what it holds, what makes it unfit for learning, and the return-to-go of its steps."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace
from sb3_dtfm.envs.observation_spaces import check_cameras, check_image_shape
from sb3_dtfm.files import printable

# Recorded float64 actions may pass a float32 bound by a rounding error; beyond this share of the range they are wrong.
ACTION_TOLERANCE = 1e-4
# Choices of a Discrete action space at most: each takes a number in every step.
MOST_CHOICES = 2**16
# The kinds of NumPy's types that are real numbers: float, int, unsigned, bool.
REAL = "fiub"
# An array may take this many times the bytes that are stored of it, and this many bytes more: far less than a file of
# some kilobytes can claim, and more than compression makes of any recording: deflate packs at most 1,032 bytes into one.
LARGEST_EXPANSION, SMALL_ARRAY = 1100, 2**24
# Numbers whose squares sum to less than this are all finite in float32; above, each has to be looked at.
SURELY_FINITE = 1e37


class DatasetError(ValueError):
    """
    A dataset cannot be used.

    :param message: message that names the file, episode and step, what was found and what is accepted
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class ActionRangeError(DatasetError):
    """An action lies outside of the action space."""


@contextlib.contextmanager
def wrap_dataset_errors(where: str, why: str = "the file is damaged or incomplete, or cut off") -> Iterator[None]:
    """
    Turn whatever the libraries that read a file raise into our own error, which says where.

    :param where: the file, and the episode or field that is read
    :param why: likely cause, for the message
    :raises DatasetError: instead of any other exception, but of a package that is missing
    """
    try:
        yield
    except (DatasetError, ImportError):
        raise
    except Exception as error:  # over damaged files they raise nearly everything
        what = f"{type(error).__name__}: {error}"
        raise DatasetError(f"{where}: cannot be read ({what}); {why}.") from error


def check_real(dtype: Any, where: str) -> None:
    """
    Refuse what is no real number before it is read, or cast to one.

    :param dtype: type of an array
    :param where: the file, the episode and the array
    :raises DatasetError: complex numbers, words, objects, records, dates
    """
    if np.dtype(dtype).kind not in REAL:
        raise DatasetError(f"{where} hold {dtype}; real numbers are expected.")


def check_size(n_bytes: int, n_stored: int, where: str) -> None:
    """
    Refuse an array that claims to be far larger than what is stored of it, before memory is taken for it.

    :param n_bytes: size in memory, bytes
    :param n_stored: size in the file, bytes
    :param where: the file, the episode and the array
    :raises DatasetError: it does
    """
    if n_bytes > SMALL_ARRAY + LARGEST_EXPANSION * n_stored:
        raise DatasetError(
            f"{where} claim {n_bytes} bytes, of which {n_stored} are stored; the file is damaged or incomplete."
        )


def check_flags(flags: np.ndarray, n_steps: int, where: str) -> np.ndarray:
    """
    Return flags as bool, one for each step.

    :param flags: (T,) or (T, 1), zeros and ones of any type
    :param n_steps: T
    :param where: the file, the episode and the array
    :return: (T,) bool
    :raises DatasetError: another shape, or another value
    """
    check_real(flags.dtype, where)
    if flags.size != n_steps or flags.shape[:1] != (n_steps,):
        raise DatasetError(f"{where} have shape {flags.shape}, expected ({n_steps},), one for each action.")
    flags = flags.reshape(n_steps)
    if flags.dtype != bool and not ((flags == 0) | (flags == 1)).all():
        step = int(np.argmax((flags != 0) & (flags != 1)))
        raise DatasetError(f"{where} hold {flags[step]} at step {step}; 0 and 1 are accepted.")
    return flags.astype(bool)


@dataclass(frozen=True)
class Trajectory:
    """
    One recorded episode of T steps.

    :param observations: (T, O), the observation each action was chosen on
    :param actions: (T, A), in the environment's own range; (T,) where it has a Discrete action space
    :param rewards: (T,), environment reward units
    :param terminated: whether the last step reached a terminal state
    :param truncated: whether the last step hit a time limit; neither flag set means that the recording stopped mid-episode
    :param success: whether the task was done at the last step; None where the data do not tell
    :param images: images by camera, (T, height, width, channels) uint8, or channels first
    :param name: name of the episode in its file, for error messages
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    name: str = "episode"
    images: Mapping[str, np.ndarray] = field(default_factory=dict)

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


class ReturnReference(NamedTuple):
    """
    Recorded returns, which the returns of a model are compared with.

    :param recorded: mean return of the recorded episodes, environment reward units
    :param best_tenth: mean return of the best tenth of them, environment reward units
    :param best: largest return of them, environment reward units
    :param n_episodes: number of recorded episodes
    :param start_decides: whether the first observation explains at least half of the returns' variance
    :param success_rate: share of the recorded episodes that succeeded, in [0, 1]; None where the data do not tell
    :param random: mean return of random actions, environment reward units; None where it was not measured
    """

    recorded: float
    best_tenth: float
    best: float
    n_episodes: int
    start_decides: bool = False
    success_rate: float | None = None
    random: float | None = None

    @property
    def suggested(self) -> float:
        """The target return that the data suggest: the best tenth's, or the mean where these had the easiest starts."""
        return self.recorded if self.start_decides else self.best_tenth

    def goal(self, target_return: float | None) -> tuple[float, str]:
        """
        The return that a model has to reach, and its name.

        A model has to reach its target return. A target beyond every recorded return means the best of the data: then the
        goal is the best tenth. If the start decides, a target above the mean is out of reach from most starts: then the
        goal is the mean. The mean is also the goal of a model without a target return, which copies all episodes.

        :param target_return: target return, environment reward units; None where the model has none, or does not look at it
        """
        if target_return is None or (self.start_decides and _exceeds(target_return, self.recorded)):
            return self.recorded, "the recorded mean"
        if _exceeds(target_return, self.best):
            return self.best_tenth, "the best tenth"
        return target_return, "the target return"

    def share(self, episode_return: float, goal: float) -> float | None:
        """
        The share of the way from random actions to a goal that a return covers, which also makes sense of negative returns.

        :param episode_return: return to rate, environment reward units
        :param goal: return to reach, environment reward units
        :return: 0 for random actions, 1 for the goal; None where random actions are not known to be worse than the goal
        """
        if self.random is None or goal <= self.random:
            return None
        return (episode_return - self.random) / (goal - self.random)


def _exceeds(target_return: float, recorded: float) -> bool:
    """Return whether a target is above a recorded return by more than the rounding of suggested targets to four digits."""
    return target_return > recorded and not math.isclose(target_return, recorded, rel_tol=1e-3)


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


def check_action_space(space: spaces.Space, source: str) -> ActionSpace:
    """
    The action space, if actions from it can be learnt: scaled to [-1, 1] and back in float32, or one of several choices.

    :param space: action space of a dataset or an environment
    :param source: name of the dataset or environment, for messages
    :raises DatasetError: neither a Box of floats of shape (A,) nor Discrete, or a dimension without bounds or width
    """
    problem = f"{source}: the action space is {space}"
    accepted = (
        "only a bounded Box of floats of shape (A,), low < high in each dimension, "
        f"or a Discrete of 2 to {MOST_CHOICES:,} actions, can be learnt"
    )
    if isinstance(space, spaces.Discrete) and 2 <= space.n <= MOST_CHOICES:
        return space
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


def check_trajectory(
    trajectory: Trajectory,
    observation_space: spaces.Box,
    action_space: ActionSpace,
    source: str,
    image_spaces: Mapping[str, spaces.Box] | None = None,
) -> np.ndarray:
    """
    Refuse an episode that training must not see.

    :param image_spaces: image spaces that are expected, by camera; None takes images as they are
    :return: (T,) float64, the returns-to-go, which have been looked at, too
    :raises DatasetError: names source, episode and step, what was found and what is accepted
    """
    shape = observation_space.shape
    if not isinstance(observation_space, spaces.Box) or len(shape) != 1 or shape == (0,):
        found = f"the observation space is {observation_space}"
        raise DatasetError(f"{source}: {found}; only a Box of shape (O,) can be learnt from.")
    where = f"{source}, {trajectory.name}"
    n_steps = len(trajectory)
    if n_steps == 0:
        raise DatasetError(f"{where}: holds no step; at least one is needed.")
    expected = {
        "observations": (n_steps, *observation_space.shape),
        "actions": (n_steps, *(action_space.shape or ())),
        "rewards": (n_steps,),
    }
    for name, shape in expected.items():
        array = getattr(trajectory, name)
        check_real(np.asarray(array).dtype, f"{where}: {name}")
        if np.shape(array) != shape:
            raise DatasetError(f"{where}: {name} have shape {np.shape(array)}, expected {shape}.")
        check_finite(array, name, where)
    check_images(trajectory.images, image_spaces, n_steps, where)
    if isinstance(action_space, spaces.Discrete):
        _check_choices(trajectory.actions, action_space, where)
    else:
        _check_inside(trajectory.actions, action_space, where)
    to_go = returns_to_go(trajectory.rewards)
    check_finite(to_go, "returns-to-go, sums of rewards,", where)
    return to_go


def check_images(
    images: Mapping[str, np.ndarray], image_spaces: Mapping[str, spaces.Box] | None, n_steps: int, where: str
) -> None:
    """
    :param images: images of an episode, by camera
    :param image_spaces: image spaces of all episodes, by camera; None for the first episode
    :param n_steps: T
    :raises DatasetError: other cameras, sizes or numbers than bytes, or not one image a step
    """
    if image_spaces is not None and images.keys() != image_spaces.keys():
        raise DatasetError(f"{where}: has images of {listed(images)}, expected {listed(image_spaces)} as before.")
    for camera, array in images.items():
        if array.dtype != np.uint8 or array.ndim != 4 or 0 in array.shape:
            raise DatasetError(
                f"{where}: images of {camera!r} are {array.dtype} of shape {array.shape}, expected uint8 of (steps, height, "
                "width, channels), 0 to 255; for floats from 0 to 1 write (255 * images).astype(np.uint8)."
            )
        if len(array) != n_steps:
            raise DatasetError(f"{where}: has {len(array)} images of {camera!r}, expected {n_steps}, one for each action.")
        try:
            check_cameras([camera])
            check_image_shape(array.shape[1:], f"an image of {camera!r}")
        except ValueError as error:
            raise DatasetError(f"{where}: {error}") from error
        if image_spaces is not None and array.shape[1:] != image_spaces[camera].shape:
            before = image_spaces[camera].shape
            raise DatasetError(
                f"{where}: images of {camera!r} have shape {array.shape[1:]}, expected {before} as before; resize them."
            )


def listed(names: Any) -> str:
    """Names in a message."""
    return ", ".join(map(repr, names)) or "no camera"


def _check_inside(actions: np.ndarray, space: spaces.Box, where: str) -> None:
    slack = ACTION_TOLERANCE * (space.high - space.low)
    low, high = space.low - slack, space.high + slack
    if not ((actions >= low).all() and (actions <= high).all()):
        outside = (actions < low) | (actions > high)
        step, dimension = (int(i) for i in np.argwhere(outside)[0])
        raise ActionRangeError(
            f"{where}, step {step}: action {actions[step, dimension]:g} in dimension {dimension} lies outside of "
            f"the action space [{space.low[dimension]:g}, {space.high[dimension]:g}]."
        )


def _check_choices(actions: np.ndarray, space: spaces.Discrete, where: str) -> None:
    first, last = int(space.start), int(space.start) + int(space.n) - 1
    unfit = (actions < first) | (actions > last) | (actions % 1 != 0)
    if unfit.any():
        step = int(np.argmax(unfit))
        raise DatasetError(f"{where}, step {step}: action {actions[step]:g} is no whole number from {first} to {last}.")


def check_finite(array: np.ndarray, name: str, where: str) -> None:
    """
    Refuse what float32 cannot hold.

    :param array: (T,) or (T, .), real numbers of any type
    :param name: name of the numbers, for the message
    :param where: the file and the episode
    :raises DatasetError: names the first step whose number is NaN, infinite or too large
    """
    # One number per array tells nearly always that all is well; it is NaN or infinite if any entry is.
    if float(np.vdot(array, array)) < SURELY_FINITE:
        return
    largest = np.float64(np.finfo(np.float32).max)  # of a type that NumPy 2 does not cast to float16
    bad = ~(np.abs(array) <= largest)  # also True for NaN
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        column = f", dimension {index[1]}" if len(index) > 1 else ""
        raise DatasetError(
            f"{where}, step {index[0]}: {name} hold {array[index]}{column}; numbers must be finite in float32."
        )
