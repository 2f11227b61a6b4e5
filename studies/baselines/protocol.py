"""
Messages between a baseline's process and ours. Baselines need NumPy alone: their environment lacks sb3_dtfm.

A message is a line of JSON, which names the arrays after it with their types and shapes, and the bytes of these arrays.
"""

import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any, BinaryIO, NamedTuple, Protocol

import numpy as np

PROGRESS_INTERVAL = 0.5  # seconds
# Trial of a baseline's speed before its training is planned: longest seconds and steps, and first steps that do not count.
TRIAL_SECONDS, TRIAL_STEPS, FIRST_STEPS = 10.0, 500, 10
TIMED_ACTIONS = 16


class Message(NamedTuple):
    """
    A message of one side.

    :param what: for example "train"
    :param values: anything that JSON holds
    :param arrays: by name
    """

    what: str
    values: dict[str, Any]
    arrays: dict[str, np.ndarray]


def send(stream: BinaryIO, what: str, arrays: Mapping[str, np.ndarray] | None = None, **values: Any) -> None:
    """
    Say something.

    :raises BrokenPipeError: the other side is gone
    """
    held = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    shapes = [[name, array.dtype.str, array.shape] for name, array in held.items()]
    stream.write(json.dumps({"what": what, "values": values, "arrays": shapes}).encode() + b"\n")
    for array in held.values():
        stream.write(array.tobytes())
    stream.flush()


def receive(stream: BinaryIO) -> Message:
    """
    Wait for what the other side says.

    :raises EOFError: it is gone
    """
    line = stream.readline()
    if not line:
        raise EOFError("The other process has ended.")
    header = json.loads(line)
    arrays = {}
    for name, dtype, shape in header["arrays"]:
        content = stream.read(math.prod(shape) * np.dtype(dtype).itemsize)
        arrays[name] = np.frombuffer(content, dtype).reshape(shape).copy()
    return Message(header["what"], header["values"], arrays)


class Episode(NamedTuple):
    """
    One recorded episode.

    :param observations: (T, O) float32
    :param actions: (T, A) float32, scaled to [-1, 1]
    :param rewards: (T,) float32, environment reward units
    :param terminated: whether it ended in a terminal state
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool


class Dataset(NamedTuple):
    """
    Data that a baseline learns from.

    :param episodes: at least one
    :param low: (A,) smallest action
    :param high: (A,) largest action
    """

    episodes: list[Episode]
    low: np.ndarray
    high: np.ndarray

    def to_environment(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: (..., A) in [-1, 1]; what is outside is clipped
        :return: the same in the environment's range, float32
        """
        shares = (np.clip(actions, -1.0, 1.0) + 1.0) / 2.0
        return (self.low + shares * (self.high - self.low)).astype(np.float32)


def read_dataset(path: str) -> Dataset:
    """
    The episodes of a file that `TrajectoryBuffer.save` has written.

    :param path: of the `.npz` file
    """
    with np.load(path) as file:
        low, high, stops = file["action_low"], file["action_high"], file["episode_ends"]
        scaled = (2.0 * (file["actions"] - low) / (high - low) - 1.0).astype(np.float32)
        steps = [np.split(array, stops[:-1]) for array in (file["observations"], scaled, file["rewards"])]
        terminated = file["terminations"][stops - 1].tolist()
    return Dataset([Episode(*each) for each in zip(*steps, terminated, strict=True)], low, high)


class Learner(Protocol):
    """A baseline, ready to learn."""

    def learn(self, n_steps: int, after_step: Callable[[], None]) -> None:
        """
        :param n_steps: gradient steps
        :param after_step: to be called after each; may raise to end the training
        """

    def actor(self) -> Callable[[np.ndarray, float, bool], np.ndarray]:
        """
        Return what acts in one environment: observation (O,), return-to-go in reward units and whether an episode starts, to
        action (A,) in [-1, 1].
        """


# (settings, dataset, gradient steps that are planned, seed) -> learner
MakeLearner = Callable[[dict[str, Any], Dataset, int, int], Learner]


class _Enough(Exception):  # noqa: N818 - no error
    """A trial has taken long enough."""


def _seconds_per_step(learner: Learner) -> float:
    """Processor time of a gradient step, the mean over some after the first ones."""
    stamps: list[float] = [time.process_time()]

    def after_step() -> None:
        stamps.append(time.process_time())
        if len(stamps) > FIRST_STEPS + 1 and stamps[-1] - stamps[0] > TRIAL_SECONDS:
            raise _Enough

    with contextlib.suppress(_Enough):
        learner.learn(TRIAL_STEPS, after_step)
    measured = stamps[min(FIRST_STEPS, len(stamps) - 2) :]
    return (measured[-1] - measured[0]) / (len(measured) - 1)


def _planned_steps(job: dict[str, Any], make: MakeLearner, dataset: Dataset) -> int:
    """The authors' gradient steps, or what fits into the minutes of one core if that is less."""
    most = int(job["n_timesteps"])
    if job["minutes"] is None:
        return most
    seconds = _seconds_per_step(make(job["settings"], dataset, most, job["seed"]))
    return max(1, min(most, int(60.0 * job["minutes"] / seconds)))


def _train(job: dict[str, Any], make: MakeLearner, dataset: Dataset, stream: BinaryIO) -> Learner:
    n_steps = _planned_steps(job, make, dataset)
    learner = make(job["settings"], dataset, n_steps, job["seed"])
    done, reported = 0, 0.0
    start, processor_start = time.perf_counter(), time.process_time()

    def after_step() -> None:
        nonlocal done, reported
        done += 1
        if time.perf_counter() - reported >= PROGRESS_INTERVAL:
            reported = time.perf_counter()
            send(stream, "progress", done=done, n_steps=n_steps)

    learner.learn(n_steps, after_step)
    seconds, processor_seconds = time.perf_counter() - start, time.process_time() - processor_start
    send(stream, "trained", n_steps=done, seconds=seconds, processor_seconds=processor_seconds)
    return learner


def _milliseconds(times: list[float]) -> float:
    """Measure as `sb3_dtfm.benchmark.evaluation.action_ms` does: the median of the means over blocks."""
    n_blocks = max(1, len(times) // TIMED_ACTIONS)
    return 1e3 * float(np.median([np.mean(block) for block in np.array_split(times, n_blocks)]))


def _act(learner: Learner, dataset: Dataset, questions: BinaryIO, answers: BinaryIO, not_learning: float = 0.0) -> None:
    """Answer with actions until the other side is gone, and learn in between if asked to."""
    actors: list[Callable[[np.ndarray, float, bool], np.ndarray]] = []
    times: list[float] = []
    while True:
        paused = time.process_time()
        message = receive(questions)
        if message.what == "learn":
            learner.learn(message.values["n_steps"], lambda: None)
            send(answers, "learned", processor_seconds=time.process_time() - not_learning)
            continue
        if message.what == "timing":
            send(answers, "timing", action_ms=_milliseconds(times))
            continue
        asked_of = [message.arrays[name] for name in ("observations", "returns_to_go", "starts")]
        actors += [learner.actor() for _ in range(len(asked_of[0]) - len(actors))]
        actions = []
        for act, observation, return_to_go, start in zip(actors, *asked_of, strict=False):
            asked = time.perf_counter()
            actions.append(act(observation, float(return_to_go), bool(start)))
            times.append(time.perf_counter() - asked)
        send(answers, "actions", {"actions": dataset.to_environment(np.stack(actions))})
        not_learning += time.process_time() - paused


def serve(make: MakeLearner, packages: tuple[str, ...]) -> None:
    """
    Train as asked for and act, until the other side is gone: what a worker's main is. It is asked on the standard input and
    answers into the file descriptor that its argument names, since libraries print, some as they are imported.

    :param make: makes the baseline
    :param packages: whose versions are told
    """
    questions, answers = sys.stdin.buffer, os.fdopen(int(sys.argv[1]), "wb")
    job = receive(questions).values
    send(answers, "ready", versions={name: metadata.version(name) for name in packages})
    dataset, trial = read_dataset(job["dataset"]), 0.0
    if job["in_parts"]:
        began = time.process_time()
        n_steps = _planned_steps(job, make, dataset)
        trial = time.process_time() - began
        learner = make(job["settings"], dataset, n_steps, job["seed"])
    else:
        learner = _train(job, make, dataset, answers)
    try:
        _act(learner, dataset, questions, answers, trial)
    except EOFError:
        return
