"""The Go1's deployment: limits, watchdog, start and stop, with a stand-in for the second simulation's file."""

import importlib
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_dtfm import DT
from sb3_dtfm.data import load_dataset
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.envs.go1 import EPISODE_STEPS, env, model, second, simulation
from sb3_dtfm.envs.go1.env import observation_of
from tests.envs.go1.test_second import write_model

pytest.importorskip("onnxruntime")
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def deploy():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield importlib.import_module("deploy_go1")


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory) -> Path:
    """A policy without weights, whose action is 0: it stands."""
    arrays = {"observations": np.random.default_rng(0).normal(size=(21, 45)), "rewards": np.ones(20)}
    episodes = [{**arrays, "actions": np.zeros((20, 12))}]
    task = ReturnToGoWrapper(gym.make("Go1Velocity-v0"), 20.0)
    small = {"embed_dim": 8, "n_layers": 1, "n_heads": 1}
    agent = DT("MultiInputPolicy", task, load_dataset(episodes), batch_size=8, context_length=3, policy_kwargs=small)
    for weights in agent.policy.parameters():
        weights.data.zero_()
    path = tmp_path_factory.mktemp("policy") / "policy.onnx"
    agent.export(path, env_id="Go1Velocity-v0", target_return=20.0)
    return path


@pytest.fixture
def robot(deploy, tmp_path):
    return deploy.SimulatedRobot(str(write_model(tmp_path / "go1.xml")))


class Recorded:
    """A robot's commands, with other measurements if told."""

    def __init__(self, robot, **changes):
        self.robot, self.changes, self.commands = robot, changes, []

    def read(self):
        return self.robot.read()._replace(**self.changes)

    def command(self, targets, kp, kd):
        self.commands.append((targets, kp, kd))
        self.robot.command(targets, kp, kd)

    def wait(self):
        self.robot.wait()


def test_its_numbers_are_those_of_the_task(deploy):
    np.testing.assert_array_equal(deploy.HOME, model.HOME)
    np.testing.assert_array_equal(np.stack([deploy.LOW, deploy.HIGH], axis=1), model.JOINT_LIMITS)
    assert (deploy.KP, deploy.KD, deploy.TORQUE) == (model.KP, model.KD, second.TORQUE_LIMIT)
    assert (deploy.ACTION_SCALE, deploy.PERIOD, deploy.EPISODE_STEPS) == (
        env.ACTION_SCALE,
        simulation.DECISION,
        EPISODE_STEPS,
    )
    np.testing.assert_array_equal(deploy.LARGEST_COMMAND, env.COMMAND_LIMITS)


def test_it_says_first_that_hardware_was_never_tried(deploy):
    assert "NEVER TRIED ON HARDWARE" in "\n".join((EXAMPLES / "deploy_go1.py").read_text().splitlines()[:5])


def test_a_measurement_of_gravity_is_that_of_the_task(deploy, robot):
    robot.simulation.data.qpos[3:7] = np.array([0.8, 0.2, -0.4, 0.4])
    robot.simulation.data.qpos[3:7] /= np.linalg.norm(robot.simulation.data.qpos[3:7])
    np.testing.assert_allclose(robot.read().gravity, robot.simulation.motion.gravity, atol=1e-12)


def test_it_stands_up_and_lies_down_within_all_limits(deploy, robot, policy_file):
    recorded = Recorded(robot)
    heights = []
    wait = recorded.wait
    recorded.wait = lambda: (wait(), heights.append(robot.simulation.data.qpos[2]))
    policy = deploy.Policy(str(policy_file))
    milliseconds = deploy.run(recorded, policy, np.zeros(3), seconds=1.0, patience=30.0)
    assert len(milliseconds) == 50
    assert len(heights) == 250
    assert heights[0] < 0.12
    assert 0.24 < min(heights[110:150]) <= max(heights[110:150]) < 0.31
    assert heights[-1] < 0.15
    targets = np.array([targets for targets, kp, _ in recorded.commands if kp > 0])
    assert len(targets) == 250
    assert (targets >= deploy.LOW).all()
    assert (targets <= deploy.HIGH).all()
    assert np.abs(np.diff(targets, axis=0)).max() < 0.15  # nothing jumps
    assert recorded.commands[-1][1:] == (0.0, deploy.DAMPING)


def test_a_policy_sees_the_observation_of_the_task(deploy, robot, policy_file):
    policy, seen = deploy.Policy(str(policy_file)), []
    policy.act = lambda *arguments: (seen.append((robot.simulation.motion, arguments)), np.full(12, 0.1 * len(seen)))[1]
    command = np.array([0.3, 0.0, -0.2])
    with deploy.Guard(robot, 30.0) as guard:
        deploy.move(guard, deploy.HOME, 1.0)
        deploy.walk(guard, policy, command, 5, threading.Event())
    assert [timestep for _, (_, _, timestep) in seen] == [0, 1, 2, 3, 4]
    assert [left for _, (_, left, _) in seen] == pytest.approx([20.0, 19.98, 19.96, 19.94, 19.92])
    for step, (motion, (observation, *_)) in enumerate(seen):
        asked = [0.02, 0.04, 0.04, 0.02, 0.0][step] * command  # grows and falls by a fiftieth a step
        np.testing.assert_allclose(observation, observation_of(motion, np.full(12, 0.1 * step), asked), atol=1e-6)


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_a_command_grows_and_falls_to_zero_also_if_a_walk_is_interrupted(deploy, robot, policy_file, is_interrupted):
    policy, seen, ended = deploy.Policy(str(policy_file)), [], threading.Event()

    def act(observation, *_):
        seen.append(observation[-3])
        if is_interrupted and len(seen) == 60:
            ended.set()
        return np.zeros(12)

    policy.act = act
    with deploy.Guard(robot, 30.0) as guard:
        deploy.move(guard, deploy.HOME, 1.0)
        deploy.walk(guard, policy, np.array([1.0, 0.0, 0.0]), 200, ended)
    assert len(seen) == (110 if is_interrupted else 200)
    assert (max(seen), seen[-1]) == (1.0, 0.0)
    assert np.abs(np.diff([0.0, *seen])).max() == pytest.approx(0.02, abs=1e-6)


def test_the_keyboard_ends_a_walk_and_then_the_run(deploy):
    before = signal.getsignal(signal.SIGINT)
    with deploy.ended_by_keyboard() as ended:
        signal.raise_signal(signal.SIGINT)
        assert ended.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)  # too often
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("n_commands", [30, 150])
def test_the_keyboard_lets_a_robot_lie_down_while_it_stands_up_or_walks(deploy, robot, policy_file, n_commands, capsys):
    recorded = Recorded(robot)
    wait = recorded.wait

    def wait_or_interrupt():
        if len(recorded.commands) == n_commands:
            signal.raise_signal(signal.SIGINT)
        wait()

    recorded.wait = wait_or_interrupt
    policy = deploy.Policy(str(policy_file))
    milliseconds = deploy.run(recorded, policy, np.array([0.5, 0.0, 0.0]), seconds=60.0, patience=30.0)
    assert "Interrupted; lying down" in capsys.readouterr().out
    n_walked = {30: 0, 150: 50 + 50}[n_commands]  # the command falls as long as it has grown
    assert len(milliseconds) == n_walked
    assert len([kp for _, kp, _ in recorded.commands if kp > 0.0]) == {30: 30, 150: 100}[n_commands] + n_walked + 100
    np.testing.assert_allclose(recorded.commands[-2][0], deploy.DOWN)


def test_a_terminated_process_lets_the_robot_sink_down(deploy, robot):
    recorded = Recorded(robot)
    numbers = (*deploy.ENDING, signal.SIGINT)
    before = [signal.getsignal(number) for number in numbers]
    try:
        signal.signal(signal.SIGTERM, deploy.terminate)
        with pytest.raises(SystemExit, match="sinks down"), deploy.Guard(recorded, 30.0):
            signal.raise_signal(signal.SIGTERM)
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    assert recorded.commands[-1][1:] == (0.0, deploy.DAMPING)


def test_a_command_beyond_that_of_training_is_refused_before_anything_moves(deploy, robot, policy_file):
    recorded = Recorded(robot)
    for wrong in ([100.0, 0.0, 0.0], [0.0, np.nan, 0.0]):
        with pytest.raises(ValueError, match=r"is beyond \[1.5, 0.8, 1.2\]"):
            deploy.run(recorded, deploy.Policy(str(policy_file)), np.array(wrong), 1.0)
    for seconds in (np.inf, np.nan):
        with pytest.raises(ValueError, match=f"seconds is {seconds}; a number of them is expected"):
            deploy.run(recorded, deploy.Policy(str(policy_file)), np.zeros(3), seconds)
    assert not recorded.commands


def test_targets_stay_within_joint_and_torque_limits(deploy, robot):
    recorded, velocities = Recorded(robot), np.linspace(-20.0, 20.0, 12)
    standing = robot.read()._replace(positions=deploy.HOME, velocities=np.zeros(12))
    with deploy.Guard(recorded, 30.0) as guard:
        guard.send(deploy.HOME + 10.0, standing)
        guard.send(np.full(12, -10.0), standing._replace(positions=deploy.LOW + 0.1))
        for direction in (-10.0, 10.0):
            guard.send(deploy.HOME + direction, standing._replace(velocities=velocities))
    high, low, *moving = (targets for targets, *_ in recorded.commands[:4])
    np.testing.assert_allclose(high, np.minimum(deploy.HIGH, deploy.HOME + 23.7 / 35.0))
    np.testing.assert_allclose(low, deploy.LOW)
    for targets, torque in zip(moving, (-23.7, 23.7), strict=True):
        torques = 35.0 * (targets - deploy.HOME) - 0.5 * velocities
        is_free = (targets > deploy.LOW) & (targets < deploy.HIGH)  # of the joint's own limits
        assert is_free.sum() >= 6
        np.testing.assert_allclose(torques[is_free], torque)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"orientation": np.array([0.8, 0.6, 0.0, 0.0])}, "tilted by more than 60 degrees"),
        ({"velocities": np.full(12, 31.0)}, "faster than 30 rad/s"),
        ({"positions": np.full(12, -3.0)}, "rad beyond its limits"),
        ({"gyro": np.array([0.0, np.nan, 0.0])}, "not finite"),
        ({"positions": np.full(12, np.nan)}, "not finite"),
        ({"orientation": np.zeros(4)}, "no unit quaternion"),
        ({"age": 0.05}, "50 ms old"),
    ],
)
def test_what_is_beyond_a_limit_stops_the_robot(deploy, robot, changes, reason):
    recorded = Recorded(robot, **changes)
    with pytest.raises(deploy.StoppedError, match=reason), deploy.Guard(recorded, 30.0) as guard:
        deploy.move(guard, deploy.HOME, 1.0)
    assert recorded.commands[-1][1:] == (0.0, deploy.DAMPING)
    assert all(kp == 0.0 for _, kp, _ in recorded.commands)


@pytest.mark.parametrize("wrong", ["target", "position", "action", "infinite action"])
def test_a_target_that_is_not_finite_is_never_sent(deploy, robot, policy_file, wrong):
    recorded, measured = Recorded(robot), robot.read()
    policy = deploy.Policy(str(policy_file))
    policy.act = lambda *_: np.full(12, np.inf if wrong == "infinite action" else np.nan)
    act = {
        "target": lambda guard: guard.send(np.full(12, np.nan), measured),
        "position": lambda guard: guard.send(deploy.HOME, measured._replace(positions=np.full(12, np.nan))),
    }.get(wrong, lambda guard: deploy.walk(guard, policy, np.zeros(3), 5, threading.Event()))
    with pytest.raises(deploy.StoppedError, match="is not finite"), deploy.Guard(recorded, 30.0) as guard:
        act(guard)
    assert recorded.commands
    assert all(kp == 0.0 and np.isfinite(targets).all() for targets, kp, _ in recorded.commands)


def test_the_watchdog_stops_the_robot_while_a_policy_still_thinks(deploy, robot):
    recorded = Recorded(robot)
    with deploy.Guard(recorded, 30.0) as guard:
        guard.send(deploy.HOME, robot.read())
        guard.patience = 0.1  # from now on, so that a slow start is none of the policy
        time.sleep(0.4)
        during = list(recorded.commands)
        with pytest.raises(deploy.StoppedError, match="no command came for more than 100 ms"):
            guard.send(deploy.HOME, robot.read())
    assert during[0][1] == deploy.KP
    assert len(during) > 2, "again and again"
    assert all(kp == 0.0 for _, kp, _ in during[1:])
    assert all(kp == 0.0 for _, kp, _ in recorded.commands[1:])


def test_the_watchdog_tries_again_until_the_robot_takes_its_command(deploy, robot):
    recorded, failures = Recorded(robot), [OSError("no connection")] * 3

    def command(targets, kp, kd):
        if kp == 0.0 and failures:
            raise failures.pop()
        recorded.commands.append((targets, kp, kd))

    recorded.command = command
    with deploy.Guard(recorded, 30.0) as guard:
        guard.send(deploy.HOME, robot.read())
        guard.patience = 0.05
        wait_until(lambda: len(recorded.commands) >= 2)
    assert not failures
    assert recorded.commands[1][1:] == (0.0, deploy.DAMPING)


def test_the_watchdog_goes_on_where_the_end_does_not_reach_the_robot(deploy, robot):
    recorded, failures = Recorded(robot), [OSError("no connection")]

    def command(targets, kp, kd):
        if kp == 0.0 and failures:
            raise failures.pop()
        recorded.commands.append((targets, kp, kd))

    recorded.command = command
    guard = deploy.Guard(recorded, 30.0)

    def walk_and_leave():
        with guard:
            guard.send(deploy.HOME, robot.read())
            guard.patience = 0.05

    with pytest.raises(OSError, match="no connection"):
        walk_and_leave()
    assert recorded.commands[-1][1:] == (0.0, deploy.DAMPING)
    guard._watchdog.join(30.0)
    assert not guard._watchdog.is_alive(), "another guard may follow"


def test_the_watchdog_stops_the_robot_while_a_command_hangs(deploy, robot):
    recorded, is_hanging, is_released = Recorded(robot), threading.Event(), threading.Event()

    def command(targets, kp, kd):
        if kp > 0.0:
            is_hanging.set()
            is_released.wait(30.0)
        recorded.commands.append((targets, kp, kd))

    def send(guard):
        with pytest.raises(deploy.StoppedError, match="no command came"):
            guard.send(deploy.HOME, robot.read())

    recorded.command = command
    with deploy.Guard(recorded, 30.0) as guard:
        hanging = threading.Thread(target=send, args=[guard])
        hanging.start()
        wait_until(is_hanging.is_set)
        guard.patience = 0.05
        wait_until(lambda: len(recorded.commands) >= 1)
        is_released.set()
        hanging.join()
    gains = [kp for _, kp, _ in recorded.commands]
    assert gains.count(deploy.KP) == 1
    assert gains[0] == gains[-1] == 0.0, "before the command that hung, and after it"


def wait_until(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_it_runs_as_a_command_and_names_its_milliseconds(deploy, policy_file, tmp_path):
    model_file = write_model(tmp_path / "go1.xml")
    command = [sys.executable, str(EXAMPLES / "deploy_go1.py"), str(policy_file), "--model-file", str(model_file)]
    process = subprocess.run([*command, "--seconds", "1"], capture_output=True, text=True, check=False)
    if "no command came" in process.stderr:
        pytest.skip("the machine is too busy for a watchdog of 60 ms")
    assert process.returncode == 0, process.stderr
    assert "50 decisions: " in process.stdout
    assert "at the 99th percentile" in process.stdout


def test_it_needs_numpy_and_onnxruntime_alone(deploy):
    program = "import sys; sys.modules.update(torch=None, gymnasium=None, sb3_dtfm=None, mujoco=None); import deploy_go1"
    subprocess.run([sys.executable, "-c", program], cwd=EXAMPLES, check=True)
