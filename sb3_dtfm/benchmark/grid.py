"""`sb3-dtfm benchmark`: its arguments, and the cells that they ask for."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from sb3_dtfm.benchmark.provenance import describe_data
from sb3_dtfm.benchmark.rows import Cell, finished_cells, merge_rows, result_files
from sb3_dtfm.benchmark.settings import Task, check_same_trunk, check_task, profile_name, task_settings
from sb3_dtfm.zoo.arguments import UsageError
from sb3_dtfm.zoo.registration import OFFLINE_ALGORITHMS

EXAMPLES = """\
examples:
  sb3-dtfm benchmark --dataset robosuite/Lift-v0=datasets/lift.hdf5 --seeds 0 1 2
  sb3-dtfm benchmark --env HalfCheetah-v5 --dataset HalfCheetah-v5=local/halfcheetah/expert-v0 --label ema \\
      -params ema_decay:0.99

The file of --datasets maps a task to its dataset, or to dataset, target_return and recorded_from:
  robosuite/Lift-v0: datasets/lift.hdf5
  HalfCheetah-v5: {dataset: local/halfcheetah/expert-v0, target_return: 13000, recorded_from: "TQC, sampled actions"}

A cell that is finished in the results folder is not run again; one that was interrupted starts anew.
"""
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


def benchmark_parser() -> argparse.ArgumentParser:
    """Arguments of `benchmark`; those that `train` has too mean the same."""
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm benchmark",
        description="Train and evaluate DT and DTFM on a grid of tasks, shares of the data and seeds.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    grid = parser.add_argument_group("the grid").add_argument
    grid("--env", "--tasks", dest="tasks", nargs="+", metavar="TASK", help="those with a dataset given, by default")
    grid(
        "--fractions", type=float, nargs="+", default=[1.0, 0.5], metavar="SHARE", help="of the episodes; 1.0 0.5 by default"
    )
    grid(
        "--algo",
        dest="algos",
        nargs="+",
        choices=OFFLINE_ALGORITHMS,
        default=list(OFFLINE_ALGORITHMS),
        help="both by default",
    )
    grid("--seeds", "--seed", type=int, nargs="+", default=[0], metavar="SEED", help="0 by default")
    grid("--profile", default="small", help="small (default), paper, a YAML file, or a folder with dt.yml and dtfm.yml")
    grid("--label", default="", help="name of what -params change; part of a cell's identity")
    data = parser.add_argument_group("data").add_argument
    data("--dataset", nargs="+", action="extend", default=[], metavar="TASK=DATASET", help="Minari id or robomimic file")
    data("--datasets", metavar="FILE", help="YAML file that says the same for many tasks, see below")
    data("--dataset-cache", metavar="DIR", help="learn from memory-mapped files made in this folder")
    data(
        "--target-return",
        nargs="+",
        action="extend",
        default=[],
        metavar="[TASK=]RETURN",
        help="to ask for when acting, in reward units",
    )
    training = parser.add_argument_group("training and evaluation").add_argument
    training("-n", "--n-timesteps", type=int, metavar="N", help="gradient steps; the profile's by default")
    training(
        "-params",
        "--hyperparams",
        nargs="+",
        action="extend",
        default=[],
        help="settings to change, key:value; needs --label",
    )
    training(
        "--eval-freq", type=int, metavar="N", help=f"gradient steps between evaluations; 1/{N_EVALUATIONS} of all by default"
    )
    training("--eval-episodes", type=int, default=20, metavar="N", help="episodes of each; 20 by default")
    training("--final-episodes", type=int, default=50, metavar="N", help="episodes after the last step; 50 by default")
    training("--n-eval-envs", type=int, default=10, metavar="N", help="environments side by side; 10 by default")
    training("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="as in train")
    training("--vec-env", choices=("dummy", "subproc"), default="dummy", help="as in train")
    training("--device", default="auto", help="as in train")
    running = parser.add_argument_group("running").add_argument
    running("--jobs", type=int, default=1, metavar="N", help="cells at once, each with 1/N of the cores; 1 by default")
    running("-o", "--results", default="results", metavar="DIR", help="where rows go; results by default")
    running("-f", "--log-folder", default="logs/benchmark", metavar="DIR", help="models and logs; logs/benchmark by default")
    return parser


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """
    The user's arguments, in range.

    :raises UsageError: one is not
    """
    options = benchmark_parser().parse_args(argv)
    for name in ("n_timesteps", "eval_freq", "eval_episodes", "final_episodes", "n_eval_envs", "jobs"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UsageError(f"--{name.replace('_', '-')}: must be at least 1, got {value}.")
    for fraction in options.fractions:
        if not 0.0 < fraction <= 1.0:
            raise UsageError(f"--fractions: must lie in (0, 1], got {fraction}.")
    for seed in options.seeds:
        if seed < 0:
            raise UsageError(f"--seeds: must be 0 or more, got {seed}.")
    if options.hyperparams and not options.label:
        raise UsageError("-params: needs --label, or the rows would pass for the profile's own.")
    options.hyperparams = dict(_hyperparam(text) for text in options.hyperparams)
    options.hyperparams.update(_cache_kwargs(options))
    return options


def _hyperparam(text: str) -> tuple[str, Any]:
    """
    Key and value, which is Python as in RL-Zoo's `-params`.

    :raises UsageError: it cannot be evaluated
    """
    key, _, value = text.partition(":")
    try:
        return key, eval(value, {})
    except Exception as error:  # whatever the user's expression raises
        raise UsageError(f"-params {text}: expected key:value with a value in Python ({error}).") from error


def _cache_kwargs(options: argparse.Namespace) -> dict[str, Any]:
    if options.dataset_cache is None:
        return {}
    return {"dataset_kwargs": {**options.hyperparams.get("dataset_kwargs", {}), "cache_dir": options.dataset_cache}}


def read_tasks(options: argparse.Namespace) -> list[Task]:
    """
    The tasks of the grid with their data.

    :raises UsageError: a malformed option, an unknown task, or none at all
    """
    given = _read_datasets_file(options.datasets) if options.datasets else {}
    for task, dataset in _pairs(options.dataset, "--dataset"):
        given[task] = given.get(task, Task(task))._replace(dataset=dataset)
    names = list(dict.fromkeys(options.tasks or given))
    if not names:
        raise UsageError("no task: name some with --env, or their data with --dataset or --datasets.")
    tasks = {name: given.get(name, Task(name)) for name in names}
    for text in options.target_return:
        name, separator, value = text.rpartition("=")
        for each in [name] if separator else names:
            if each in tasks:
                tasks[each] = tasks[each]._replace(target_return=_number(value, f"--target-return {text}"))
    for name in names:
        check_task(name)
    return list(tasks.values())


def _pairs(texts: Sequence[str], option: str) -> list[tuple[str, str]]:
    parts = [text.partition("=") for text in texts]
    for task, separator, value in parts:
        if not (task and separator and value):
            raise UsageError(f"{option} {task}{separator}{value}: expected TASK=DATASET.")
    return [(task, value) for task, _, value in parts]


def _number(text: Any, where: str) -> float:
    try:
        return float(text)
    except (TypeError, ValueError):
        raise UsageError(f"{where}: expected a number, got {text!r}.") from None


def _read_datasets_file(path: str) -> dict[str, Task]:
    """
    :raises UsageError: not the mapping that `--help` shows
    """
    try:
        content = yaml.safe_load(Path(path).read_text())
    except yaml.YAMLError as error:
        raise UsageError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise UsageError(f"{path}: expected a mapping from tasks to datasets.")
    tasks = {}
    for name, entry in content.items():
        values = {"dataset": entry} if isinstance(entry, str) else entry
        if not isinstance(values, dict) or set(values) - {"dataset", "target_return", "recorded_from"}:
            raise UsageError(
                f"{path}, {name}: expected a dataset, or a mapping of dataset, target_return and recorded_from."
            )
        if values.get("target_return") is not None:
            values = {**values, "target_return": _number(values["target_return"], f"{path}, {name}, target_return")}
        tasks[str(name)] = Task(str(name), **values)
    return tasks


def plan(options: argparse.Namespace) -> tuple[list[Job], list[Cell]]:
    """
    The cells still to run, and those that are finished. All settings and datasets are checked before anything runs.

    :param options: of :func:`parse_arguments`
    :raises UsageError: settings that do not fit, or a finished cell of another length
    :raises DatasetError: a dataset that cannot be read
    """
    folder = Path(options.results)
    finished = finished_cells(merge_rows(result_files([folder]))) if folder.exists() else {}
    tasks = read_tasks(options)
    profile = profile_name(options.profile)
    pending: list[tuple[Cell, dict[str, Any], Task]] = []
    done: list[Cell] = []
    # Seeds outermost: a grid that is cut short has seen every task.
    for seed, task, regime in product(dict.fromkeys(options.seeds), tasks, dict.fromkeys(options.fractions)):
        settings = {
            algo: task_settings(options.profile, algo, task, regime, options.n_timesteps, options.hyperparams)
            for algo in OFFLINE_ALGORITHMS
        }
        check_same_trunk(settings, task.env_id)
        for algo in dict.fromkeys(options.algos):
            cell = Cell(task.env_id, regime, algo, seed, profile, options.label)
            if cell in finished:
                _check_length(cell, finished[cell], settings[algo]["n_timesteps"], folder)
                done.append(cell)
            else:
                pending.append((cell, settings[algo], task))
    data: dict[str, dict[str, Any]] = {}
    for _, settings_, task in pending:
        if task.env_id not in data:
            data[task.env_id] = describe_data(
                settings_["dataset"], settings_.get("dataset_kwargs") or {}, task.recorded_from
            )
    return [
        Job(cell, settings_, data[task.env_id], _eval_freq(options, settings_)) for cell, settings_, task in pending
    ], done


def _check_length(cell: Cell, found: int, wanted: int, folder: Path) -> None:
    if found != wanted:
        raise UsageError(
            f"{cell}: {folder} has it with {found} gradient steps, {wanted} are asked for; use another --label or --results."
        )


def _eval_freq(options: argparse.Namespace, settings: dict[str, Any]) -> int:
    return options.eval_freq or max(1, int(settings["n_timesteps"]) // N_EVALUATIONS)
