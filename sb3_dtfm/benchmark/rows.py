"""Rows of results: one line of JSON for each evaluation."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

# Keys of a row, with the types that their values may have.
KEYS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("task", "algo", "profile", "label"), (str,)),
    **dict.fromkeys(("data_share", "wall_s", "steps_per_s"), (float, int)),
    **dict.fromkeys(("seed", "step"), (int,)),
    "final": (bool,),
    **dict.fromkeys(("returns", "lengths"), (list,)),
    "successes": (list, type(None)),
    "flow_steps": (int, type(None)),
    **dict.fromkeys(("flow_solver", "commit"), (str, type(None))),
    **dict.fromkeys(("versions", "hardware", "settings", "data"), (dict,)),
}
# Keys that may be missing: one that earlier rows lack, and the Gymnasium id of a task with another name.
OPTIONAL_KEYS: dict[str, tuple[type, ...]] = {"action_ms": (float, int), "env_id": (str,)}
EPISODE_KEYS: dict[str, tuple[type, ...]] = {"returns": (float, int), "lengths": (float, int), "successes": (bool,)}

# Behaviour cloning, beside which the algorithms are compared: the share of the episodes, the best ones, that it learns from.
BASELINES = {"bc": 1.0, "bc-best": 0.1}

Row = dict[str, Any]


class RowError(ValueError):
    """A row cannot be used. The message names file and line, what was found and what is accepted."""


class RunKey(NamedTuple):
    """
    Identity of a training run; rows with equal keys belong to one run.

    :param task: name of the task with its data, which is the Gymnasium id where nothing else was said
    :param data_share: share of the task's episodes, in (0, 1]
    :param algo: "dt" or "dtfm", or one of `BASELINES`
    :param seed: seed of weights, batches and acting
    :param profile: name of the settings
    :param label: name of further changes, empty if there are none
    """

    task: str
    data_share: float
    algo: str
    seed: int
    profile: str
    label: str = ""

    @classmethod
    def of(cls, row: Row) -> "RunKey":
        """The key of the run that a row belongs to."""
        return cls(row["task"], float(row["data_share"]), row["algo"], row["seed"], row["profile"], row["label"])

    @property
    def file_name(self) -> str:
        """Name for files and folders of this run: no separators, no spaces."""
        parts = [self.task, f"{self.data_share:g}", self.algo, f"seed{self.seed}", self.profile, self.label]
        return plain_name("_".join(part for part in parts if part))

    def __str__(self) -> str:
        label = f", {self.label}" if self.label else ""
        return f"{self.task}, {self.data_share:.0%} of the data, {self.algo}, seed {self.seed}, {self.profile}{label}"


def plain_name(text: str) -> str:
    """The text as a file name: no separators, no spaces."""
    return "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in text)


def check_row(row: Any) -> Row:
    """
    Return the row, if it has exactly the keys and types that it should.

    :raises RowError: another row; the message is without file and line
    """
    if not isinstance(row, dict):
        raise RowError(f"holds a {type(row).__name__}, expected an object with the keys {', '.join(KEYS)}.")
    missing, unknown = [key for key in KEYS if key not in row], sorted(set(row) - set(KEYS) - set(OPTIONAL_KEYS))
    if missing or unknown:
        found = [f"lacks {', '.join(missing)}"] if missing else []
        found += [f"has the unknown {', '.join(unknown)}"] if unknown else []
        cure = "Rename the keys of rows that another version wrote, or move the file away and run its cells again"
        raise RowError(f"{' and '.join(found)}; expected are {', '.join(KEYS)}. {cure}.")
    for key, types in {**KEYS, **OPTIONAL_KEYS}.items():
        if key in row:
            _check_type(f"{key} is", row[key], types)
    episodes = {key: row[key] for key in EPISODE_KEYS if row[key] is not None}
    for key, values in episodes.items():
        for value in values:
            _check_type(f"{key} holds", value, EPISODE_KEYS[key])
    if len({len(values) for values in episodes.values()}) != 1 or not row["returns"]:
        counts = ", ".join(f"{len(values)} {key}" for key, values in episodes.items())
        raise RowError(f"holds {counts}, expected one of each for every episode, and at least one episode.")
    if not 0.0 < row["data_share"] <= 1.0:
        raise RowError(f"data_share is {row['data_share']!r}, expected a number in (0, 1].")
    return row


def _check_type(what: str, value: Any, types: tuple[type, ...]) -> None:
    """
    :raises RowError: another type; exactly these, as a `bool` is an `int` to Python
    """
    if type(value) not in types:
        expected = " or ".join("null" if each is type(None) else each.__name__ for each in types)
        raise RowError(f"{what} {value!r}, expected {expected}.")


def write_row(path: Path, row: Row) -> None:
    """Append one row; NaN and infinity are refused, since JSON has neither."""
    with path.open("a") as file:
        file.write(json.dumps(check_row(row), allow_nan=False) + "\n")


def read_rows(path: Path, torn_end: bool = False) -> list[Row]:
    """
    All rows of one file.

    :param torn_end: whether to leave out a last line that was cut off when its process was killed
    :raises RowError: names the line that is wrong
    """
    rows = []
    with path.open() as file:
        for number, line in enumerate(file, start=1):
            if torn_end and not line.endswith("\n"):
                break
            try:
                if line.strip():
                    rows.append(check_row(json.loads(line, parse_constant=refuse_constant)))
            except json.JSONDecodeError as error:
                raise RowError(f"{path}, line {number}: is not JSON ({error.msg}); expected one object a line.") from error
            except RowError as error:
                raise RowError(f"{path}, line {number}: {error}") from error
    return rows


def refuse_constant(constant: str) -> NoReturn:
    """
    :raises RowError: Python reads NaN and infinity, but JSON has neither
    """
    raise RowError(f"holds {constant}, expected numbers.")


def finished_runs(rows: Iterable[Row]) -> dict[RunKey, int]:
    """Gradient steps of each run that has its final evaluation."""
    return {RunKey.of(row): row["step"] for row in rows if row["final"]}
