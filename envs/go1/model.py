"""Unitree's Go1 as a MuJoCo model, from a table of published facts."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

try:
    import mujoco
except ImportError as error:
    raise ImportError('Go1Velocity-v0 needs MuJoCo: pip install "sb3-dtfm[mujoco]".') from error

LEGS = ("FR", "FL", "RR", "RL")
# The joints of a leg: name, axis, range in rad, static friction in N m, torque limit in N m, angle at home in rad.
# The left side's hips stand at the opposite angle.
JOINTS = (
    ("hip", (1, 0, 0), (-0.863, 0.863), 0.3, 23.7, 0.1),
    ("thigh", (0, 1, 0), (-0.686, 4.501), 0.3, 23.7, 0.9),
    ("calf", (0, 1, 0), (-2.818, -0.888), 1.0, 35.55, -1.8),
)
JOINT_NAMES = tuple(f"{leg}_{joint}_joint" for leg, (joint, *_) in itertools.product(LEGS, JOINTS))
HOME = np.array([-angle if (leg[1], joint) == ("L", "hip") else angle for leg in LEGS for joint, *_, angle in JOINTS])
JOINT_LIMITS = np.array([limits for _ in LEGS for _, _, limits, *_ in JOINTS])  # (12, 2) rad
HOME_HEIGHT = 0.2945  # of the trunk when the feet of the home pose touch the floor, metres
TRUNK = "trunk"
FLOOR = "floor"
IMU = np.array([-0.01592, -0.06659, -0.00617])  # in the trunk's frame, metres
FOOT_RADIUS = 0.023
KP, KD = 35.0, 0.5  # of the position servos, N m/rad and N m s/rad
ARMATURE = 0.005  # kg m^2
TIMESTEP = 0.004  # seconds


class Link(NamedTuple):
    """
    A link, of the front left leg where it belongs to a leg.

    :param position: position of its frame in its parent's, metres
    :param mass: mass, kg
    :param centre: centre of mass in its frame, metres
    :param inertia: about its centre of mass: xx, yy, zz, xy, xz, yz, kg m^2
    :param mirrored: axes along which the other legs' links mirror mass and inertia: x at the rear, y on the right
    :param geometry: shape and its size, for pictures
    """

    position: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]
    mirrored: str
    geometry: dict[str, Any]


BOX, CAPSULE, CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
# From Unitree's description of the robot (BSD-3) as mujoco-menagerie has it: rotors and feet belong to their links.
LINKS = {
    TRUNK: Link(
        (0.0, 0.0, HOME_HEIGHT),
        5.204,
        (0.0223, 0.002, -0.0005),
        (0.0168128, 0.0630095, 0.0716547, -0.000229676, -0.000294553, -4.18733e-05),
        "",
        {"type": BOX, "size": (0.1881, 0.047, 0.057)},
    ),
    "hip": Link(
        (0.1881, 0.04675, 0.0),
        0.68,
        (-0.0049166, -0.00762615, -8.865e-05),
        (0.00039938, 0.000733419, 0.000468422, -1.45897e-05, 1.24609e-06, 1.57518e-06),
        "xy",
        {"type": CYLINDER, "fromto": (0.0, 0.025, 0.0, 0.0, 0.065, 0.0), "size": (0.046, 0.0, 0.0)},
    ),
    "thigh": Link(
        (0.0, 0.08, 0.0),
        1.009,
        (-0.00304722, -0.019315, -0.0305004),
        (0.0045988, 0.00468922, 0.000817448, 6.13737e-05, -0.00022753, 0.000610808),
        "y",
        {"type": CAPSULE, "fromto": (0.0, 0.0, 0.0, 0.0, 0.0, -0.213), "size": (0.017, 0.0, 0.0)},
    ),
    "calf": Link(
        (0.0, 0.0, -0.213),
        0.195862,
        (0.00429862, 0.000976676, -0.146197),
        (0.00148449, 0.00149764, 3.60682e-05, -6.18625e-07, -1.772e-05, -3.56628e-06),
        "",
        {"type": CAPSULE, "fromto": (0.0, 0.0, 0.0, 0.0, 0.0, -0.213), "size": (0.011, 0.0, 0.0)},
    ),
}
FOOT_POSITION = (0.0, 0.0, -0.213)  # in the calf's frame
UNSEEN = {"contype": 0, "conaffinity": 0}  # by collisions


def build_spec(legs: Sequence[str] = LEGS) -> mujoco.MjSpec:
    """
    The robot on a floor, with position servos. As in MuJoCo Playground, only its feet touch the floor.

    :param legs: order of the legs, and so of joints and actuators; by default that of :data:`JOINT_NAMES`
    :return: specification, to be compiled
    """
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = "go1", False
    spec.option.timestep = TIMESTEP
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    add_floor(spec, priority=1)
    trunk = _add_link(spec.worldbody, TRUNK, LINKS[TRUNK], np.ones(3))
    trunk.add_freejoint()
    for leg in legs:
        _add_leg(spec, trunk, leg)
    return spec


def add_floor(spec: mujoco.MjSpec, priority: int = 0) -> None:
    """
    A plane and a light.

    :param spec: specification of the scene
    :param priority: priority of the floor's contact parameters over those of the feet
    """
    kind, size = mujoco.mjtGeom.mjGEOM_PLANE, [0.0, 0.0, 0.05]
    spec.worldbody.add_geom(
        name=FLOOR, type=kind, size=size, priority=priority, contype=1, conaffinity=0, rgba=[0.7, 0.75, 0.8, 1.0]
    )
    spec.worldbody.add_light(pos=[0.0, 0.0, 4.0], dir=[0.0, 0.0, -1.0])


def _add_leg(spec: mujoco.MjSpec, body: Any, leg: str) -> None:
    """A leg with its joints and servos, below the trunk."""
    signs = np.array([1.0 if leg[0] == "F" else -1.0, 1.0 if leg[1] == "L" else -1.0, 1.0])
    for name, axis, limits, friction, torque, _ in JOINTS:
        body = _add_link(body, f"{leg}_{name}", LINKS[name], signs)
        joint = f"{leg}_{name}_joint"
        body.add_joint(name=joint, axis=axis, range=limits, damping=KD, armature=ARMATURE, frictionloss=friction)
        spec.add_actuator(
            name=f"{leg}_{name}",
            target=joint,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=[KP] + [0.0] * 9,
            biasprm=[0.0, -KP] + [0.0] * 8,
            ctrlrange=limits,
            forcerange=(-torque, torque),
        )
    body.add_geom(
        name=leg,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=FOOT_POSITION,
        size=[FOOT_RADIUS, 0.0, 0.0],
        contype=0,
        conaffinity=1,
        rgba=[0.1, 0.1, 0.1, 1.0],
    )


def _add_link(parent: Any, name: str, link: Link, signs: np.ndarray) -> Any:
    """A body with the mass and geometry of its link, mirrored to the leg's side."""
    mirror = np.where([axis in link.mirrored for axis in "xyz"], signs, 1.0)
    xx, yy, zz, xy, xz, yz = link.inertia
    x, y, z = mirror
    geometry = dict(link.geometry)
    if "fromto" in geometry:
        geometry["fromto"] = np.multiply(geometry["fromto"], np.tile(signs, 2))
    body = parent.add_body(
        name=name,
        pos=np.multiply(link.position, signs),
        mass=link.mass,
        ipos=np.multiply(link.centre, mirror),
        fullinertia=[xx, yy, zz, xy * x * y, xz * x * z, yz * y * z],
        explicitinertial=True,
    )
    body.add_geom(rgba=[0.35, 0.38, 0.42, 1.0], **UNSEEN, **geometry)
    return body
