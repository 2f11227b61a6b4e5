"""How well actions are predicted by what is seen, by what was done before, and by how the episode turns out."""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_dtfm.actions import bounds_of, vector_space
from sb3_dtfm.data.buffer import TrajectoryBuffer

# Parts that are held out in turn, and most steps of all of them.
N_PARTS, MAX_STEPS = 5, 16_384
# Of the ridge regressions, penalties as shares of the products' mean.
N_FEATURES, PENALTIES = 256, (1e-3, 1e-1, 10.0)
CLIP, SMALLEST_STD = 10.0, 1e-6
# Standard deviation of returns, as a share of the largest, that becomes 1; smaller ones stay small.
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
        How much better the previous action predicts an action than the observation does.

        People and scripts follow plans that an observation does not show: repeating the last action is the better guess.
        Agents of reinforcement learning compute each action from the observation: a regression is the better guess. Chunks
        of actions drawn from the flow copy a plan; the mean action leaves out an agent's noise.
        """
        return float(self.by_observation.mean() / max(self.by_previous.mean(), 1e-12))

    def gain_by_return(self) -> float:
        """How much better actions are predicted where the episode's return is known, in standard errors over episodes."""
        gains = self.by_observation - self.by_return
        error = gains.std(ddof=1) / len(gains) ** 0.5 if len(gains) > 1 else 0.0
        return float(gains.mean() / error) if error > 0 else 0.0


def prediction_errors(buffer: TrajectoryBuffer) -> PredictionErrors | None:
    """
    Predict the actions of at most 16,384 steps, each by regressions on other episodes: a fifth of them is held out in turn.

    :param buffer: Discrete actions count as vectors
    :return: by the best of three penalties each; None where fewer than two episodes have a step that follows another
    """
    generator = th.Generator().manual_seed(0)
    chosen = th.randperm(len(buffer), generator=generator)[:MAX_STEPS].sort().values
    chosen = chosen[buffer.timesteps.cpu()[chosen] > 0]
    episode = np.searchsorted(np.cumsum(buffer.episode_lengths), chosen.numpy(), side="right")
    names, episode = np.unique(episode, return_inverse=True)
    if len(names) < 2:
        return None
    rows = buffer.rows.cpu()[chosen]
    low, high = (th.as_tensor(bound).double() for bound in bounds_of(vector_space(buffer.action_space)))
    previous, actions = (buffer.actions.cpu()[at].double() / (high - low) for at in (rows - 1, rows))
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
    What to regress on: the observation, random features of it, and these again, as they are or moved by the return.

    :param rows: (N,) of the buffer's tensors
    :param returns: (N,) of whole episodes
    :return: without and with the return, (N, F) each
    """
    mean, std = (th.as_tensor(each).float() for each in buffer.statistics()[:2])
    seen = ((buffer.observations.cpu()[rows] - mean) / th.where(std > SMALLEST_STD, std, 1.0)).clamp(-CLIP, CLIP)
    weight = 2.0 * th.randn(seen.shape[1], N_FEATURES, generator=generator) / seen.shape[1] ** 0.5
    mapped = seen @ weight + th.randn(N_FEATURES, generator=generator)
    unit = max(float(returns.std()), SMALLEST_SPREAD * float(np.abs(returns).max()), SMALLEST_STD)
    told = th.from_numpy((returns - returns.mean()) / unit).float().unsqueeze(1)
    by_return = th.randn(N_FEATURES, generator=generator)

    def with_return(told: th.Tensor) -> th.Tensor:
        moved = (mapped + told * by_return).relu()
        return th.cat((seen, told, mapped.relu(), moved, th.ones_like(told)), dim=1).double()

    return with_return(th.zeros_like(told)), with_return(told)


def _held_out(features: th.Tensor, actions: th.Tensor, part: np.ndarray) -> list[th.Tensor]:
    """
    Predictions of each step by a ridge regression on the other parts.

    :param features: (N, F)
    :param actions: (N, A)
    :param part: (N,) which each step belongs to
    :return: (N, A) for each penalty
    """
    predicted = [th.zeros_like(actions) for _ in PENALTIES]
    offset = actions.mean(dim=0)
    products, shares = features.T @ features, features.T @ (actions - offset)
    for held in (th.from_numpy(part == number) for number in range(N_PARTS)):
        mine, wanted = features[held], actions[held] - offset
        others, share = products - mine.T @ mine, shares - mine.T @ wanted
        unit = others.diagonal().mean() * th.eye(len(others), dtype=others.dtype)
        for penalty, each in zip(PENALTIES, predicted, strict=True):
            each[held] = mine @ th.cholesky_solve(share, th.linalg.cholesky(others + penalty * unit)) + offset
    return predicted
