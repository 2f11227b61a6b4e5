"""
Results: a summary of each evaluation, from a line of a CSV table or from a row of `sb3-dtfm benchmark`.

A result has means and counts in place of a row's lists of episodes: all that reports need. The fields of a whole run, from
the commit to the data, stand with its final evaluation alone.
"""

import csv
import json
import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_dtfm.benchmark.rows import Row, RowError, RunKey, read_rows, refuse_constant
from sb3_dtfm.files.replacing import replacing

Result = dict[str, Any]

DIGITS = 8  # significant digits of a number


class Column(NamedTuple):
    """
    A column of the table.

    :param key: key in a result
    :param read: function from the text of a cell that is not empty to its value
    :param optional: whether its cells may be empty; "run" where those of final evaluations may not
    """

    key: str
    read: Callable[[str], Any]
    optional: bool | str = False


def _flag(text: str) -> bool:
    return {"true": True, "false": False}[text]


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _numbers(text: str) -> list[int]:
    return [int(each) for each in text.split()]


def _json(text: str) -> dict[str, Any]:
    found = json.loads(text, parse_constant=refuse_constant)
    if not isinstance(found, dict):
        raise ValueError(text)
    return found


def _versions(text: str) -> dict[str, str]:
    return dict(each.rsplit(" ", 1) for each in text.split("; ") if each)


EXPECTED = {
    int: "a whole number",
    _number: "a number",
    _flag: "true or false",
    _numbers: "whole numbers with spaces between",
    _json: "an object of JSON",
    _versions: "names and versions, as in 'numpy 1.26.4; torch 2.13.0'",
}
COLUMNS = {
    "task": Column("task", str),
    "algorithm": Column("algo", str),
    "seed": Column("seed", int),
    "profile": Column("profile", str),
    "label": Column("label", str, True),
    "data_share": Column("data_share", _number),
    "gradient_step": Column("step", int),
    "final": Column("final", _flag),
    "episodes": Column("n_episodes", int),
    "mean_return": Column("mean_return", _number),
    "std_return": Column("std_return", _number, True),
    "successes": Column("successes", int, True),
    "mean_length": Column("mean_length", _number),
    "longest": Column("max_length", int),
    "under_1000_steps": Column("n_under_1000", int),
    "under_100_steps": Column("n_under_100", int),
    "wall_s": Column("wall_s", _number),
    "steps_per_s": Column("steps_per_s", _number),
    "action_ms": Column("action_ms", _number, True),
    "flow_solver": Column("flow_solver", str, True),
    "flow_steps": Column("flow_steps", int, True),
    "commit": Column("commit", str, True),
    "env_id": Column("env_id", str, True),
    "steps_to_success": Column("steps_to_success", _numbers),
    "data": Column("data", _json, "run"),
    "settings": Column("settings", _json, "run"),
    "hardware": Column("hardware", _json, "run"),
    "versions": Column("versions", _versions, "run"),
}
# Columns that a run fills once, with its final evaluation.
OF_A_RUN = ("action_ms", "flow_solver", "flow_steps", "commit", "env_id", "data", "settings", "hardware", "versions")


def summarize(row: Row) -> Result:
    """Summarise the row of an evaluation."""
    returns, lengths, successes = (row[key] for key in ("returns", "lengths", "successes"))
    counts = {
        "n_episodes": len(returns),
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns, ddof=1)) if len(returns) > 1 else None,
        "successes": None if successes is None else sum(successes),
        "mean_length": float(np.mean(lengths)),
        "max_length": int(max(lengths)),
        "n_under_1000": sum(length < 1000 for length in lengths),
        "n_under_100": sum(length < 100 for length in lengths),
        "steps_to_success": [],
    }
    if row["final"] and successes is not None:
        counts["steps_to_success"] = sorted(int(n) for n, success in zip(lengths, successes, strict=True) if success)
    of_a_run = {key: row.get(key) if row["final"] else None for key in OF_A_RUN}
    result = {**row, **counts, **of_a_run}
    return {column.key: _rounded(result[column.key]) for column in COLUMNS.values()}


def _rounded(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def write_results(path: Path, results: Iterable[Result]) -> None:
    """Write a table, ordered by run and gradient step; a file that is there is replaced when it is whole."""
    ordered = sorted(results, key=lambda result: (RunKey.of(result), result["step"], result["final"]))
    with replacing(path) as beside, beside.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([_text(result[key], read) for key, read, _ in COLUMNS.values()] for result in ordered)


def _text(value: Any, read: Callable[[str], Any]) -> str:
    if value is None:
        return ""
    if read is _versions:
        return "; ".join(f"{name} {version}" for name, version in value.items())
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}"
    if isinstance(value, list):
        return " ".join(map(str, value))
    return json.dumps(value, allow_nan=False) if isinstance(value, dict) else str(value)


def read_table(path: Path) -> list[Result]:
    """
    The results of one table.

    :raises RowError: names the line that is wrong
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = next(reader, [])
        if missing := [name for name in COLUMNS if name not in header]:
            cure = "`sb3-dtfm report FOLDER --csv FILE` writes such a table from the rows of a benchmark"
            raise RowError(f"{path}, line 1: lacks {', '.join(missing)}; expected are {', '.join(COLUMNS)}. {cure}.")
        results = []
        for cells in filter(None, reader):  # a spreadsheet may leave an empty line
            try:
                if len(cells) != len(header):
                    raise RowError(f"holds {len(cells)} values, expected {len(header)}, one for each column.")
                results.append(_read_line(dict(zip(header, cells, strict=True))))
            except RowError as error:
                raise RowError(f"{path}, line {reader.line_num}: {error}") from error
    return results


def _read_line(cells: dict[str, str]) -> Result:
    """
    :raises RowError: a malformed line; the message is without file and line
    """
    result: Result = {}
    for name, (key, read, optional) in COLUMNS.items():
        text = cells[name]
        if not text and (optional is True or (optional and not result["final"])):
            result[key] = "" if key == "label" else None
            continue
        try:
            result[key] = read(text)
        except (ValueError, KeyError) as error:
            raise RowError(f"{name} is {text!r}, expected {EXPECTED[read]}.") from error
    if not 0.0 < result["data_share"] <= 1.0:
        raise RowError(f"data_share is {result['data_share']!r}, expected a number in (0, 1].")
    if not 0 <= (result["successes"] or 0) <= result["n_episodes"] or result["n_episodes"] < 1:
        raise RowError(f"holds {result['successes']} successes of {result['n_episodes']} episodes, expected 1 or more.")
    return result


def read_results(paths: Iterable[str | os.PathLike[str]]) -> dict[str, list[Result]]:
    """
    Results by study: a folder below a named one, or a table in it, is a study; files that are named are the study "".

    :param paths: tables, files of rows, and folders with `*.csv` in them, or `*.jsonl` in them or below them
    :raises FileNotFoundError: one of them does not exist
    :raises RowError: a malformed line, or two different results of the same evaluation in one study
    """
    return {study: _merged(files) for study, files in result_files(paths).items()}


def result_files(paths: Iterable[str | os.PathLike[str]]) -> dict[str, list[Path]]:
    """The files that :func:`read_results` reads, by study."""
    studies: dict[str, list[Path]] = {}
    for path in map(Path, paths):
        if not path.exists():
            what = "a folder or a file that `sb3-dtfm benchmark` wrote, or a table of `sb3-dtfm report --csv`"
            raise FileNotFoundError(f"{path} does not exist; expected {what}.")
        if not path.is_dir():
            studies.setdefault("", []).append(path)
            continue
        for file in sorted(path.rglob("*.jsonl")):
            study = file.parent.relative_to(path).as_posix()
            studies.setdefault("" if study == "." else study, []).append(file)
        for file in sorted(path.glob("*.csv")):
            studies.setdefault(file.stem, []).append(file)
    return studies


def _merged(files: Iterable[Path]) -> list[Result]:
    """
    The results of several files. One that is there twice, as after copying files together, counts once.

    :raises RowError: a malformed line, or two different results of the same evaluation
    """
    results: dict[tuple[Any, ...], tuple[Result, Path]] = {}
    for path in files:
        for result in read_table(path) if path.suffix == ".csv" else map(summarize, read_rows(path)):
            key = (RunKey.of(result), result["step"], result["final"])
            known, where = results.setdefault(key, (result, path))
            if known != result:
                what = f"different results of {key[0]}, step {key[1]}; keep one run of it, or give it a label."
                raise RowError(f"{where} and {path}: {what}")
    return [result for result, _ in results.values()]
