"""The runs of a grid."""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.provenance import describe_data, read_data
from sb3_dtfm.benchmark.rows import BASELINES, Row, RunKey, read_rows
from sb3_dtfm.benchmark.settings import (
    GRID_DATASET_KEYS,
    Task,
    check_same_transformer,
    cloning_settings,
    profile_name,
    task_settings,
)
from sb3_dtfm.data.inspection import suggested_target_return
from sb3_dtfm.zoo.arguments import UsageError, find_target_return, import_packages, read_yaml, with_target_return

N_EVALUATIONS = 10  # of a run, unless --eval-freq says otherwise
# Values of --algo.
ALGOS = (*ALGORITHMS, *BASELINES)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_mapping(value: Any) -> bool:
    return isinstance(value, dict)


def _is_share(value: Any) -> bool:
    return type(value) in (float, int) and 0.0 < value <= 1.0


# Keys of an entry of the file of --datasets: a description of accepted values, and whether a value is accepted.
ENTRY: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "task": ("a Gymnasium id", _is_text),
    "dataset": ("a Minari id or the path of a file", _is_text),
    "target_return": ("a number", lambda value: type(value) in (float, int)),
    "recorded_from": ("a text", _is_text),
    "env_kwargs": ("a mapping", _is_mapping),
    "dataset_kwargs": ("a mapping", _is_mapping),
    "fraction": ("a number in (0, 1]", _is_share),
    "gym_packages": ("a list of modules", lambda value: isinstance(value, list) and all(map(_is_text, value))),
    "algorithms": (f"a list of {', '.join(ALGOS)}", lambda value: isinstance(value, list) and set(value) <= set(ALGOS)),
    "chosen_with": ("true or false", lambda value: isinstance(value, bool)),
}


@dataclass(frozen=True)
class Job:
    """
    A run and everything that its process needs.

    :param key: identity of the run
    :param task: task and its data
    :param settings: settings that its process reads from a YAML file, RL-Zoo's `train` for example
    :param data: description of the dataset in the rows
    :param eval_freq: number of gradient steps between two evaluations
    """

    key: RunKey
    task: Task
    settings: dict[str, Any]
    data: dict[str, Any]
    eval_freq: int

    @property
    def n_steps(self) -> int:
        """Gradient steps."""
        return int(self.settings["n_timesteps"])

    @property
    def row(self) -> Row:
        """Content that all of its rows share."""
        renamed = {} if self.task.env_id == self.key.task else {"env_id": self.task.env_id}
        return {**self.key._asdict(), **renamed, "settings": self.settings, "data": self.data}


def read_tasks(options: argparse.Namespace) -> list[Task]:
    """
    The tasks of the grid with their data.

    :param options: arguments of the command; `tasks`, `dataset`, `datasets` and `target_return` count
    :raises UsageError: a malformed option or entry, or no task at all
    :raises gymnasium.error.Error: an unknown task; names the nearest one
    """
    listed = _read_datasets_file(Path(options.datasets)) if options.datasets else {}
    given = dict(listed)
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
    for task in tasks.values():
        import_packages(task.gym_packages, f"{options.datasets}, {task.name}, gym_packages:")
        try:
            gym.spec(task.env_id)
        except gym.error.Error as error:
            if task.name not in listed:
                raise
            raise UsageError(f"{options.datasets}, {task.name}, task: {error}") from error
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
    tasks = {}
    for name, entry in read_yaml(path).items():
        values: Any = {"dataset": entry} if isinstance(entry, str) else entry
        if not isinstance(values, dict) or not set(values) <= set(ENTRY):
            raise UsageError(f"{path}, {name}: expected a dataset, or a mapping of {', '.join(ENTRY)}; got {entry!r}.")
        values = {key: value for key, value in values.items() if value is not None}
        for key, value in values.items():
            accepted, accepts = ENTRY[key]
            if not accepts(value):
                raise UsageError(f"{path}, {name}, {key}: expected {accepted}, got {value!r}.")
        tasks[name] = Task(name, **values)
    return tasks


def plan(options: argparse.Namespace) -> tuple[list[Job], list[RunKey]]:
    """
    The runs to start, and those that are finished. All settings and datasets are checked before anything runs.

    :param options: arguments of `sb3-dtfm benchmark`
    :raises UsageError: settings that do not fit, or a finished run of another length
    :raises DatasetError: a dataset that cannot be read, or of another task
    """
    files = sorted(Path(options.results).rglob("*.jsonl"))  # in studies, too
    finished = {RunKey.of(row): row for file in files for row in read_rows(file) if row["final"]}
    profile = profile_name(options.profile)
    looked_at: dict[tuple[str, float], tuple[dict[str, Any], float]] = {}
    jobs: list[Job] = []
    done: list[RunKey] = []
    # Seeds outermost: a grid that is cut short has seen every task.
    for seed, task, data_share in product(options.seeds, read_tasks(options), options.fractions):
        for algo, wanted in _settings(task, data_share, options).items():
            key, target = (
                RunKey(task.name, data_share, algo, seed, profile, options.label),
                find_target_return(wanted.get("env_wrapper")),
            )
            if (rows := Path(options.results) / f"{key.file_name}.jsonl") in files and key not in finished:
                raise UsageError(f"{key}: {rows} is there, without a final evaluation of this run; move it away.")
            if (key not in finished or target is None) and (task.name, data_share) not in looked_at:
                looked_at[task.name, data_share] = _look_at(task, wanted)
            if target is None:
                suggested = looked_at[task.name, data_share][1]
                wanted["env_wrapper"] = with_target_return(suggested, wanted.get("env_wrapper"))
            if key in finished:
                _check_same(key, finished[key], wanted, options)
                done.append(key)
                continue
            eval_freq = options.eval_freq or max(1, int(wanted["n_timesteps"]) // N_EVALUATIONS)
            jobs.append(Job(key, task, wanted, looked_at[task.name, data_share][0], eval_freq))
    return jobs, done


def _settings(task: Task, data_share: float, options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """
    Return settings by algorithm, for those asked for that can learn the task.

    :raises UsageError: settings that do not fit, or that differ by more than a head
    """
    own = {
        algo: task_settings(options.profile, algo, task, data_share, options.n_timesteps, options.hyperparams)
        for algo in ALGORITHMS
    }
    check_same_transformer(own, task.name)
    cloning = {algo: cloning_settings(algo, own["dt"], options.n_timesteps) for algo in BASELINES}
    return {algo: {**own, **cloning}[algo] for algo in options.algos if algo in (task.algorithms or options.algos)}


def _look_at(task: Task, settings: dict[str, Any]) -> tuple[dict[str, Any], float]:
    """
    Description of a task's data for the rows, and the target return that a run's share of them suggests.

    :raises DatasetError: they cannot be read, or are of another task
    :raises UsageError: the environment cannot be made
    """
    try:
        kwargs = {key: value for key, value in settings["dataset_kwargs"].items() if key not in GRID_DATASET_KEYS}
        buffer = read_data(task.env_id, {**settings, "dataset_kwargs": kwargs})
    except (ImportError, TypeError) as error:
        raise UsageError(f"{task.name}, a task of {task.env_id}: {error}") from error
    share_of_all, seed = (settings["dataset_kwargs"][key] for key in GRID_DATASET_KEYS)
    whole, share = (buffer.random_fraction(fraction, seed) for fraction in (task.fraction, share_of_all))
    described = describe_data(whole, settings["dataset"], task.recorded_from)
    return {**described, **({"chosen_with": True} if task.chosen_with else {})}, suggested_target_return(share)


def _check_same(key: RunKey, found: Row, wanted: dict[str, Any], options: argparse.Namespace) -> None:
    """
    Refuse to take a finished run for one of other settings.

    :param found: final row of that run
    :param wanted: present settings of the run
    :raises UsageError: settings that differ, by name
    """
    there = {**found["settings"], "n_timesteps": found["step"], "--final-episodes": len(found["returns"])}
    now = {**json.loads(json.dumps(wanted)), "--final-episodes": options.final_episodes}
    differing = sorted(name for name in {*there, *now} if there.get(name) != now.get(name))
    if differing:
        changes = ", ".join(f"{name} {there.get(name)!r} instead of {now.get(name)!r}" for name in differing)
        raise UsageError(f"{key}: {options.results} has it with {changes}; use another --label or --results.")
