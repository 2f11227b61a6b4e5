"""The model of the Go1 against what is published of the robot."""

import mujoco
import numpy as np
import pytest

from sb3_dtfm.envs.go1.model import FOOT_RADIUS, HOME, JOINT_LIMITS, JOINT_NAMES, LEGS, build_spec
from sb3_dtfm.envs.go1.simulation import Simulation


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_spec().compile()


def inertia(model: mujoco.MjModel, body: str) -> np.ndarray:
    """About the centre of mass in the body's frame."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body(body).iquat)
    axes = rotation.reshape(3, 3)
    return axes @ np.diag(model.body(body).inertia) @ axes.T


def test_masses_are_those_of_the_robot(model):
    assert model.body_subtreemass[0] == pytest.approx(12.743448, abs=1e-6)
    for leg in LEGS:
        masses = [model.body(f"{leg}_{link}").mass[0] for link in ("hip", "thigh", "calf")]
        assert masses == pytest.approx([0.68, 1.009, 0.195862])


def test_joints_are_those_of_the_robot_in_its_order(model):
    assert [model.joint(joint).name for joint in range(1, 13)] == list(JOINT_NAMES)
    assert JOINT_NAMES[:4] == ("FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint")
    np.testing.assert_allclose(model.jnt_range[1:], [[-0.863, 0.863], [-0.686, 4.501], [-2.818, -0.888]] * 4)
    np.testing.assert_allclose(model.jnt_range[1:], JOINT_LIMITS)
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], [23.7, 23.7, 35.55] * 4)
    assert [model.actuator(number).name + "_joint" for number in range(12)] == list(JOINT_NAMES)


def test_geometry_and_joints_are_the_published_ones(model):
    for leg, x, y in (("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1)):
        for link, position, centre in (
            ("hip", (0.1881 * x, 0.04675 * y, 0.0), (-0.0049166 * x, -0.00762615 * y, -8.865e-05)),
            ("thigh", (0.0, 0.08 * y, 0.0), (-0.00304722, -0.019315 * y, -0.0305004)),
            ("calf", (0.0, 0.0, -0.213), (0.00429862, 0.000976676, -0.146197)),
        ):
            np.testing.assert_allclose(model.body(f"{leg}_{link}").pos, position)
            np.testing.assert_allclose(model.body(f"{leg}_{link}").ipos, centre)
        np.testing.assert_allclose(model.geom(leg).pos, (0.0, 0.0, -0.213))
        assert model.geom(leg).size[0] == 0.023
    np.testing.assert_allclose(model.body("trunk").ipos, (0.0223, 0.002, -0.0005))
    np.testing.assert_allclose(model.dof_frictionloss[6:], [0.3, 0.3, 1.0] * 4)
    np.testing.assert_allclose(model.dof_damping[6:], 0.5)
    np.testing.assert_allclose(model.dof_armature[6:], 0.005)
    assert model.opt.timestep == 0.004


def test_inertia_is_the_published_one_about_its_principal_axes(model):
    """The published diagonal is of axes that are turned; traces and determinants are of none."""
    for body, published in {
        "trunk": (0.0716565, 0.0630105, 0.0168101),
        "RL_hip": (0.000734064, 0.000468438, 0.000398719),
        "FR_thigh": (0.00478717, 0.00460903, 0.000709268),
        "RR_calf": (0.00149767, 0.00148468, 3.58427e-05),
    }.items():
        np.testing.assert_allclose(model.body(body).inertia, published, rtol=2e-3)


@pytest.mark.parametrize(
    ("link", "one", "other", "mirror"),
    [
        ("hip", "FL", "FR", (1, -1, 1)),
        ("hip", "FL", "RL", (-1, 1, 1)),
        ("hip", "FL", "RR", (-1, -1, 1)),
        ("thigh", "FL", "FR", (1, -1, 1)),
        ("thigh", "FL", "RL", (1, 1, 1)),
        ("calf", "FL", "RR", (1, 1, 1)),
    ],
)
def test_legs_mirror_each_other(model, link, one, other, mirror):
    first, second = model.body(f"{one}_{link}"), model.body(f"{other}_{link}")
    np.testing.assert_allclose(second.ipos, first.ipos * mirror)
    reflection = np.diag(mirror)
    expected = reflection @ inertia(model, f"{one}_{link}") @ reflection
    np.testing.assert_allclose(inertia(model, f"{other}_{link}"), expected, atol=1e-9)


def test_feet_of_the_home_pose_touch_the_floor():
    simulation = Simulation(build_spec().compile())
    simulation.reset()
    np.testing.assert_allclose(simulation.motion.foot_heights, FOOT_RADIUS, atol=1e-4)


def test_the_home_pose_stands():
    simulation = Simulation(build_spec().compile())
    simulation.reset()
    for _ in range(100):
        simulation.advance(HOME)
    motion = simulation.motion
    assert 0.25 < motion.height < 0.30
    assert motion.foot_contacts.all()
    np.testing.assert_allclose(motion.gravity, [0, 0, -1], atol=0.06)
    np.testing.assert_allclose(motion.velocity, 0.0, atol=0.01)


def test_only_feet_collide_and_only_with_the_floor(model):
    floor, feet = model.geom("floor").id, [model.geom(leg).id for leg in LEGS]
    for first in range(model.ngeom):
        for second in range(first + 1, model.ngeom):
            one, other = model.geom(first), model.geom(second)
            collide = one.contype[0] & other.conaffinity[0] or other.contype[0] & one.conaffinity[0]
            assert bool(collide) == (floor in (first, second) and ({first, second} - {floor}).pop() in feet)
