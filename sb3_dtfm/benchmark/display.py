"""What `sb3-dtfm benchmark` shows while it runs: bars on a terminal, plain lines elsewhere."""

import sys
import time
from types import TracebackType
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from sb3_dtfm.benchmark.rows import Cell

PLAIN_INTERVAL = 60.0  # seconds between two plain lines on the running cells


def duration(seconds: float) -> str:
    """A length of time in at most two units."""
    minutes, hours = int(seconds // 60), int(seconds // 3600)
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if hours == 0 else f"{hours} h {minutes % 60} min"


class Clock:
    """
    How long the grid still takes, at the pace of this call of the command.

    :param n_steps: gradient steps of all cells to run
    """

    def __init__(self, n_steps: int) -> None:
        self.n_steps = n_steps
        self._start = time.monotonic()

    def remaining(self, n_done: int) -> str:
        """
        :param n_done: gradient steps done by now, failed cells' included
        """
        if n_done == 0:
            return "time to go not known yet"
        if n_done >= self.n_steps:  # evaluations may still take a while
            return "finishing"
        return f"about {duration((self.n_steps - n_done) * (time.monotonic() - self._start) / n_done)} to go"


class Display(Protocol):
    """What the runner tells; `running` holds gradient steps done, gradient steps in all, and what is going on."""

    def __enter__(self) -> "Display": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def say(self, message: str) -> None:
        """A line that stays."""

    def update(self, n_done: int, remaining: str, running: dict[Cell, tuple[int, int, str]]) -> None:
        """How far the grid is."""


class PlainDisplay:
    """
    One line for each event, and one for each running cell every minute.

    :param n_cells: cells to run
    """

    def __init__(self, n_cells: int) -> None:
        self.n_cells = n_cells
        self._last = time.monotonic()

    def __enter__(self) -> "PlainDisplay":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        pass

    def say(self, message: str) -> None:
        print(message, flush=True)

    def update(self, n_done: int, remaining: str, running: dict[Cell, tuple[int, int, str]]) -> None:
        if time.monotonic() - self._last < PLAIN_INTERVAL:
            return
        self._last = time.monotonic()
        for cell, (step, n_steps, what) in running.items():
            print(f"{cell}: step {step:,} of {n_steps:,}, {what}; {n_done} of {self.n_cells} cells, {remaining}", flush=True)


def _short(cell: Cell) -> str:
    return f"{cell.task} {cell.regime:.0%} {cell.algo} seed {cell.seed} {cell.label}".strip()


class RichDisplay:
    """
    A bar for the grid and one for each running cell.

    :param n_cells: cells to run
    """

    def __init__(self, n_cells: int) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(12), MofNCompleteColumn(), TextColumn("{task.fields[what]}"))
        self._progress = Progress(*columns, console=Console())
        self._grid = self._progress.add_task("cells", total=n_cells, what="")
        self._bars: dict[Cell, TaskID] = {}

    def __enter__(self) -> "RichDisplay":
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._progress.stop()

    def say(self, message: str) -> None:
        self._progress.console.print(message, highlight=False, markup=False)

    def update(self, n_done: int, remaining: str, running: dict[Cell, tuple[int, int, str]]) -> None:
        self._progress.update(self._grid, completed=n_done, what=remaining)
        for cell in set(self._bars) - set(running):
            self._progress.remove_task(self._bars.pop(cell))
        for cell, (step, n_steps, what) in running.items():
            if cell not in self._bars:
                self._bars[cell] = self._progress.add_task(_short(cell), total=n_steps, what=what)
            self._progress.update(self._bars[cell], completed=step, what=what)


def make_display(n_cells: int) -> Display:
    """
    The display that fits standard output.

    :param n_cells: cells to run
    """
    return RichDisplay(n_cells) if sys.stdout.isatty() else PlainDisplay(n_cells)
