"""A Go1 in MuJoCo: joint targets go in, its motion comes out, in the robot's own order of joints."""

from typing import NamedTuple

import mujoco
import numpy as np

from sb3_dtfm.envs.go1.model import HOME, HOME_HEIGHT, IMU, JOINT_NAMES, LEGS

DECISION = 0.02  # seconds
IMU_LEVER = np.cross(np.eye(3), IMU).T  # times a turn rate: the velocity at the IMU; np.cross takes 30 times as long
LOWEST = 0.15  # height of the trunk below which the robot has fallen, metres
STEEPEST = 0.5  # cosine of the trunk's tilt below which the robot has fallen


class Motion(NamedTuple):
    """
    The robot's present motion.

    :param velocity: velocity of the IMU in the trunk's frame, (3,) m/s
    :param gyro: turn rates in the trunk's frame, (3,) rad/s
    :param gravity: direction of gravity in the trunk's frame, (3,)
    :param joint_positions: (12,) rad
    :param joint_velocities: (12,) rad/s
    :param torques: (12,) N m
    :param height: height of the trunk, metres
    :param foot_heights: heights of the feet's centres, (4,) metres
    :param foot_speeds: speeds of the feet along the floor, (4,) m/s
    :param foot_contacts: whether each foot touches something, (4,)
    """

    velocity: np.ndarray
    gyro: np.ndarray
    gravity: np.ndarray
    joint_positions: np.ndarray
    joint_velocities: np.ndarray
    torques: np.ndarray
    height: float
    foot_heights: np.ndarray
    foot_speeds: np.ndarray
    foot_contacts: np.ndarray

    @property
    def tracked(self) -> np.ndarray:
        """The velocities that a command asks for: forward and left in m/s, turn in rad/s."""
        return np.array([*self.velocity[:2], self.gyro[2]])

    @property
    def fallen(self) -> bool:
        return bool(self.height < LOWEST or -self.gravity[2] < STEEPEST)


class Simulation:
    """
    The robot with position servos.

    :param model: MuJoCo model with the names of :func:`~sb3_dtfm.envs.go1.model.build_spec`, in any order
    """

    is_delay_fixed = False

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.n_steps = round(DECISION / model.opt.timestep)
        self.delay = 0  # physics steps until a target arrives, at most those of a decision
        joints = np.array([model.joint(name).id for name in JOINT_NAMES])
        self._positions, self._velocities = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self.actuators = np.array([int(np.flatnonzero(model.actuator_trnid[:, 0] == joint)[0]) for joint in joints])
        self._feet = np.array([model.geom(leg).id for leg in LEGS])
        self._rotation, self._foot_velocity = np.zeros(9), np.zeros(6)
        self._targets = HOME

    def reset(
        self,
        joint_positions: np.ndarray = HOME,
        height: float = HOME_HEIGHT,
        yaw: float = 0.0,
        velocity: np.ndarray | None = None,
    ) -> None:
        """
        Start anew above the floor's centre.

        :param joint_positions: (12,) rad
        :param height: height of the trunk, metres
        :param yaw: yaw of the trunk, rad
        :param velocity: velocity of the trunk, linear in the world's frame and angular in its own, (6,); none by default
        """
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7] = (0.0, 0.0, height, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        self.data.qpos[self._positions] = self._targets = joint_positions
        if velocity is not None:
            self.data.qvel[:6] = velocity
        mujoco.mj_step1(self.model, self.data)

    def advance(self, targets: np.ndarray) -> None:
        """
        Simulate the time of a decision.

        :param targets: target positions of the joints, (12,) rad; until the delay is over, the last ones hold
        """
        for step in range(self.n_steps):
            self.drive(self._targets if step < self.delay else targets)
            # In halves, so that positions, velocities and contacts are all of the time after the last step.
            mujoco.mj_step2(self.model, self.data)
            mujoco.mj_step1(self.model, self.data)
        self._targets = targets

    def drive(self, targets: np.ndarray) -> None:
        """
        Tell the actuators, before each physics step.

        :param targets: target positions of the joints, (12,) rad
        """
        self.data.ctrl[self.actuators] = targets

    def push(self, velocity: np.ndarray) -> None:
        """
        Change the trunk's velocity at once.

        :param velocity: velocity to add along the floor, (2,) m/s
        """
        self.data.qvel[:2] += velocity
        mujoco.mj_step1(self.model, self.data)

    @property
    def orientation(self) -> np.ndarray:
        """The trunk's quaternion, (4,) w x y z."""
        return self.data.qpos[3:7].copy()

    @property
    def joint_positions(self) -> np.ndarray:
        """(12,) rad"""
        return self.data.qpos[self._positions]

    @property
    def joint_velocities(self) -> np.ndarray:
        """(12,) rad/s"""
        return self.data.qvel[self._velocities]

    @property
    def motion(self) -> Motion:
        """The present motion."""
        data = self.data
        mujoco.mju_quat2Mat(self._rotation, data.qpos[3:7])
        world_to_trunk = self._rotation.reshape(3, 3).T
        gyro = data.qvel[3:6].copy()
        touching = set(data.contact.geom[data.contact.dist <= 0.0].ravel().tolist())
        return Motion(
            velocity=world_to_trunk @ data.qvel[:3] + IMU_LEVER @ gyro,
            gyro=gyro,
            gravity=-world_to_trunk[:, 2],
            joint_positions=self.joint_positions,
            joint_velocities=self.joint_velocities,
            torques=data.actuator_force[self.actuators],
            height=float(data.qpos[2]),
            foot_heights=data.geom_xpos[self._feet, 2],
            foot_speeds=np.array([self._foot_speed(foot) for foot in self._feet]),
            foot_contacts=np.array([foot in touching for foot in self._feet.tolist()]),
        )

    def _foot_speed(self, foot: int) -> float:
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_GEOM, foot, self._foot_velocity, 0)
        return float(np.hypot(self._foot_velocity[3], self._foot_velocity[4]))
