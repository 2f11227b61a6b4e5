"""A baseline in a process of its own, which acts here like an SB3 model."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from baselines.protocol import Message, receive, send

STUDIES = Path(__file__).parents[1]
PATIENCE = 10.0  # seconds that a process has to end


class BaselineError(RuntimeError):
    """A baseline's process has ended too early. The message names its log and the last line of it."""


class Training(NamedTuple):
    """
    Results of a training.

    :param n_steps: gradient steps
    :param seconds: wall-clock time
    :param processor_seconds: what of it the process was computing
    """

    n_steps: int
    seconds: float
    processor_seconds: float


class BaselineProcess:
    """
    A baseline's worker on one core: :meth:`train` it, then ask it for actions, in a `with` statement.

    :param python: Python of the environment that has the baseline's packages
    :param module: the worker, which calls :func:`~baselines.protocol.serve`
    :param log: file that gets what the worker prints
    :ivar versions: of the baseline's packages, by name, once it is training
    """

    def __init__(self, python: Path, module: str, log: Path) -> None:
        self._log, self._module = log, module
        self.versions: dict[str, str] = {}
        paths = [str(STUDIES), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        answers, told = os.pipe()
        with log.open("w") as said:
            # A session of its own: Ctrl-C is ours to handle.
            self._process = subprocess.Popen(
                [str(python), "-m", module, str(told)],
                stdin=subprocess.PIPE,
                stdout=said,
                stderr=said,
                pass_fds=(told,),
                env=environment,
                start_new_session=True,
            )
        os.close(told)
        self._answers = os.fdopen(answers, "rb")

    def __enter__(self) -> "BaselineProcess":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None:  # it may be training
            self._process.send_signal(signal.SIGTERM)
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._answers.close()

    def train(
        self,
        dataset: Path,
        settings: dict[str, Any],
        seed: int,
        n_timesteps: int,
        minutes: float | None,
        on_progress: Callable[[int, int], None] = lambda done, n_steps: None,
    ) -> Training:
        """
        Let it learn.

        :param dataset: what `TrajectoryBuffer.save` has written
        :param settings: the worker's
        :param seed: of weights, batches and noise
        :param n_timesteps: gradient steps
        :param minutes: of one core, which may be less than that many steps take; None for all of them
        :param on_progress: told how many steps of how many are done
        :raises BaselineError: it has ended
        """
        self._begin(dataset, settings, seed, n_timesteps, minutes, in_parts=False)
        while (message := self._receive()).what == "progress":
            on_progress(message.values["done"], message.values["n_steps"])
        return Training(**message.values)

    def begin(self, dataset: Path, settings: dict[str, Any], seed: int, n_timesteps: int, minutes: float) -> None:
        """
        Have it ready to :meth:`learn` in parts; the arguments are those of :meth:`train`, and plan its schedules.

        :raises BaselineError: it has ended
        """
        self._begin(dataset, settings, seed, n_timesteps, minutes, in_parts=True)

    def learn(self, n_steps: int) -> float:
        """
        The next gradient steps.

        :param n_steps: how many
        :return: processor seconds of its process since it was started, without those of acting
        :raises BaselineError: it has ended
        """
        self._send("learn", n_steps=n_steps)
        return self._receive().values["processor_seconds"]

    def _begin(self, dataset: Path, *job: Any, in_parts: bool) -> None:
        values = dict(zip(("settings", "seed", "n_timesteps", "minutes"), job, strict=True))
        self._send("train", dataset=str(dataset), in_parts=in_parts, **values)
        self.versions = self._receive().values["versions"]

    def predict(
        self,
        observation: dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, None]:
        """
        Actions (n_envs, A), as an SB3 model's `predict` has them. A baseline's process keeps its memory of an episode.

        :param observation: of `ReturnToGoWrapper`, (n_envs, .) each
        :param state: none
        :param episode_start: (n_envs,); the rows of an episode's first step are needed
        :param deterministic: baselines act so alone
        :raises ValueError: no `episode_start`, or not deterministic
        :raises BaselineError: it has ended
        """
        if episode_start is None or not deterministic:
            raise ValueError("A baseline needs episode_start and acts deterministically alone.")
        questions = {
            "observations": np.asarray(observation["observation"], np.float32),
            "returns_to_go": np.asarray(observation["return_to_go"], np.float64).reshape(-1),
            "starts": np.asarray(episode_start, bool),
        }
        self._send("act", questions)
        return self._receive().arrays["actions"], None

    def action_ms(self) -> float:
        """
        Milliseconds of an action in one environment, of all so far, without the way through the pipe.

        :raises BaselineError: it has ended
        """
        self._send("timing")
        return self._receive().values["action_ms"]

    def _send(self, what: str, arrays: dict[str, np.ndarray] | None = None, **values: Any) -> None:
        try:
            send(self._process.stdin, what, arrays, **values)
        except BrokenPipeError:
            raise self._ended() from None

    def _receive(self) -> Message:
        try:
            return receive(self._answers)
        except EOFError:
            raise self._ended() from None

    def _ended(self) -> BaselineError:
        code = self._process.wait(PATIENCE)
        said = self._log.read_text().strip().splitlines() or ["nothing was written"]
        return BaselineError(f"{self._module} has ended with code {code}, see {self._log}: {said[-1]}")
