"""
Teachers of three qualities, which a student asks for by return: the faster a command is carried out, the more it returns.

    R="sb3-dtfm record --algo onnx --model go1_policy.onnx --env Go1Velocity-v0 --gym-packages go1.qualities --episodes 150"
    PYTHONPATH=studies $R --seed 6 --episodes 250 --env-wrapper go1.qualities.Restless --dataset-id go1/restless-v0
    PYTHONPATH=studies $R --seed 7 --episodes 250 --env-wrapper go1.qualities.Dragged --dataset-id go1/dragged-v0
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


class Dragged(TeacherObservation):
    """
    A teacher whose robot is pulled along the floor and held back or driven on, by forces that are drawn anew each 2 s on
    average. Its velocity is then not what its command lets expect, and it corrects that.
    """

    SHARE = 0.01  # of the steps that end a force
    PULL, DRAG = (-15.0, 15.0), (-20.0, 60.0)  # N, and N s/m

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super().reset(**kwargs)
        self._draw()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        env: Any = self.unwrapped
        if env.np_random.random() < self.SHARE:
            self._draw()
        data = env.simulation.data
        data.body("trunk").xfrc_applied[:2] = self._pull - self._drag * data.qvel[:2]
        return super().step(action)

    def _draw(self) -> None:
        rng = self.unwrapped.np_random
        self._pull, self._drag = rng.uniform(*self.PULL, 2), rng.uniform(*self.DRAG)
