"""The cells that a grid asks for."""

import argparse
import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.provenance import describe_data
from sb3_dtfm.benchmark.rows import Cell, Row, read_rows
from sb3_dtfm.benchmark.settings import Task, check_same_trunk, profile_name, read_yaml, task_settings
from sb3_dtfm.zoo.arguments import UsageError

N_EVALUATIONS = 10  # of a run, unless --eval-freq says otherwise


@dataclass(frozen=True)
class Job:
    """
    One cell and all that its process needs.

    :param cell: its identity
    :param settings: what RL-Zoo's `train` reads from its YAML file
    :param data: what the rows say of the dataset
    :param eval_freq: gradient steps between two evaluations
    """

    cell: Cell
    settings: dict[str, Any]
    data: dict[str, Any]
    eval_freq: int

    @property
    def n_steps(self) -> int:
        """Gradient steps."""
        return int(self.settings["n_timesteps"])


def read_tasks(options: argparse.Namespace) -> list[Task]:
    """
    The tasks of the grid with their data.

    :param options: `tasks`, `dataset`, `datasets` and `target_return` count
    :raises UsageError: a malformed option, or no task at all
    :raises gymnasium.error.Error: an unknown task; names the nearest one
    """
    given = _read_datasets_file(Path(options.datasets)) if options.datasets else {}
    for text in options.dataset:
        task, _, dataset = text.partition("=")
        if not (task and dataset):
            raise UsageError(f"--dataset {text}: expected TASK=DATASET.")
        given[task] = given.get(task, Task(task))._replace(dataset=dataset)
    tasks = {name: given.get(name, Task(name)) for name in options.tasks or given}
    if not tasks:
        raise UsageError("no task: name some with --env, or their data with --dataset or --datasets.")
    for text in options.target_return:
        name, separator, value = text.rpartition("=")
        for each in [name] if separator else tasks:
            if each in tasks:
                tasks[each] = tasks[each]._replace(target_return=_number(value, f"--target-return {text}"))
    for name in tasks:
        gym.spec(name)
    return list(tasks.values())


def _number(text: Any, where: str) -> float:
    try:
        return float(text)
    except (TypeError, ValueError):
        raise UsageError(f"{where}: expected a number, got {text!r}.") from None


def _read_datasets_file(path: Path) -> dict[str, Task]:
    """
    :raises UsageError: not the mapping that `--help` shows
    """
    keys = set(Task._fields) - {"env_id"}
    tasks = {}
    for name, entry in read_yaml(path).items():
        values = {"dataset": entry} if isinstance(entry, str) else entry
        if not isinstance(values, dict) or set(values) - keys:
            raise UsageError(f"{path}, {name}: expected a dataset, or a mapping of {', '.join(sorted(keys))}.")
        if values.get("target_return") is not None:
            values = {**values, "target_return": _number(values["target_return"], f"{path}, {name}, target_return")}
        tasks[name] = Task(name, **values)
    return tasks


def plan(options: argparse.Namespace) -> tuple[list[Job], list[Cell]]:
    """
    The cells still to run, and those that are finished. All settings and datasets are checked before anything runs.

    :param options: arguments of `sb3-dtfm benchmark`
    :raises UsageError: settings that do not fit, or a finished cell of another length
    :raises DatasetError: a dataset that cannot be read, or of another task
    """
    files = sorted(Path(options.results).rglob("*.jsonl"))  # in studies, too
    finished = {Cell.of(row): row for file in files for row in read_rows(file) if row["final"]}
    profile = profile_name(options.profile)
    data: dict[str, dict[str, Any]] = {}
    jobs: list[Job] = []
    done: list[Cell] = []
    # Seeds outermost: a grid that is cut short has seen every task.
    for seed, task, regime in product(options.seeds, read_tasks(options), options.fractions):
        settings = {
            algo: task_settings(options.profile, algo, task, regime, options.n_timesteps, options.hyperparams)
            for algo in ALGORITHMS
        }
        check_same_trunk(settings, task.env_id)
        for algo in options.algos:
            cell, wanted = Cell(task.env_id, regime, algo, seed, profile, options.label), settings[algo]
            if cell in finished:
                _check_same(cell, finished[cell], wanted, options)
                done.append(cell)
                continue
            if (rows := Path(options.results) / f"{cell.file_name}.jsonl") in files:
                raise UsageError(f"{cell}: {rows} is there, without a final evaluation of this cell; move it away.")
            if task.env_id not in data:
                kwargs = wanted.get("dataset_kwargs") or {}
                data[task.env_id] = describe_data(task.env_id, wanted["dataset"], kwargs, task.recorded_from)
            eval_freq = options.eval_freq or max(1, int(wanted["n_timesteps"]) // N_EVALUATIONS)
            jobs.append(Job(cell, wanted, data[task.env_id], eval_freq))
    return jobs, done


def _check_same(cell: Cell, found: Row, wanted: dict[str, Any], options: argparse.Namespace) -> None:
    """
    Refuse to take a finished cell for one of other settings.

    :param found: its final row
    :param wanted: its settings now
    :raises UsageError: names what differs
    """
    there = {**found["settings"], "n_timesteps": found["step"], "--final-episodes": len(found["returns"])}
    now = {**json.loads(json.dumps(wanted)), "--final-episodes": options.final_episodes}
    differing = sorted(key for key in {*there, *now} if there.get(key) != now.get(key))
    if differing:
        changes = ", ".join(f"{key} {there.get(key)!r} instead of {now.get(key)!r}" for key in differing)
        raise UsageError(f"{cell}: {options.results} has it with {changes}; use another --label or --results.")
