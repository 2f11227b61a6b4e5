"""Content of a buffer, and possible faults of it before training."""

from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dtfm.actions import bounds_of, vector_space
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.trajectories import ReturnReference

# Share of the range of actions below which the data use only a corner of it.
NARROW = 0.1
# Actions this near to a bound, as a share of the range, are at it; worth a word if they are this share of all.
AT_BOUND, MANY = 1e-3, 0.5
# Standard deviations from the mean at which a number is no measurement any more.
FAR = 100.0
FEW_EPISODES = 20
# Their mean return is the suggested target return.
BEST_SHARE = 0.1
# Returns tell the start rather than the quality where the first observation explains this share of their variance.
START_DECIDES = 0.5
# Below ten episodes chance explains as much. At most 500 are looked at, which takes a tenth of a second.
FEWEST_STARTS, MOST_STARTS = 10, 500
# Regression on first observations: starts are alike within this many standard deviations of each dimension. The noise is
# a share of the returns' variance; none of both is fitted, so that noise explains less than half of ten returns, too.
START_WIDTH, START_NOISE = 2.0, 0.3


class Range(NamedTuple):
    """Smallest and largest number, mean and standard deviation of each dimension (D,)."""

    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray
    std: np.ndarray


class Inspection(NamedTuple):
    """
    Findings.

    :param observations: range of the observations, O dimensions
    :param actions: range of the actions, A dimensions; for a Discrete space its n choices, whose means are their shares
    :param at_bounds: share of all actions' entries at a bound of the action space, in [0, 1]; meaningless for Discrete ones
    :param target_return: see :func:`suggested_target_return`
    :param remarks: sentences about what may be wrong
    """

    observations: Range
    actions: Range
    at_bounds: float
    target_return: float
    remarks: list[str]


def inspect_buffer(buffer: TrajectoryBuffer) -> Inspection:
    """
    Look at every step.

    :param buffer: recorded episodes to learn from
    """
    observations, values = _range(buffer.observations), buffer.actions
    actions = _range(values)
    low, high = (th.from_numpy(bound).to(values) for bound in bounds_of(vector_space(buffer.action_space)))
    margin = AT_BOUND * (high - low)
    at_bounds = float(((values <= low + margin) | (values >= high - margin)).float().mean())
    seen = [] if images_alone(buffer) else _of_observations(observations)
    remarks = [*_of_episodes(buffer), *seen, *_of_actions(buffer, actions, at_bounds)]
    return Inspection(observations, actions, at_bounds, suggested_target_return(buffer), remarks)


def images_alone(buffer: TrajectoryBuffer) -> bool:
    """Return whether there are no numbers beside images, but for one that is always 0."""
    return bool(buffer.image_spaces) and not buffer.own("observations").any()


def suggested_target_return(buffer: TrajectoryBuffer) -> float:
    """
    A target return: the mean of the best tenth of the episodes; of all episodes where the start decides their returns,
    since the best tenth had the easiest starts then.

    :param buffer: recorded episodes to learn from
    :return: target return, environment reward units, rounded to four digits
    """
    return float(f"{return_reference(buffer).suggested:.4g}")


def return_reference(buffer: TrajectoryBuffer) -> ReturnReference:
    """
    Recorded returns, which the returns of a model are compared with.

    :param buffer: recorded episodes to learn from
    :return: reference without the return of random actions, which only an environment tells
    """
    returns, rate = buffer.episode_returns, float(buffer.successes.mean())
    return ReturnReference(
        recorded=float(returns.mean()),
        best_tenth=float(buffer.best(best_share=BEST_SHARE).episode_returns.mean()),
        best=float(returns.max()),
        n_episodes=buffer.n_episodes,
        start_decides=explained_by_start(buffer) >= START_DECIDES,
        success_rate=None if np.isnan(rate) else rate,
    )


def explained_by_start(buffer: TrajectoryBuffer) -> float:
    """
    Share of the returns' variance that first observations explain: a Gaussian process predicts each episode's return from
    those of all others (Rasmussen and Williams, 2006, equation 5.12).

    :param buffer: any number of recorded episodes, of which duplicates count once
    :return: share in [0, 1]; 0 for fewer than ten episodes, or if all returns are equal
    """
    stored = buffer.stored["observations"]
    starts = stored.index_select(0, th.from_numpy(buffer.episodes.starts).to(stored.device))
    table = np.unique(np.column_stack([buffer.episode_returns, starts.cpu()]), axis=0)
    table = table[np.linspace(0, len(table) - 1, min(len(table), MOST_STARTS)).astype(int)]
    deviations = table - table.mean(axis=0)
    std = deviations.std(axis=0)
    if len(table) < FEWEST_STARTS or not std[0]:
        return 0.0
    scaled = deviations[:, 1:] / np.where(std[1:] > 0, std[1:], 1.0)
    products, width = scaled @ scaled.T, START_WIDTH**2 * max(1, np.count_nonzero(std[1:]))
    alike = np.exp((products - 0.5 * (np.diag(products)[:, None] + np.diag(products))) / width)
    # Adding 1 to all covariances has the mean predicted, too.
    inverse = np.linalg.inv(1.0 + alike + START_NOISE * np.eye(len(table)))
    residuals = inverse @ deviations[:, 0] / np.diag(inverse)
    by_the_mean = deviations[:, 0] * len(table) / (len(table) - 1)
    return float(max(0.0, 1.0 - np.square(residuals).sum() / np.square(by_the_mean).sum()))


def _range(values: th.Tensor) -> Range:
    numbers = values.cpu().numpy()
    mean = numbers.mean(axis=0, dtype=np.float64)
    return Range(numbers.min(axis=0), numbers.max(axis=0), mean, numbers.std(axis=0, dtype=np.float64))


def _of_episodes(buffer: TrajectoryBuffer) -> list[str]:
    n, lengths, returns = buffer.n_episodes, buffer.episode_lengths, buffer.episode_returns
    table = np.column_stack([lengths, returns, buffer.episodes.observation_means])
    n_twice = n - len(np.unique(table, axis=0))
    n_stopped = int((~buffer.terminated & ~buffer.truncated).sum())
    n_short = int((lengths == 1).sum())
    remarks = []
    if n < FEW_EPISODES:
        remarks.append(f"There are {_count(n, 'episode')}: what is learned depends on which ones.")
    if n_twice and not images_alone(buffer):
        remarks.append(f"Stored twice: {_count(n_twice, 'episode')} of {n}.")
    if n_short:
        remarks.append(f"With a single step: {_count(n_short, 'episode')} of {n}.")
    if n_stopped:
        remarks.append(f"Neither terminated nor truncated, the recording just stops: {_count(n_stopped, 'episode')} of {n}.")
    if buffer.n_dropped:
        remarks.append(f"Left out, since they cannot be used: {_count(buffer.n_dropped, 'episode')}.")
    if not returns.any():
        remarks.append("No episode has any return, so a target return has no effect.")
    elif np.ptp(returns) == 0:
        remarks.append(f"All returns are {returns[0]:g}: the policy copies the data, whatever its target return.")
    explained = explained_by_start(buffer)
    if explained >= START_DECIDES:
        start = f"Returns depend on how an episode starts ({100 * explained:.0f} % of their variance)"
        remarks.append(f"{start}: the best returns come from the easiest starts.")
    return remarks


def _of_observations(found: Range) -> list[str]:
    remarks = []
    still = np.flatnonzero(found.low == found.high)
    if len(still):
        remarks.append(f"Observations never change in {_dimensions(still)}.")
    moving = found.std > 0
    distance = np.zeros(len(found.std))
    extremes = np.maximum(found.high - found.mean, found.mean - found.low)
    distance[moving] = extremes[moving] / found.std[moving]
    if (distance > FAR).any():
        worst = int(distance.argmax())
        what = f"{distance[worst]:.0f} standard deviations from the mean"
        remarks.append(f"Observations go far out in {_dimensions(np.flatnonzero(distance > FAR))}: in {worst}, {what}.")
    return remarks


def _of_actions(buffer: TrajectoryBuffer, found: Range, at_bounds: float) -> list[str]:
    space, remarks = buffer.action_space, []
    if isinstance(space, spaces.Discrete):
        never = int(space.start) + np.flatnonzero(found.high == 0.0)
        return [f"Never chosen: {_listed(never)}."] if len(never) else []
    used = (found.high - found.low) / (space.high - space.low)
    still, narrow = np.flatnonzero(used == 0), np.flatnonzero((used > 0) & (used < NARROW))
    if len(still):
        remarks.append(f"Actions never change in {_dimensions(still)}.")
    if len(narrow):
        share = f"less than {NARROW:.0%} of the action space's range"
        remarks.append(f"Actions use {share} in {_dimensions(narrow)}: is it the range of these data?")
    if at_bounds > MANY:
        remarks.append(f"{at_bounds:.0%} of the actions are at a bound.")
    return remarks


def _dimensions(indices: np.ndarray) -> str:
    return f"dimension{'s' if len(indices) > 1 else ''} {_listed(indices)}"


def _listed(numbers: np.ndarray) -> str:
    return ", ".join(map(str, numbers[:8])) + (" ..." if len(numbers) > 8 else "")


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'s' if n != 1 else ''}"
