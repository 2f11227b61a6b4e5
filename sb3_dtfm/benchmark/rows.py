"""Rows of results: one line of JSON for each evaluation."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

# Key of a row: the types that its value may have. `bool` is an `int` to Python, so it is told apart in `_has_type`.
KEYS: dict[str, tuple[type, ...]] = {
    "task": (str,),
    "regime": (float, int),
    "algo": (str,),
    "seed": (int,),
    "profile": (str,),
    "label": (str,),
    "step": (int,),
    "final": (bool,),
    "returns": (list,),
    "lengths": (list,),
    "successes": (list, type(None)),
    "solver": (str, type(None)),
    "n_solver_steps": (int, type(None)),
    "wall_s": (float, int),
    "steps_per_s": (float, int),
    "commit": (str, type(None)),
    "versions": (dict,),
    "hardware": (dict,),
    "settings": (dict,),
    "data": (dict,),
}
EPISODE_KEYS = ("returns", "lengths", "successes")

Row = dict[str, Any]


class RowError(ValueError):
    """A row cannot be used. The message names file and line, what was found and what is accepted."""


class Cell(NamedTuple):
    """
    What one training run of the grid is known by; rows with the same cell belong to the same run.

    :param task: Gymnasium id
    :param regime: share of the dataset's episodes, in (0, 1]
    :param algo: "dt" or "dtfm"
    :param seed: of weights, batches and acting
    :param profile: name of the settings
    :param label: name of what else was changed, empty if nothing
    """

    task: str
    regime: float
    algo: str
    seed: int
    profile: str
    label: str = ""

    @classmethod
    def of(cls, row: Row) -> "Cell":
        """The cell that a row belongs to."""
        return cls(row["task"], float(row["regime"]), row["algo"], row["seed"], row["profile"], row["label"])

    @property
    def file_name(self) -> str:
        """Name for files and folders of this cell: no separators, no spaces."""
        parts = [self.task, f"{self.regime:g}", self.algo, f"seed{self.seed}", self.profile, self.label]
        name = "_".join(part for part in parts if part)
        return "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name)

    def __str__(self) -> str:
        label = f", {self.label}" if self.label else ""
        return f"{self.task}, {self.regime:.0%} of the data, {self.algo}, seed {self.seed}, {self.profile}{label}"


def check_row(row: Any) -> Row:
    """
    The row, if it has exactly the keys and types that it should.

    :raises RowError: says what is wrong, without file and line
    """
    if not isinstance(row, dict):
        raise RowError(f"holds a {type(row).__name__}, expected an object with the keys {', '.join(KEYS)}.")
    missing, unknown = [key for key in KEYS if key not in row], sorted(set(row) - set(KEYS))
    if missing or unknown:
        found = [f"lacks {', '.join(missing)}"] if missing else []
        found += [f"has the unknown {', '.join(map(str, unknown))}"] if unknown else []
        raise RowError(f"{' and '.join(found)}; expected are {', '.join(KEYS)}.")
    for key, types in KEYS.items():
        if not _has_type(row[key], types):
            expected = " or ".join("null" if each is type(None) else each.__name__ for each in types)
            raise RowError(f"{key} is {row[key]!r}, expected {expected}.")
    _check_episodes(row)
    if not 0.0 < row["regime"] <= 1.0:
        raise RowError(f"regime is {row['regime']!r}, expected a number in (0, 1].")
    return row


def _check_episodes(row: Row) -> None:
    """
    :raises RowError: the lists differ in length, are empty, or hold something else than numbers
    """
    lists = {key: row[key] for key in EPISODE_KEYS if row[key] is not None}
    lengths = {key: len(values) for key, values in lists.items()}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        found = ", ".join(f"{n} {key}" for key, n in lengths.items())
        raise RowError(f"holds {found}, expected one of each for every episode, and at least one episode.")
    for key, values in lists.items():
        expected = (bool,) if key == "successes" else (int, float)
        wrong = [value for value in values if not _has_type(value, expected)]
        if wrong:
            raise RowError(f"{key} holds {wrong[0]!r}, expected {' or '.join(each.__name__ for each in expected)}.")


def _has_type(value: Any, types: tuple[type, ...]) -> bool:
    if isinstance(value, bool):
        return bool in types
    return isinstance(value, types)


def write_row(path: Path, row: Row) -> None:
    """Append one row; NaN and infinity are refused, since JSON has neither."""
    with path.open("a") as file:
        file.write(json.dumps(check_row(row), allow_nan=False) + "\n")


def read_rows(path: Path) -> list[Row]:
    """
    All rows of one file.

    :raises RowError: names the line that is wrong
    """
    rows = []
    with path.open() as file:
        for number, line in enumerate(file, start=1):
            if not line.strip():
                continue
            try:
                rows.append(check_row(json.loads(line, parse_constant=_refuse)))
            except json.JSONDecodeError as error:
                raise RowError(f"{path}, line {number}: is not JSON ({error.msg}); expected one object a line.") from error
            except RowError as error:
                raise RowError(f"{path}, line {number}: {error}") from error
    return rows


def _refuse(constant: str) -> NoReturn:
    """
    :raises RowError: Python reads NaN and infinity, but JSON has neither
    """
    raise RowError(f"holds {constant}, expected numbers.")


def result_files(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """
    Files of rows: those named, and `*.jsonl` of the folders named.

    :raises FileNotFoundError: one of them does not exist
    """
    files: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist; expected a folder or a file that `sb3-dtfm benchmark` wrote.")
        files += sorted(path.glob("*.jsonl")) if path.is_dir() else [path]
    return files


def merge_rows(files: Sequence[Path]) -> list[Row]:
    """
    The rows of several files. A row that is there twice, as after copying files together, counts once.

    :raises RowError: a malformed row, or two different results of the same evaluation
    """
    rows: dict[tuple[Any, ...], tuple[Row, Path]] = {}
    for path in files:
        for row in read_rows(path):
            key = (Cell.of(row), row["step"], row["final"])
            if key in rows and rows[key][0] != row:
                where = f"{rows[key][1]} and {path}"
                raise RowError(
                    f"{where}: different results of {key[0]}, step {key[1]}; keep one run of it, or give it a label."
                )
            rows.setdefault(key, (row, path))
    return [row for row, _ in rows.values()]


def finished_cells(rows: Iterable[Row]) -> dict[Cell, int]:
    """Gradient steps of each cell that has its final evaluation."""
    return {Cell.of(row): row["step"] for row in rows if row["final"]}
