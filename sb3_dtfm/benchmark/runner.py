"""Runs of a grid, each as `sb3-dtfm train`, or behaviour cloning, in a process of its own."""

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from datetime import timedelta
from pathlib import Path
from threading import Lock
from typing import Any

import yaml
from filelock import FileLock, Timeout
from huggingface_sb3 import EnvironmentName
from tqdm import tqdm

from sb3_dtfm.benchmark.evaluation import PROGRESS
from sb3_dtfm.benchmark.grid import Job
from sb3_dtfm.benchmark.provenance import n_cores
from sb3_dtfm.benchmark.rows import BASELINES, RowError, finished_runs, read_rows
from sb3_dtfm.files import replacing
from sb3_dtfm.zoo.resuming import CHECKPOINT, START

TRAIN = [sys.executable, "-m", "sb3_dtfm", "train"]
CLONE = [sys.executable, "-m", "sb3_dtfm.benchmark.cloning"]
CALLBACK = "sb3_dtfm.benchmark.evaluation.EvaluationCallback"
ROWS, SETTINGS, OUTPUT, LOGS = "rows.jsonl", "settings.yml", "output.log", "logs"
PATIENCE = 10.0  # seconds that a process has to end after SIGTERM


class Runner:
    """
    Runner that keeps `--jobs` runs going until none is left.

    :param jobs: runs to start, in this order
    :param options: arguments of `sb3-dtfm benchmark`
    """

    def __init__(self, jobs: Sequence[Job], options: argparse.Namespace) -> None:
        self.jobs = jobs
        self.options = options
        self.results = Path(options.results)
        self.done: list[Job] = []
        self.failed: list[Path] = []  # their logs
        self.left: list[Job] = []  # to another call of the command
        share = max(1, n_cores() // options.jobs)
        given = os.environ.get("OMP_NUM_THREADS", "")
        self._n_threads = min(share, int(given)) if given.isdigit() and int(given) > 0 else share
        self._processes: list[subprocess.Popen[str]] = []
        self._lock = Lock()
        self._stopping = False
        self._bar = _bar("grid", sum(job.n_steps for job in jobs))

    def run(self) -> None:
        """Start all runs; one that fails does not stop the others, an interrupt ends them."""
        with self._bar, ThreadPoolExecutor(self.options.jobs) as pool:
            futures = [pool.submit(self._run_job, job) for job in self.jobs]
            try:
                for future in as_completed(futures):
                    future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
                self._end_processes()

    def _run_job(self, job: Job) -> None:
        """Start a run, unless another call of the command is at it or has finished it meanwhile."""
        name = job.key.file_name
        try:
            with contextlib.ExitStack() as locks:
                # Either may be another call's, too, or both the same.
                for folder in {self.results.resolve(), Path(self.options.log_folder).resolve()}:
                    (folder / ".locks").mkdir(parents=True, exist_ok=True)
                    locks.enter_context(FileLock(folder / ".locks" / f"{name}.lock").acquire(timeout=0))
                if (self.results / f"{name}.jsonl").exists():
                    self.done.append(job)
                else:
                    self._train(job, self._prepare(job))
        except Timeout:
            _say(f"{job.key}: another process is running it")
            self.left.append(job)

    def _prepare(self, job: Job) -> Path:
        """
        A folder with a run's settings, new for each attempt: an orphan may still be writing into an older one.

        The files of the last attempt with equal settings are copied. An interrupted attempt with other settings is kept.
        """
        logs, options, env_id = Path(self.options.log_folder) / job.key.file_name, self.options, job.task.env_id
        logs.mkdir(parents=True, exist_ok=True)
        earlier = sorted(logs.glob("attempt-*"), key=lambda path: path.stat().st_mtime)
        folder = Path(tempfile.mkdtemp(prefix="attempt-", dir=logs))
        arguments = {
            "rows": str(folder / ROWS),
            "row": job.row,
            "eval_freq": job.eval_freq,
            "n_episodes": options.eval_episodes,
            "n_final_episodes": options.final_episodes,
            "n_envs": options.n_eval_envs,
            "subprocesses": options.vec_env == "subproc",
        }
        own = job.settings.get("callback") or []
        callbacks = [*(own if isinstance(own, list) else [own]), {CALLBACK: arguments}]
        settings = yaml.safe_dump({env_id: {**job.settings, "callback": callbacks}})
        equal = [attempt for attempt in earlier if _settings_of(attempt).replace(str(attempt), str(folder)) == settings]
        # Settings are written last: an attempt that was killed while it copied is no attempt.
        for attempt in sorted(equal, key=_has_checkpoint)[-1:]:
            with contextlib.suppress(OSError):  # killed before it had anything
                shutil.copytree(attempt / LOGS, folder / LOGS)
                shutil.copyfile(attempt / ROWS, folder / ROWS)
        (folder / SETTINGS).write_text(settings)
        for attempt in earlier:
            if attempt in equal or not _settings_of(attempt) or not _has_checkpoint(attempt):
                shutil.rmtree(attempt, ignore_errors=True)
            else:
                _say(f"{job.key}: {attempt} holds an interrupted run with other settings, which is kept")
        return folder

    def _train(self, job: Job, folder: Path) -> None:
        start = time.monotonic()
        with self._start(job, folder) as process:
            n_started = self._processes.index(process) + 1
            _say(f"[{n_started}/{len(self.jobs)}] {job.key}: {job.n_steps:,} gradient steps")
            self._follow(process, job, folder / OUTPUT)
        took = timedelta(seconds=round(time.monotonic() - start))
        if process.returncode == 0 and self._publish(job, folder / ROWS):
            self.done.append(job)
            _say(f"{job.key}: done in {took}")
        elif not self._stopping:
            self.failed.append(folder / OUTPUT)
            _say(f"{job.key}: FAILED after {took}, see {folder / OUTPUT}")

    def _start(self, job: Job, folder: Path) -> subprocess.Popen[str]:
        """
        The run's process.

        :raises CancelledError: the grid is being ended
        """
        is_baseline = job.key.algo in BASELINES
        command = [*CLONE, str(folder / SETTINGS)] if is_baseline else self._train_command(job, folder)
        if packages := [*self.options.gym_packages, *job.task.gym_packages]:
            command += ["--gym-packages", *packages]
        environment = {key: value for key, value in os.environ.items() if key not in ("RANK", "WORLD_SIZE")}
        environment["OMP_NUM_THREADS"] = str(self._n_threads)
        # A session of its own: Ctrl-C would have RL-Zoo save the model and end as if all were well.
        pipes: dict[str, Any] = dict(stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        with self._lock:
            if self._stopping:
                raise CancelledError
            process = subprocess.Popen(
                command, **pipes, text=True, errors="replace", env=environment, start_new_session=True
            )
            self._processes.append(process)
        return process

    def _train_command(self, job: Job, folder: Path) -> list[str]:
        """`sb3-dtfm train` of a run, which resumes from its checkpoint if it left one."""
        command = [*TRAIN, "--algo", job.key.algo, "--env", job.task.env_id, "--seed", str(job.key.seed)]
        command += ["--conf-file", str(folder / SETTINGS), "--log-folder", str(folder / LOGS), "--eval-freq", "-1"]
        command += ["--verbose", "0", "--device", self.options.device, "--num-threads", str(self._n_threads)]
        # RL-Zoo's name for an attempt's only run.
        run = folder / LOGS / job.key.algo / f"{EnvironmentName(job.task.env_id)}_1"
        if (run / START).is_file() and (folder / ROWS).is_file():
            command += ["--resume", str(run)]
        return command

    def _follow(self, process: subprocess.Popen[str], job: Job, log: Path) -> None:
        """Show how far the run is, and keep what else it prints, until it ends."""
        assert process.stdout is not None
        key = job.key
        name = f"{key.task} {key.data_share:.0%} {key.algo} seed {key.seed} {key.label}".strip()
        with log.open("w", buffering=1) as file, _bar(name, job.n_steps) as bar:
            for line in process.stdout:
                found = PROGRESS.fullmatch(line)
                if found is None:
                    file.write(line)
                    continue
                bar.set_postfix_str(found[3], refresh=False)
                self._bar.set_postfix_str(f"{len(self.done)} of {len(self.jobs)} runs", refresh=False)
                n_new = int(found[1]) - bar.n
                bar.update(n_new)
                self._bar.update(n_new)
            self._bar.update(job.n_steps - bar.n)

    def _publish(self, job: Job, rows: Path) -> bool:
        """Make the rows appear in the results all at once; False if the final evaluation is not among them."""
        try:
            if job.key not in finished_runs(read_rows(rows)):
                return False
        except (FileNotFoundError, RowError):
            return False
        with replacing(self.results / f"{job.key.file_name}.jsonl") as beside:
            shutil.copyfile(rows, beside)
        return True

    def _end_processes(self) -> None:
        """End the runs and what they started for their environments."""
        with self._lock:
            self._stopping = True
        running = [process for process in self._processes if process.poll() is None]
        for process in running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        for process in running:
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)


def _bar(name: str, n_steps: int) -> tqdm:
    """Gradient steps and the time to go; without a terminal it shows once a minute, during evaluations, too."""
    interval = 0.5 if sys.stderr.isatty() else 60.0
    return tqdm(desc=name, total=n_steps, leave=False, smoothing=0, miniters=0, mininterval=interval)


def _say(message: str) -> None:
    """Print a line that stays."""
    tqdm.write(message)
    sys.stdout.flush()


def run_grid(jobs: Sequence[Job], n_finished: int, options: argparse.Namespace) -> None:
    """
    Run the rest of a grid, and report the outcome.

    :param jobs: runs to start
    :param n_finished: number of finished runs, which are not started again
    :param options: arguments of `sb3-dtfm benchmark`
    :raises SystemExit: with code 1 if a run failed or was left to another process, 130 if interrupted
    """
    print(f"{len(jobs)} runs to start, {n_finished} finished already in {options.results}", flush=True)
    runner = Runner(jobs, options)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        runner.run()
    except KeyboardInterrupt:
        print(f"Interrupted after {len(runner.done)} of {len(jobs)} runs; run the same command to continue.", flush=True)
        raise SystemExit(130) from None
    finally:
        signal.signal(signal.SIGTERM, before)
    if runner.failed or runner.left:
        print(f"{len(runner.failed)} of {len(jobs)} runs failed, {len(runner.left)} are left to other processes.")
        for log in runner.failed:
            print(f"{log}: {(log.read_text().strip().splitlines() or ['nothing was written'])[-1]}")
        raise SystemExit(1)
    print(f"All {len(jobs) + n_finished} runs are finished: sb3-dtfm report {options.results}", flush=True)


def _has_checkpoint(attempt: Path) -> bool:
    return any(attempt.rglob(CHECKPOINT))


def _settings_of(attempt: Path) -> str:
    """Read the settings of an attempt, empty if it was killed before it had any."""
    with contextlib.suppress(OSError):
        return (attempt / SETTINGS).read_text()
    return ""
