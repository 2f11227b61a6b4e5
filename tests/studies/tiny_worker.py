"""A baseline that needs NumPy alone: a linear map, whose last action tells how long its environment's episode has been."""

from collections.abc import Callable
from typing import Any

import numpy as np
from baselines.protocol import Dataset, serve


class LinearLearner:
    """
    Least squares by gradient descent.

    :param settings: `learning_rate`, or `fail`, a text that it fails with
    """

    def __init__(self, settings: dict[str, Any], dataset: Dataset, n_steps: int, seed: int) -> None:
        if "fail" in settings:
            raise ValueError(settings["fail"])
        print("what a library prints does no harm")
        self._observations, self._actions = (
            np.concatenate([getattr(episode, name) for episode in dataset.episodes]) for name in ("observations", "actions")
        )
        shape = self._observations.shape[1], self._actions.shape[1]
        self._matrix = np.random.default_rng(seed).normal(0.0, 0.1, shape).astype(np.float32)
        self._learning_rate = settings["learning_rate"]

    def learn(self, n_steps: int, after_step: Callable[[], None]) -> None:
        for _ in range(n_steps):
            error = self._observations @ self._matrix - self._actions
            self._matrix -= self._learning_rate * self._observations.T @ error / len(error)
            after_step()

    def actor(self) -> Callable[[np.ndarray, float, bool], np.ndarray]:
        seen = 0

        def act(observation: np.ndarray, return_to_go: float, start: bool) -> np.ndarray:
            nonlocal seen
            seen = 1 if start else seen + 1
            return np.append((observation @ self._matrix)[:-1], seen / 1000)

        return act


if __name__ == "__main__":
    serve(LinearLearner, ("numpy",))
