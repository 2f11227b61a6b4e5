"""Runs the cells of the grid, each in a process of its own."""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml
from filelock import FileLock, Timeout

from sb3_dtfm.benchmark.cell import OUTPUT, PROGRESS, ROWS, SPEC
from sb3_dtfm.benchmark.display import Clock, Display, duration, make_display
from sb3_dtfm.benchmark.grid import Job, parse_arguments, plan
from sb3_dtfm.benchmark.provenance import n_cores
from sb3_dtfm.benchmark.rows import RowError, finished_cells, read_rows

CELL_MODULE = "sb3_dtfm.benchmark.cell"
POLL_INTERVAL = 0.2  # seconds
PATIENCE = 10.0  # seconds that a process has to end after SIGTERM


@dataclass
class RunningCell:
    """A cell whose process is running."""

    job: Job
    folder: Path
    process: subprocess.Popen[bytes]
    lock: FileLock
    start: float

    def progress(self) -> tuple[int, int, str]:
        """Gradient steps done, gradient steps in all, and what is going on."""
        try:
            n_done, n_steps, what = json.loads((self.folder / PROGRESS).read_text())
        except FileNotFoundError:
            return 0, self.job.n_steps, "starting"
        return n_done, n_steps, what

    def end(self) -> None:
        """End the process and those that it started for its environments."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGTERM)
            try:
                self.process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()
        self.lock.release()


class Runner:
    """
    Keeps `--jobs` cells running until none is left.

    :param jobs: cells to run, in this order
    :param options: of :func:`~sb3_dtfm.benchmark.grid.parse_arguments`
    """

    def __init__(self, jobs: Sequence[Job], options: argparse.Namespace) -> None:
        self.pending = list(jobs)
        self.options = options
        self.results = Path(options.results)
        self.logs = Path(options.log_folder)
        self.running: list[RunningCell] = []
        self.failed: list[Path] = []
        self.skipped: list[Job] = []
        self.n_jobs, self.n_done = len(self.pending), 0
        self._steps_done = 0
        self._clock = Clock(sum(job.n_steps for job in jobs))

    def run(self) -> None:
        """Run all cells; one that fails does not stop the others."""
        self.results.mkdir(parents=True, exist_ok=True)
        with make_display(self.n_jobs) as display:
            try:
                while self.pending or self.running:
                    while self.pending and len(self.running) < self.options.jobs:
                        self._start(self.pending.pop(0), display)
                    for cell in [cell for cell in self.running if cell.process.poll() is not None]:
                        self.running.remove(cell)
                        self._finish(cell, display)
                    self._show(display)
                    if self.running:
                        time.sleep(POLL_INTERVAL)
            finally:
                for cell in self.running:
                    cell.end()

    def _start(self, job: Job, display: Display) -> None:
        """Start a cell, unless another call of the command is at it or has finished it meanwhile."""
        name = job.cell.file_name
        locks = self.results / ".locks"
        locks.mkdir(exist_ok=True)
        lock = FileLock(locks / f"{name}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            display.say(f"{job.cell}: another process is running it")
            self.skipped.append(job)
            return
        if (self.results / f"{name}.jsonl").exists():
            lock.release()
            self.n_done += 1
            return
        shutil.rmtree(self.logs / name, ignore_errors=True)
        (self.logs / name).mkdir(parents=True, exist_ok=True)
        # A folder for each attempt: what a killed grid leaves behind may still be writing into its own.
        folder = Path(tempfile.mkdtemp(prefix="attempt-", dir=self.logs / name))
        (folder / SPEC).write_text(json.dumps(self._spec(job, folder)))
        (folder / "settings.yml").write_text(yaml.safe_dump({job.cell.task: job.settings}))
        command = [sys.executable, "-m", CELL_MODULE, str(folder / SPEC)]
        environment = {key: value for key, value in os.environ.items() if key not in ("RANK", "WORLD_SIZE")}
        environment["OMP_NUM_THREADS"] = str(self._n_threads())
        with (folder / OUTPUT).open("wb") as output:
            # A session of its own: Ctrl-C would have RL-Zoo save the model and end as if all were well.
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, env=environment, start_new_session=True
            )
        self.running.append(RunningCell(job, folder, process, lock, time.monotonic()))
        display.say(f"[{self._n_started()}/{self.n_jobs}] {job.cell}: {job.n_steps:,} gradient steps")

    def _n_started(self) -> int:
        return self.n_jobs - len(self.pending)

    def _n_threads(self) -> int:
        share = max(1, n_cores() // self.options.jobs)
        given = os.environ.get("OMP_NUM_THREADS", "")
        return min(share, int(given)) if given.isdigit() and int(given) > 0 else share

    def _spec(self, job: Job, folder: Path) -> dict[str, Any]:
        """What the cell's process reads."""
        cell, options = job.cell, self.options
        train = ["--algo", cell.algo, "--env", cell.task, "--seed", str(cell.seed)]
        train += ["--conf-file", str(folder / "settings.yml"), "--log-folder", str(folder / "logs"), "--verbose", "0"]
        train += ["--eval-freq", str(job.eval_freq), "--eval-episodes", str(options.eval_episodes)]
        train += ["--n-eval-envs", str(options.n_eval_envs), "--vec-env", options.vec_env, "--device", options.device]
        train += ["--num-threads", str(self._n_threads())]
        if options.env_kwargs:
            train += ["--env-kwargs", *options.env_kwargs]
        row = {**cell._asdict(), "settings": job.settings, "data": job.data}
        return {"train": train, "row": row, "final_episodes": options.final_episodes, "parent": os.getpid()}

    def _finish(self, cell: RunningCell, display: Display) -> None:
        """Publish the rows of a cell whose process has ended, or note that it failed."""
        self._steps_done += cell.job.n_steps
        took = duration(time.monotonic() - cell.start)
        try:
            if cell.process.returncode == 0 and self._publish(cell):
                self.n_done += 1
                display.say(f"{cell.job.cell}: done in {took}")
            else:
                self.failed.append(cell.folder / OUTPUT)
                display.say(f"{cell.job.cell}: FAILED after {took}, see {cell.folder / OUTPUT}")
        finally:
            cell.lock.release()

    def _publish(self, cell: RunningCell) -> bool:
        """Make the rows appear in the results all at once; False if the final evaluation is not among them."""
        part = cell.folder / ROWS
        try:
            rows = read_rows(part) if part.exists() else []
        except RowError:
            return False
        if cell.job.cell not in finished_cells(rows):
            return False
        name = f"{cell.job.cell.file_name}.jsonl"
        beside = self.results / f".{name}.part"  # the logs may lie in another file system
        shutil.copyfile(part, beside)
        beside.replace(self.results / name)
        return True

    def _show(self, display: Display) -> None:
        running = {cell.job.cell: cell.progress() for cell in self.running}
        n_steps = self._steps_done + sum(step for step, _, _ in running.values())
        display.update(self.n_done, self._clock.remaining(n_steps), running)


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm benchmark`.

    :param argv: its arguments
    :raises SystemExit: with code 1 if a cell failed or was left to another process, 130 if interrupted
    """
    options = parse_arguments(argv)
    jobs, done = plan(options)
    print(f"{len(jobs)} cells to run, {len(done)} finished already in {options.results}", flush=True)
    runner = Runner(jobs, options)
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        runner.run()
    except KeyboardInterrupt:
        print(f"Interrupted after {runner.n_done} of {len(jobs)} cells; the same command goes on.", flush=True)
        raise SystemExit(130) from None
    finally:
        signal.signal(signal.SIGTERM, before)
    if runner.failed or runner.skipped:
        print(f"{len(runner.failed)} of {len(jobs)} cells failed, {len(runner.skipped)} are left to other processes.")
        for log in runner.failed:
            print(f"{log}: {_last_line(log)}")
        raise SystemExit(1)
    print(f"All {len(jobs) + len(done)} cells are finished: sb3-dtfm report {options.results}", flush=True)


def _interrupt(*_: Any) -> NoReturn:
    """
    :raises KeyboardInterrupt: on which the running cells are ended
    """
    raise KeyboardInterrupt


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "nothing was written"
