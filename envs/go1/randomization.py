"""Differences between one episode's robot and another's, after MuJoCo Playground: a table of ranges."""

from typing import NamedTuple

import mujoco
import numpy as np

from sb3_dtfm.envs.go1.model import FLOOR, JOINT_NAMES, LEGS, TRUNK
from sb3_dtfm.envs.go1.simulation import Motion, Simulation


class Draw(NamedTuple):
    """
    A robot and its floor.

    :param friction: friction of floor and feet
    :param joint_friction: factors of the joints' static friction, (12,)
    :param armature: factors of the joints' armature, (12,)
    :param mass: factors of the links' masses, (13,), trunk first
    :param payload: mass added to the trunk, kg
    :param centre: shift of the trunk's centre of mass, (3,) metres
    :param joint_zero: readings of the joints where they should read 0, (12,) rad
    :param delay: time until a target arrives, as a share of a decision's time
    :param strength: factors of the motors' torques, (12,); of our servos, only of the part that Kp makes
    """

    friction: np.ndarray
    joint_friction: np.ndarray
    armature: np.ndarray
    mass: np.ndarray
    payload: np.ndarray
    centre: np.ndarray
    joint_zero: np.ndarray
    delay: np.ndarray
    strength: np.ndarray


# Range and shape of each, in the order of the draw. Playground's, which leaves delay and the motors' strength alone.
RANGES: dict[str, tuple[float, float, tuple[int, ...]]] = {
    "friction": (0.4, 1.0, ()),
    "joint_friction": (0.9, 1.1, (12,)),
    "armature": (1.0, 1.05, (12,)),
    "mass": (0.9, 1.1, (13,)),
    "payload": (-1.0, 1.0, ()),
    "centre": (-0.05, 0.05, (3,)),
    "joint_zero": (-0.05, 0.05, (12,)),
    "delay": (0.0, 1.0, ()),
    "strength": (0.9, 1.1, (12,)),
}
# Largest deviation of each measurement.
NOISE = {"velocity": 0.1, "gyro": 0.2, "gravity": 0.05, "joint_positions": 0.03, "joint_velocities": 1.5}
PUSH_SPEED = (0.0, 0.5)  # by which a push changes the trunk's velocity, m/s
PUSH_INTERVAL = (3.0, 8.0)  # seconds between pushes
START_VELOCITY = 0.5  # largest of an episode's first velocities of the trunk, m/s and rad/s


def draw_robot(rng: np.random.Generator) -> Draw:
    """
    :param rng: source of randomness
    :return: uniform numbers from :data:`RANGES`
    """
    return Draw(**{name: np.asarray(rng.uniform(low, high, shape)) for name, (low, high, shape) in RANGES.items()})


def draw_push(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """
    :param rng: source of randomness
    :return: change of velocity along the floor, (2,) m/s, and seconds until the next push
    """
    angle, speed, interval = rng.uniform(-np.pi, np.pi), rng.uniform(*PUSH_SPEED), rng.uniform(*PUSH_INTERVAL)
    return speed * np.array([np.cos(angle), np.sin(angle)]), interval


def add_noise(motion: Motion, rng: np.random.Generator) -> Motion:
    """
    :param motion: true motion
    :param rng: source of randomness
    :return: motion as the sensors measure it
    """
    return motion._replace(
        **{
            name: getattr(motion, name) + rng.uniform(-most, most, len(getattr(motion, name)))
            for name, most in NOISE.items()
        }
    )


class Randomizer:
    """
    Gives a simulation the robot that was drawn.

    :param simulation: simulation of the robot as it was made
    """

    FIELDS = (
        *("geom_friction", "dof_frictionloss", "dof_armature", "body_mass", "body_inertia", "body_ipos", "qpos0"),
        *("actuator_gainprm", "actuator_biasprm"),
    )

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        model = self._model = simulation.model
        self._made = {name: getattr(model, name).copy() for name in self.FIELDS}
        self._grounds = [model.geom(name).id for name in (FLOOR, *LEGS)]
        self._joints = np.array([model.joint(name).id for name in JOINT_NAMES])
        self._links = np.array([model.body(TRUNK).id, *model.jnt_bodyid[self._joints]])

    def apply(self, draw: Draw) -> None:
        """
        :param draw: robot and floor that replace the last ones
        """
        model, made, links, trunk = self._model, self._made, self._links, self._links[0]
        dofs, positions = model.jnt_dofadr[self._joints], model.jnt_qposadr[self._joints]
        model.geom_friction[self._grounds, 0] = draw.friction
        model.dof_frictionloss[dofs] = made["dof_frictionloss"][dofs] * draw.joint_friction
        model.dof_armature[dofs] = made["dof_armature"][dofs] * draw.armature
        model.body_mass[links] = made["body_mass"][links] * draw.mass
        model.body_mass[trunk] += draw.payload
        share = model.body_mass[links] / made["body_mass"][links]
        model.body_inertia[links] = made["body_inertia"][links] * share[:, None]
        model.body_ipos[trunk] = made["body_ipos"][trunk] + draw.centre
        model.qpos0[positions] = made["qpos0"][positions] + draw.joint_zero
        actuators = self._simulation.actuators
        for name in ("actuator_gainprm", "actuator_biasprm"):
            getattr(model, name)[actuators] = made[name][actuators] * draw.strength[:, None]
        mujoco.mj_setConst(model, self._simulation.data)
        if not self._simulation.is_delay_fixed:
            self._simulation.delay = round(float(draw.delay) * self._simulation.n_steps)
