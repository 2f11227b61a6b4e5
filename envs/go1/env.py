"""The task: walk as commanded."""

import os
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from sb3_dtfm.envs.go1.model import HOME, build_spec
from sb3_dtfm.envs.go1.randomization import START_VELOCITY, Randomizer, add_noise, draw_push, draw_robot
from sb3_dtfm.envs.go1.rendering import Camera
from sb3_dtfm.envs.go1.rewards import Step, reward_terms, total_reward
from sb3_dtfm.envs.go1.second import MotorSimulation
from sb3_dtfm.envs.go1.simulation import DECISION, Motion, Simulation

ACTION_SCALE = 0.5  # rad
COMMAND_LIMITS = np.array([1.5, 0.8, 1.2])  # forward and left in m/s, turn in rad/s
COMMAND_SHARES = np.array([0.9, 0.25, 0.5])  # of commands that ask for each of them
COMMAND_SECONDS = 5.0  # until another command, on average


class Go1Env(gym.Env[np.ndarray, np.ndarray]):
    """
    A Go1 that follows a velocity command, drawn anew every 5 seconds on average. It decides every 20 ms.

    Actions (12,) lie in [-1, 1]: joint targets are the home pose plus half of them, in rad. Joints come in the robot's own
    order: front right, front left, rear right, rear left, of each hip, thigh and calf.

    Observations (45,) are what the robot measures: gyro (3), direction of gravity (3), joint positions less home (12), joint
    velocities (12), last action (12), command (3: forward and left in m/s, turn in rad/s).
    `info["measured_velocity"]` (3,) is what no robot measures, for :class:`TeacherObservation`; `info["velocity"]` (3,) is
    true and has the command's order; `info["reward_terms"]` are the weighted terms of
    :data:`~sb3_dtfm.envs.go1.rewards.REWARDS`.

    A fall terminates an episode. Everything random comes from `np_random`: a seed repeats an episode exactly.

    :param model_file: path of another model of the robot, which :class:`~sb3_dtfm.envs.go1.second.MotorSimulation` drives;
        this package's own model by default
    :param randomize: draw another robot for each episode, add noise to sensors, and push the robot
    :param render_mode: None or "rgb_array"
    :param width: width of `rgb_array` frames, pixels
    :param height: height of `rgb_array` frames, pixels
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / DECISION)}  # noqa: RUF012

    def __init__(
        self,
        model_file: str | os.PathLike[str] | None = None,
        randomize: bool = True,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}.")
        self.simulation = Simulation(build_spec().compile()) if model_file is None else MotorSimulation(model_file)
        self.randomize = randomize
        self.render_mode = render_mode
        self.width, self.height = width, height
        self._randomizer = Randomizer(self.simulation)
        self._camera: Camera | None = None
        self.observation_space = spaces.Box(-np.inf, np.inf, (45,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (12,), np.float32)
        self.command = np.zeros(3)
        self._last_action = np.zeros(12)
        self._n_steps, self._next_command, self._next_push = 0, 0.0, np.inf

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin an episode at the home pose, with another yaw and velocity.

        :param seed: restarts the environment's random stream; without it the stream continues
        :param options: `{"command": (forward, left, turn)}` holds for the whole episode
        """
        super().reset(seed=seed)
        rng = self.np_random
        self._n_steps, self._last_action, self._next_push = 0, np.zeros(12), np.inf
        if self.randomize:
            self._randomizer.apply(draw_robot(rng))
            self._next_push = draw_push(rng)[1]
        self.simulation.reset(yaw=rng.uniform(-np.pi, np.pi), velocity=rng.uniform(-START_VELOCITY, START_VELOCITY, 6))
        self._draw_command()
        if options is not None and "command" in options:
            self.command, self._next_command = _checked(options["command"], "command", (3,)), np.inf
        motion = self.simulation.motion
        return self._observe(motion, {})

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Move for 20 ms.

        :param action: (12,) in [-1, 1]
        :return: observation, reward, terminated (by a fall), False, and info
        :raises ValueError: wrong shape, NaN or infinity
        """
        # Through float32 always: a recorded action, stored in whichever precision, then replays to the bit.
        action = np.clip(_checked(np.asarray(action, np.float32), "action", (12,)), -1.0, 1.0)
        if self._n_steps * DECISION >= self._next_push:
            velocity, interval = draw_push(self.np_random)
            self.simulation.push(velocity)
            self._next_push += interval
        self.simulation.advance(HOME + ACTION_SCALE * action)
        self._n_steps += 1
        motion = self.simulation.motion
        terms = reward_terms(Step(motion, action, self._last_action, self.command))
        self._last_action = action
        if self._n_steps * DECISION >= self._next_command:
            self._draw_command()
        observation, info = self._observe(motion, {"reward_terms": terms})
        return observation, total_reward(terms), motion.fallen, False, info

    def render(self) -> np.ndarray | None:
        """The robot from a camera that follows it, (height, width, 3) uint8."""
        if self.render_mode is None:
            return None
        self._camera = self._camera or Camera(self.simulation, self.width, self.height)
        return self._camera.frame()

    def close(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _draw_command(self) -> None:
        asked = self.np_random.random(3) < COMMAND_SHARES
        self.command = self.np_random.uniform(-COMMAND_LIMITS, COMMAND_LIMITS) * asked
        self._next_command = self._n_steps * DECISION + self.np_random.exponential(COMMAND_SECONDS)

    def _observe(self, motion: Motion, info: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        measured = add_noise(motion, self.np_random) if self.randomize else motion
        info.update(measured_velocity=measured.velocity.astype(np.float32), velocity=motion.tracked)
        return observation_of(measured, self._last_action, self.command), info


def observation_of(motion: Motion, last_action: np.ndarray, command: np.ndarray) -> np.ndarray:
    """
    :param motion: motion as the sensors measure it
    :param last_action: (12,)
    :param command: forward and left in m/s, turn in rad/s, (3,)
    :return: observation of a policy, (45,) float32
    """
    parts = (motion.gyro, motion.gravity, motion.joint_positions - HOME, motion.joint_velocities, last_action, command)
    return np.concatenate(parts).astype(np.float32)


def _checked(values: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name} must be {shape} finite numbers, got {values!r}.")
    return array


class TeacherObservation(gym.Wrapper, RecordConstructorArgs):
    """
    Shows a teacher the linear velocity, too, before the rest: 48 numbers, in the order of MuJoCo Playground's policy.

    :param env: Go1Velocity-v0
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (48,), np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        return np.concatenate((info["measured_velocity"], observation)), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return np.concatenate((info["measured_velocity"], observation)), reward, terminated, truncated, info
