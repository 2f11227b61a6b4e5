"""Measures of how well actions are predicted by observation, by previous action, and by observation and return."""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch as th

from sb3_dtfm.actions import bounds_of, vector_space
from sb3_dtfm.data.buffer import TrajectoryBuffer

# Folds of the cross-validation, and the most steps of all of them.
N_PARTS, MAX_STEPS = 5, 16_384
# Random features, and ridge penalties as shares of the mean diagonal of X^T X.
N_FEATURES, PENALTIES = 256, (1e-3, 1e-1, 10.0)
# Returns are divided by their standard deviation, but by no less than this share of the largest absolute one.
SMALLEST_SPREAD = 1e-3


class PredictionErrors(NamedTuple):
    """
    Mean squared errors of actions in held-out episodes, as shares of the range of actions, by what they are predicted from.

    :param by_observation: the observation, by ridge regression on it and on random features of it (E,)
    :param by_return: the observation and the return of the whole episode (E,)
    :param by_previous: the previous action, which is repeated (E,)
    """

    by_observation: np.ndarray
    by_return: np.ndarray
    by_previous: np.ndarray

    def plan_ratio(self) -> float:
        """
        Return how much better the previous action predicts an action than the observation does.

        People and scripts follow plans that an observation does not show: repeating the last action is the better guess.
        Agents of reinforcement learning compute each action from the observation: a regression is the better guess. Chunks
        of actions drawn from the flow copy a plan; the mean action leaves out an agent's noise.
        """
        return float(self.by_observation.mean() / max(self.by_previous.mean(), 1e-12))

    def gain_by_return(self) -> float:
        """Return how much better actions are predicted with a known return, in standard errors over episodes."""
        gains = self.by_observation - self.by_return
        error = gains.std(ddof=1) / len(gains) ** 0.5 if len(gains) > 1 else 0.0
        return float(gains.mean() / error) if error > 0 else 0.0


def correlation_of_changes(buffer: TrajectoryBuffer) -> float:
    """
    Return how an action's change from one step to the next correlates with the change before.

    White noise on actions takes back in one step what it did in the last: -0.5 of noise alone, 0 of a script that jumps, and
    above 0 of a smooth course.

    :return: correlation over at most 16,384 steps, in [-1, 1]; 0 where no action changes
    """
    generator = th.Generator().manual_seed(0)
    later = th.nonzero(buffer.timesteps.cpu() >= 2).squeeze(1)
    later = later[th.randperm(len(later), generator=generator)[:MAX_STEPS].sort().values]
    rows = buffer.rows
    rows = rows[later.to(rows.device)]
    low, high = (th.as_tensor(bound).double() for bound in bounds_of(vector_space(buffer.action_space)))
    oldest, previous, newest = (
        buffer.stored["actions"].index_select(0, rows - back).cpu().double() / (high - low) for back in (2, 1, 0)
    )
    before, after = previous - oldest, newest - previous
    size = (before.square().sum() * after.square().sum()).sqrt()
    return float((before * after).sum() / size) if size > 0 else 0.0


_known: WeakKeyDictionary[TrajectoryBuffer, PredictionErrors | None] = WeakKeyDictionary()


def prediction_errors(buffer: TrajectoryBuffer) -> PredictionErrors | None:
    """
    Predict the actions of at most 16,384 steps, each by regressions on other episodes: a fifth of them is held out in turn.

    Models that learn from the same buffer share the result.

    :param buffer: recorded episodes; Discrete actions count as vectors
    :return: errors, each with the best of three penalties; None where fewer than two episodes have two successive steps
    """
    if buffer not in _known:
        _known[buffer] = _prediction_errors(buffer)
    return _known[buffer]


def _prediction_errors(buffer: TrajectoryBuffer) -> PredictionErrors | None:
    generator = th.Generator().manual_seed(0)
    chosen = th.randperm(len(buffer), generator=generator)[:MAX_STEPS].sort().values
    chosen = chosen[buffer.timesteps.cpu()[chosen] > 0]
    episode = np.searchsorted(np.cumsum(buffer.episode_lengths), chosen.numpy(), side="right")
    names, episode = np.unique(episode, return_inverse=True)
    if len(names) < 2:
        return None
    rows = buffer.rows
    rows = rows[chosen.to(rows.device)]
    low, high = (th.as_tensor(bound).double() for bound in bounds_of(vector_space(buffer.action_space)))
    stored = buffer.stored["actions"]
    previous, actions = (stored.index_select(0, at).cpu().double() / (high - low) for at in (rows - 1, rows))
    features = _features(buffer, rows, buffer.episode_returns[names][episode], generator)
    part = np.random.default_rng(0).permutation(len(names))[episode] % N_PARTS

    def by_episode(predicted: th.Tensor) -> np.ndarray:
        errors = (predicted - actions).square().mean(dim=1).numpy()
        return np.bincount(episode, errors) / np.bincount(episode)

    by_observation, by_return = (min(map(by_episode, _held_out(each, actions, part)), key=np.mean) for each in features)
    return PredictionErrors(by_observation, by_return, by_episode(previous))


def _features(
    buffer: TrajectoryBuffer, rows: th.Tensor, returns: np.ndarray, generator: th.Generator
) -> tuple[th.Tensor, th.Tensor]:
    """
    Regressors without and with the return: the observation, and random features of it alone and of it with the return.

    :param rows: (N,) rows of the stored tensors
    :param returns: (N,) returns of whole episodes
    :return: (N, F) each; without the return it counts as the mean one, so that both have the same number of features
    """
    observations = buffer.statistics().normalize(buffer.stored["observations"].index_select(0, rows).cpu())
    weights = 2.0 * th.randn(observations.shape[1], N_FEATURES, generator=generator) / observations.shape[1] ** 0.5
    projected = observations @ weights + th.randn(N_FEATURES, generator=generator)
    return_weights = th.randn(N_FEATURES, generator=generator)
    unit = max(float(returns.std()), SMALLEST_SPREAD * float(np.abs(returns).max())) or 1.0
    normalized = th.from_numpy((returns - returns.mean()) / unit).float().unsqueeze(1)

    def features(of_return: th.Tensor) -> th.Tensor:
        with_return = projected + of_return * return_weights
        ones = th.ones_like(of_return)
        return th.cat((observations, of_return, projected.relu(), with_return.relu(), ones), dim=1).double()

    return features(th.zeros_like(normalized)), features(normalized)


def _held_out(features: th.Tensor, actions: th.Tensor, part: np.ndarray) -> list[th.Tensor]:
    """
    Predictions of each step by a ridge regression on the other parts.

    :param features: (N, F)
    :param actions: (N, A)
    :param part: (N,) number of the part that each step belongs to
    :return: (N, A) for each penalty
    """
    predictions = [th.zeros_like(actions) for _ in PENALTIES]
    mean = actions.mean(dim=0)
    products, targets = features.T @ features, features.T @ (actions - mean)
    for held_out in (th.from_numpy(part == number) for number in range(N_PARTS)):
        x, y = features[held_out], actions[held_out] - mean
        training_products, training_targets = products - x.T @ x, targets - x.T @ y  # of the other parts
        unit = training_products.diagonal().mean() * th.eye(len(products), dtype=products.dtype)
        for penalty, prediction in zip(PENALTIES, predictions, strict=True):
            factor = th.linalg.cholesky(training_products + penalty * unit)
            prediction[held_out] = x @ th.cholesky_solve(training_targets, factor) + mean
    return predictions
