"""
Teachers of three qualities, which a student asks for by return: the faster a command is carried out, the more it returns.

    R="sb3-dtfm record --algo onnx --model go1_policy.onnx --env Go1Velocity-v0 --gym-packages go1.qualities --episodes 150"
    PYTHONPATH=studies $R --seed 6 --episodes 250 --env-wrapper go1.qualities.Restless --dataset-id go1/restless-v0
    PYTHONPATH=studies $R --seed 3 --env-wrapper sb3_dtfm.envs.go1.env.TeacherObservation --dataset-id go1/fast-v0
    PYTHONPATH=studies $R --seed 4 --env-wrapper go1.qualities.Moderate --dataset-id go1/moderate-v0
    PYTHONPATH=studies $R --seed 5 --env-wrapper go1.qualities.Gentle --dataset-id go1/gentle-v0
"""

from typing import Any

import numpy as np

from sb3_dtfm.envs.go1.env import TeacherObservation


class Moderate(TeacherObservation):
    """A teacher that carries out 60 % of its commands, which are recorded as they are."""

    SHARE = 0.6

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super().reset(**kwargs)
        return self._slow(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        observation, *rest = super().step(action)
        return self._slow(observation), *rest

    def _slow(self, observation: np.ndarray) -> np.ndarray:
        return np.concatenate((observation[:-3], self.SHARE * observation[-3:]))


class Gentle(Moderate):
    """A teacher that carries out 20 % of its commands."""

    SHARE = 0.2


class Restless(TeacherObservation):
    """A teacher whose command is drawn anew each half second, on average: it corrects its velocity all the time."""

    SHARE = 0.04  # of the steps that end a command

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        env: Any = self.unwrapped
        if env.np_random.random() < self.SHARE:
            env._next_command = 0.0
        return super().step(action)
