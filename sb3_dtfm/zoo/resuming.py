"""A run that goes on where it was interrupted: the same folder, one curve, every step as if nothing had happened."""

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch.distributed as dist
from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat, configure
from torch.utils.tensorboard import SummaryWriter

from sb3_dtfm.arguments import BOOLEAN, check_arguments
from sb3_dtfm.callbacks import EvaluateAtStartAndEnd
from sb3_dtfm.files import read_evaluations, replacing
from sb3_dtfm.finetuning import OnlineDTFM
from sb3_dtfm.zoo.arguments import START, UsageError

# File in an unfinished run's folder with the model as it was; START beside it says how the run was started.
CHECKPOINT = "checkpoint.zip"
# Lock of the process that trains the run.
LOCK = ".lock"
# File beside a model that learns online, with its own episodes.
EPISODES = "episodes.npz"
# Online algorithm of a run of "finetuned", as Stable-Baselines3 saves it.
AGENT = "agent"
CHECKPOINT_INTERVAL = 60.0  # seconds of training that a killed run loses at most
STOPPING = b"\nStopping after this gradient step, or in the midst of an evaluation; once more stops at once.\n"


class Start(NamedTuple):
    """
    The start of a run.

    :param arguments: arguments of RL-Zoo's `train`, or those of the command
    :param tensorboard: folder of its curves, None for none
    :param command: "train" or "finetune"
    :param has_checkpoint: whether a checkpoint has been saved since then; without one the run begins anew
    """

    arguments: list[str]
    tensorboard: str | None = None
    command: str = "train"
    has_checkpoint: bool = False

    def write(self, run: Path) -> None:
        """
        :param run: the run's folder
        """
        with replacing(run / START) as path:
            path.write_text(json.dumps(self._asdict(), indent=1))

    @classmethod
    def read(cls, run: Path, command: str = "train") -> "Start":
        """
        :param run: the run's folder
        :param command: command that is to go on with it
        :raises UsageError: no run of this package's, or of another command, or one that is finished or lacks its checkpoint
        """
        if not run.is_dir():
            raise UsageError(f"--resume {run}: no such folder; expected that of a run, as logs/dtfm/HalfCheetah-v5_1.")
        if not (run / START).is_file():
            agents = sorted(run.glob(f"{AGENT}*.zip"), key=lambda path: path.stat().st_mtime)
            if agents:
                raise UsageError(f"--resume {run}: it cannot resume; `finetune -i {agents[-1]}` continues in a new run.")
            raise UsageError(
                f"--resume {run}: nothing to go on with; the run is finished, or `sb3-dtfm {command}` did not start it."
            )
        try:
            start = cls(**json.loads((run / START).read_text()))
            strings = [*start.arguments, start.command, *([] if start.tensorboard is None else [start.tensorboard])]
            if not isinstance(start.arguments, list) or not all(isinstance(each, str) for each in strings):
                raise TypeError("expected a list of arguments, and the folder of its curves")
            check_arguments(start._asdict(), {"has_checkpoint": BOOLEAN})
        except (ValueError, TypeError, RecursionError) as error:
            raise UsageError(f"--resume {run}: {START} is damaged: {error}.") from error
        if start.command != command:
            raise UsageError(
                f"--resume {run}: `sb3-dtfm {start.command}` started it; sb3-dtfm {start.command} --resume continues it."
            )
        if start.has_checkpoint and not (run / CHECKPOINT).is_file():
            models = sorted(run.glob("[!.]*.zip"), key=os.path.getmtime)
            copied = f", or copy the run's newest model there: cp {models[-1]} {run / CHECKPOINT}" if models else ""
            raise UsageError(
                f"--resume {run}: {CHECKPOINT} is missing, where the run continues; it would begin anew and replace what "
                f"it has learned. Put the file back{copied}."
            )
        return start


class StopSignals:
    """
    Ctrl-C and SIGTERM end training between two gradient steps, or an evaluation: what is saved is a state that training can
    go on from.

    The second one interrupts at once. Several processes that train together leave the signals' handlers alone.

    :param between_steps: whether `asked` is read between steps; otherwise the first one interrupts at once, too
    """

    def __init__(self, between_steps: bool) -> None:
        self.between_steps = between_steps
        self.asked = False
        self.terminated = False
        self.at_once = False

    @contextlib.contextmanager
    def caught(self) -> Iterator[None]:
        """Catch signals while training."""
        if dist.is_initialized() or threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def watch(self, evaluation: EvalCallback) -> None:
        """
        Have the signals end an evaluation, too; a resumed run repeats it.

        :param evaluation: callback whose evaluations they end
        """
        count_successes: Any = evaluation._log_success_callback

        def after_step(*variables: dict[str, Any]) -> None:
            self.end_evaluation()
            count_successes(*variables)

        evaluation._log_success_callback = after_step  # type: ignore[method-assign,assignment]

    def end_evaluation(self, *_: Any) -> None:
        """
        End an evaluation between two of its steps, where `evaluate_policy` calls this.

        :raises KeyboardInterrupt: a signal has come
        """
        if self.asked:
            raise KeyboardInterrupt

    def _ask(self, number: int, _: Any) -> None:
        self.terminated |= number == signal.SIGTERM
        self.at_once = self.asked or not self.between_steps
        self.asked = True
        if self.at_once:
            raise KeyboardInterrupt
        os.write(2, STOPPING)


class KeepCheckpoint(BaseCallback):
    """
    Callback that saves the model now and then, and ends training on a signal. Put it behind all other callbacks.

    :param run: the run's folder
    :param signals: signals that may ask for an end
    :param start: start of the run
    """

    def __init__(self, run: Path, signals: StopSignals, start: Start) -> None:
        super().__init__()
        self.path = run / CHECKPOINT
        self.signals = signals
        self.start = start
        self.ended = False  # True when training has ended by itself
        self._lock = FileLock(run / LOCK)
        self._saved_at = 0.0
        self._ending = False

    def hold(self) -> None:
        """
        Keep the run to this process.

        :raises UsageError: another one is training it
        """
        try:
            with contextlib.suppress(NotImplementedError):  # a file system without locks
                self._lock.acquire(timeout=0)
        except Timeout:
            raise UsageError(
                f"--resume {self.path.parent}: another process is training it; wait for its end, or end it first."
            ) from None

    def _on_training_start(self) -> None:
        self._saved_at = time.monotonic()
        self._write_start()

    def _write_start(self) -> None:
        self.start._replace(tensorboard=self.logger.dir if self.model.tensorboard_log else None).write(self.path.parent)

    def _on_step(self) -> bool:
        if self._ending:
            raise KeyboardInterrupt
        self._ending = self.signals.asked  # a step later, when what follows an evaluation is logged, too
        if time.monotonic() - self._saved_at >= CHECKPOINT_INTERVAL:
            self.save()
        return True

    def _on_training_end(self) -> None:
        self.ended = True

    def save(self) -> None:
        """Save the model as it is, and its own episodes if it has any."""
        if isinstance(self.model, OnlineDTFM) and self.model.replay_buffer is not None:
            self.model.save_replay_buffer(self.path.with_name(EPISODES))
        self.model.save(self.path)
        self.start = self.start._replace(has_checkpoint=True)
        self._write_start()  # it is not there yet if the first evaluation was ended
        self._saved_at = time.monotonic()

    def remove(self) -> None:
        """Remove the checkpoint of a finished run, which has nothing to go on from."""
        self.path.unlink(missing_ok=True)
        (self.path.parent / START).unlink(missing_ok=True)

    def release(self) -> None:
        """Leave the run to others."""
        self.path.with_name(LOCK).unlink(missing_ok=True)
        self._lock.release()


class ReplaceEvaluations(BaseCallback):
    """
    Have `evaluations.npz` replaced when it is whole, where `EvalCallback` writes over it. Put it behind the evaluations.

    :param eval_callbacks: the evaluations, which from now on write a hidden file beside it
    """

    def __init__(self, eval_callbacks: Sequence[EvalCallback]) -> None:
        super().__init__()
        self.files = []
        for evaluation in eval_callbacks:
            if evaluation.log_path is not None:
                whole = _evaluations(evaluation)
                beside = whole.with_name(f".{whole.name}")
                self.files.append((beside, whole))
                evaluation.log_path = str(beside.with_suffix(""))  # NumPy adds it

    def drop_unfinished(self) -> None:
        """Drop what a killed process has left, which is perhaps not whole."""
        for beside, _ in self.files:
            beside.unlink(missing_ok=True)

    def _on_training_start(self) -> None:
        self._replace()

    def _on_step(self) -> bool:
        self._replace()
        return True

    def _on_training_end(self) -> None:
        self._replace()

    def _replace(self) -> None:
        for beside, whole in self.files:
            if beside.exists():
                with replacing(whole) as path:
                    path.write_bytes(beside.read_bytes())
                beside.unlink()


def _evaluations(callback: EvalCallback) -> Path:
    """The file of an evaluation that has one."""
    return Path(str(callback.log_path)).with_name("evaluations.npz")


def go_on(model: BaseAlgorithm, callbacks: Sequence[BaseCallback], start: Start) -> None:
    """
    Have logs and evaluations of a run follow those that there are, as far as the checkpoint.

    :param model: model of the checkpoint, or a new one where there was none
    :param callbacks: callbacks of the run
    :param start: start of the run
    :raises UsageError: evaluations are missing
    """
    n_steps = model.num_timesteps
    was_ended = False  # the checkpoint's evaluation, in its midst
    for callback in callbacks:
        if isinstance(callback, ReplaceEvaluations):
            callback.drop_unfinished()
    for callback in callbacks if n_steps else ():
        callback.n_calls = n_steps // (model.n_envs if isinstance(model, OnlineDTFM) else 1)
        if isinstance(callback, EvaluateAtStartAndEnd) and not was_ended:
            callback.go_on(n_steps)
        elif isinstance(callback, EvalCallback) and callback.log_path is not None:
            _restore_evaluations(callback, _evaluations(callback), n_steps)
            is_due = callback.eval_freq > 0 and callback.n_calls % callback.eval_freq == 0
            was_ended = not isinstance(model, OnlineDTFM) and is_due and n_steps not in callback.evaluations_timesteps
    if start.tensorboard is not None:
        logger = configure(start.tensorboard, ["stdout", "tensorboard"] if model.verbose else ["tensorboard"])
        for output in logger.output_formats:
            if isinstance(output, TensorBoardOutputFormat):
                output.writer.close()
                # Entries that the interrupted run logged after its checkpoint are then left out.
                output.writer = SummaryWriter(start.tensorboard, purge_step=n_steps + 1 if n_steps else 0)
        model.set_logger(logger)


def _restore_evaluations(callback: EvalCallback, path: Path, num_timesteps: int) -> None:
    """
    Keep the evaluations up to the checkpoint; the run comes to the others again.

    :raises UsageError: no evaluations that tell how good the best model is
    """
    try:
        saved = read_evaluations(path)
        kept = {name: array[saved["timesteps"] <= num_timesteps].tolist() for name, array in saved.items()}
        best = float(max(map(np.mean, kept["results"])))
        if not np.isfinite(best) or len({len(kept[name]) for name in ("timesteps", "results", "ep_lengths")}) > 1:
            raise ValueError("the evaluations do not go together")
    except Exception as error:  # a damaged archive can raise anything
        model = path.with_name("best_model.zip")
        if model.exists():
            raise UsageError(
                f"{path}: expected the evaluations up to step {num_timesteps}, which tell the score of {model} "
                f"({type(error).__name__}: {error}). Put the file back, or rename {model} to keep it, and resume again."
            ) from error
        return
    callback.evaluations_timesteps = kept["timesteps"]
    callback.evaluations_results, callback.evaluations_length = kept["results"], kept["ep_lengths"]
    callback.evaluations_successes = kept.get("successes", [])
    callback.best_mean_reward = best
