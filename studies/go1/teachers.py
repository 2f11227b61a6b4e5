"""
Teachers that are disturbed in ways that `--noise` does not know, so that a velocity is not what its command lets expect; and
teachers that walk more slowly than they are asked.

    R="sb3-dtfm record --algo onnx --model go1_policy.onnx --env Go1Velocity-v0 --gym-packages go1.teachers --episodes 250"
    PYTHONPATH=studies $R --seed 6 --env-wrapper go1.teachers.Restless --dataset-id go1/restless-v0
    PYTHONPATH=studies $R --seed 7 --env-wrapper go1.teachers.Dragged --dataset-id go1/dragged-v0
"""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_dtfm.envs.go1.env import TeacherObservation
from sb3_dtfm.envs.go1.model import JOINT_NAMES, KD, TRUNK


class Restless(TeacherObservation):
    """A teacher whose command is drawn anew each half second, on average."""

    SHARE = 0.04  # of the steps that end a command

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        env: Any = self.unwrapped
        if env.np_random.random() < self.SHARE:
            env._next_command = 0.0
        return super().step(action)


class Drag(gym.Wrapper):
    """
    Pulls the robot along the floor, and holds it back or drives it on, by forces that are drawn anew each 2 s on average.

    :param env: Go1Velocity-v0
    """

    SHARE = 0.01  # of the steps that end a force
    PULL, DRAG = (-15.0, 15.0), (-20.0, 60.0)  # N, and N s/m

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self._draw()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        env: Any = self.unwrapped
        if env.np_random.random() < self.SHARE:
            self._draw()
        data = env.simulation.data
        data.body(TRUNK).xfrc_applied[:2] = self._pull - self._drag * data.qvel[:2]
        return self.env.step(action)

    def _draw(self) -> None:
        rng = self.unwrapped.np_random
        self._pull, self._drag = rng.uniform(*self.PULL, 2), rng.uniform(*self.DRAG)


class Damping(gym.Wrapper):
    """
    Joints that resist motion more than those of our model, by a factor that an episode draws.

    :param env: Go1Velocity-v0 with our model
    """

    RANGE = (1.0, 4.0)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        env: Any = self.unwrapped
        model = env.simulation.model
        joints = [model.joint(name).id for name in JOINT_NAMES]
        model.dof_damping[model.jnt_dofadr[joints]] = KD * env.np_random.uniform(*self.RANGE)
        return observation, info


class Dragged(TeacherObservation):
    """
    A teacher whose robot is in :class:`Drag`; it corrects its velocity.

    :param env: Go1Velocity-v0
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(Drag(env))


class Gentle(TeacherObservation):
    """
    A teacher who is told a third of the command.

    :param env: Go1Velocity-v0
    """

    SHARE = 1 / 3

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = super().reset(**kwargs)
        return self._told(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        observation, *rest = super().step(action)
        return self._told(observation), *rest

    def _told(self, observation: np.ndarray) -> np.ndarray:
        return np.concatenate((observation[:-3], self.SHARE * observation[-3:]))


class Moderate(Gentle):
    """A teacher who is told two thirds of the command."""

    SHARE = 2 / 3
