"""
The table and the figure of what :mod:`go1.contexts` measured.

    PYTHONPATH=studies python -m go1.report results/other/go1.csv --rows rows.jsonl    # writes the CSV file first
    PYTHONPATH=studies python -m go1.report results/other/go1.csv --figure docs/studies/go1.png
"""

import argparse
import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from go1.contexts import read_rows, simulations
from sb3_dtfm.benchmark.report.figures import STYLES
from sb3_dtfm.benchmark.report.statistics import wilson

COLUMNS = (
    *("algo", "label", "context_length", "seed", "simulation", "episodes", "falls", "error", "turn_error"),
    *("speed_share", "mean_return"),
    *("datasets", "hide_actions", "target_return", "n_timesteps", "wall_s", "commit", "settings", "hardware"),
)
SIMULATIONS = tuple(simulations(""))


class Cell(NamedTuple):
    """
    Runs that differ by their seeds.

    :param episodes: of all seeds
    :param falls: of these
    :param errors: of each seed, m/s
    :param turn_errors: of each seed, rad/s
    """

    episodes: int
    falls: int
    errors: tuple[float, ...]
    turn_errors: tuple[float, ...]


Cells = dict[tuple[str, str, int], dict[str, Cell]]  # by label, algorithm and context; by simulation


def write_table(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write the table; for runs that were judged twice, the row with the most episodes counts."""
    chosen: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        key = tuple(row[name] for name in COLUMNS[:5])
        if key not in chosen or row["episodes"] >= chosen[key]["episodes"]:
            chosen[key] = row
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in chosen.values():
            told = {name: row.get(name, "") for name in COLUMNS}
            writer.writerow(
                {name: json.dumps(value) if isinstance(value, dict | list) else value for name, value in told.items()}
            )


def read_cells(path: Path) -> Cells:
    """The rows of a table by cell."""
    grouped: dict[tuple[str, str, int], dict[str, list[dict[str, str]]]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            cell = grouped.setdefault((row["label"], row["algo"], int(row["context_length"])), {})
            cell.setdefault(row["simulation"], []).append(row)
    return {key: {name: _pool(rows) for name, rows in cell.items()} for key, cell in sorted(grouped.items())}


def _pool(rows: list[dict[str, str]]) -> Cell:
    episodes, falls = (sum(int(row[name]) for row in rows) for name in ("episodes", "falls"))
    errors, turn_errors = (tuple(float(row[name]) for row in rows) for name in ("error", "turn_error"))
    return Cell(episodes, falls, errors, turn_errors)


def print_table(cells: Cells) -> None:
    """Falls and errors, of all seeds together."""
    print("| label | algorithm | context |" + "".join(f" {name}: falls | error, m/s |" for name in SIMULATIONS))
    print("| --- | --- | --- |" + " --- | --- |" * len(SIMULATIONS))
    for (label, algo, context_length), cell in cells.items():
        shown = [_shown(cell[name]) if name in cell else "- | -" for name in SIMULATIONS]
        print(f"| {label} | {algo} | {context_length} | {' | '.join(shown)} |")


def _shown(cell: Cell) -> str:
    return f"{cell.falls}/{cell.episodes} | {np.mean(cell.errors):.3f}"


def draw(cells: Cells, label: str, path: Path) -> None:
    """
    :param cells: of one label, and the teacher's
    :param label: of the runs to show
    :param path: of the PNG
    """
    figure = Figure(figsize=(8.4, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    teacher = next((cell for (_, algo, _), cell in cells.items() if algo == "teacher"), {})
    contexts = sorted({context for of, algo, context in cells if algo == "dtfm" and of == label})
    for axis, name in zip(figure.subplots(1, 2), ("falls, % of episodes", "velocity error, m/s"), strict=True):
        for simulation, (color, marker) in zip(SIMULATIONS, STYLES, strict=False):
            shown = [cells[label, "dtfm", context].get(simulation) for context in contexts]
            values = [_value(cell, name) for cell in shown if cell is not None]
            if not values:
                continue
            at = [place for place, cell in enumerate(shown) if cell is not None]
            centres, lows, highs = np.array(values).T
            bars = (centres - lows, highs - centres)
            axis.errorbar(at, centres, bars, color=color, marker=marker, capsize=3, label=simulation)
            if simulation in teacher:
                axis.axhline(_value(teacher[simulation], name)[0], color=color, linestyle=":", linewidth=1.2)
        axis.set_xticks(range(len(contexts)), map(str, contexts))
        axis.set_xlabel("context length, steps of 20 ms")
        axis.set_ylabel(name)
        axis.set_ylim(bottom=0)
        axis.grid(axis="y", color="0.9")
    axis.legend(frameon=False, title="simulation (dotted: teacher)")
    figure.savefig(path, dpi=110)


def _value(cell: Cell, name: str) -> tuple[float, float, float]:
    """Return a value with the limits of its interval: Wilson's for falls, the seeds' range for errors."""
    if name.startswith("falls"):
        share, low, high = wilson(cell.falls, cell.episodes)
        return 100 * share, 100 * low, 100 * high
    return float(np.mean(cell.errors)), min(cell.errors), max(cell.errors)


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("--rows", type=Path, help="JSONL file that the table is made of")
    parser.add_argument("--figure", type=Path, help="PNG file to draw")
    parser.add_argument("--label", default="", help="of the runs to draw")
    options = parser.parse_args()
    if options.rows is not None:
        write_table(options.table, read_rows(options.rows))
    cells = read_cells(options.table)
    print_table(cells)
    if options.figure is not None:
        draw(cells, options.label, options.figure)


if __name__ == "__main__":
    main()
