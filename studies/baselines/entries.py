"""The data and algorithms of `make baselines`, from their YAML files, and a row for each training."""

import argparse
import contextlib
import itertools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch as th

from baselines.process import BaselineProcess
from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.benchmark.rows import Row, RunKey, read_rows
from sb3_dtfm.benchmark.settings import Task, task_settings
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.envs import reader_options
from sb3_dtfm.zoo.arguments import UsageError, read_yaml

HERE = Path(__file__).parent
PROFILE = "authors"  # what the rows call the baselines' settings
KINDS = ("locomotion", "hand", "manipulation")
# Name: the module that its environment runs.
WORKERS = {"d3rlpy": "baselines.worker_d3rlpy", "robomimic": "baselines.worker_robomimic"}


class Data(NamedTuple):
    """
    One dataset of the comparison.

    :param name: what the rows have for a label
    :param task: Gymnasium id
    :param kind: one of `KINDS`
    :param dataset: Minari id, robomimic file or flat arrays
    :param target_return: when acting, in reward units
    :param minutes: of a baseline's training on one core
    :param fraction: share of the episodes to learn from
    :param n_timesteps: our gradient steps, None for the profile's
    :param profile: our settings
    :param params: changes to them
    :param baselines: changes to the baselines' settings, by baseline
    :param gym_packages: to import first
    :param recorded_from: who made the data
    """

    name: str
    task: str
    kind: str
    dataset: str
    target_return: float
    minutes: float
    fraction: float = 1.0
    n_timesteps: int | None = None
    profile: str = "default"
    params: dict[str, Any] = {}  # noqa: RUF012 - never changed
    baselines: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    gym_packages: list[str] = []  # noqa: RUF012
    recorded_from: str | None = None

    @property
    def our_steps(self) -> int:
        """Gradient steps of DT and DTFM."""
        return int(self._our_settings()["n_timesteps"])

    def settings(self) -> dict[str, Any]:
        """Return what our own runs are told of data and environment."""
        found = self._our_settings()
        names = ("dataset", "dataset_kwargs", "env_wrapper", "env_kwargs")
        return {name: found[name] for name in names if name in found}

    def _our_settings(self) -> dict[str, Any]:
        task = Task(self.task, self.dataset, self.target_return, self.recorded_from)
        return task_settings(self.profile, "dt", task, self.fraction, self.n_timesteps, self.params)


class Baseline(NamedTuple):
    """
    One baseline at its authors' settings.

    :param name: what the rows have for an algorithm
    :param worker: one of `WORKERS`
    :param n_timesteps: its authors' gradient steps
    :param settings: the worker's
    :param kinds: changes to them by kind of task
    :param only: kinds of tasks that it is for
    :param best_share: share of the episodes that it learns from, those of the largest returns
    :param changes: what a search has changed, last of all
    """

    name: str
    worker: str
    n_timesteps: int
    settings: dict[str, Any]
    kinds: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    only: list[str] = list(KINDS)  # noqa: RUF012
    best_share: float | None = None
    changes: dict[str, Any] = {}  # noqa: RUF012

    def settings_for(self, data: Data) -> dict[str, Any]:
        """The worker's settings for a dataset."""
        return {**self.settings, **self.kinds.get(data.kind, {}), **data.baselines.get(self.name, {}), **self.changes}

    def changed(self, changes: Mapping[str, Any]) -> "Baseline":
        """
        The baseline with other settings.

        :param changes: the worker's settings, or `best_share`, by name
        :raises UsageError: a name that it has not
        """
        accepted = {"best_share", *self.settings, *itertools.chain(*self.kinds.values())}
        if unknown := sorted(set(changes) - accepted):
            raise UsageError(f"-params: {self.name} has no {', '.join(unknown)}; it has {', '.join(sorted(accepted))}.")
        changes = dict(changes)
        return self._replace(best_share=changes.pop("best_share", self.best_share), changes=changes)


def read_entries(path: Path, entry: type[Any]) -> dict[str, Any]:
    """
    The entries of a YAML file by name.

    :param path: of the file
    :param entry: :class:`Data` or :class:`Baseline`
    :raises UsageError: another key than the entry has, or one is missing
    """
    keys, needed = set(entry._fields) - {"name"}, set(entry._fields) - {"name"} - set(entry._field_defaults)
    found = {}
    for name, values in read_yaml(path).items():
        if not isinstance(values, dict) or set(values) - keys or needed - set(values):
            raise UsageError(
                f"{path}, {name}: expected a mapping of {', '.join(sorted(keys))}; needs {', '.join(sorted(needed))}."
            )
        found[name] = entry(name, **values)
    return found


def baseline_key(data: Data, baseline: Baseline, seed: int, label: str = "") -> RunKey:
    """Return what a baseline's training on a dataset is known by."""
    return RunKey(data.task, data.fraction, baseline.name, seed, PROFILE, "-".join(filter(None, (data.name, label))))


def export(data: Data, baseline: Baseline, path: Path, known: Mapping[str, Any]) -> TrajectoryBuffer:
    """
    Write the episodes that a baseline is to learn from, as flat arrays.

    :param path: of the `.npz` file
    :param known: by the environment, see `reader_options`
    :return: the same episodes
    """
    settings = data.settings()
    options = {**known, **(settings.get("dataset_kwargs") or {})}
    buffer = load_dataset(settings["dataset"], **options)
    if baseline.best_share is not None:
        buffer = buffer.best(best_share=baseline.best_share)
    buffer.save(path)
    return buffer


class Budget(NamedTuple):
    """
    The length of a baseline's training.

    :param n_timesteps: gradient steps, at most
    :param minutes: of one core, at most; None for all of these steps
    """

    n_timesteps: int
    minutes: float | None


def budget_of(data: Data, baseline: Baseline, options: argparse.Namespace) -> Budget:
    """Return the budget that was asked for, or else the authors' steps in the minutes of the dataset."""
    if options.steps is not None:
        return Budget(options.steps, None)
    return Budget(baseline.n_timesteps, float(data.minutes if options.minutes is None else options.minutes))


def row_settings(data: Data, baseline: Baseline, budget: Budget) -> dict[str, Any]:
    """Return what a row has for settings: the episodes, the environment, the budget, and the worker's."""
    share = {} if baseline.best_share is None else {"best_share": baseline.best_share}
    return {
        **data.settings(),
        **budget._asdict(),
        **share,
        "worker": baseline.worker,
        baseline.worker: baseline.settings_for(data),
    }


def check_same(rows: Path, settings: dict[str, Any]) -> None:
    """
    Refuse to take a finished run for one of other settings.

    :raises UsageError: names what differs
    """
    found = read_rows(rows)[-1]["settings"]
    differing = sorted(key for key in {*found, *settings} if found.get(key) != settings.get(key))
    if differing:
        raise UsageError(
            f"{rows} is there with another {', '.join(differing)}; use another --label or --results, or move it away."
        )


def run_baseline(
    data: Data, baseline: Baseline, seed: int, options: argparse.Namespace, log: Path, say: Callable[[int, int, str], None]
) -> Row:
    """
    Train a baseline, and let it play the final episodes of the benchmark.

    :param log: file that gets what its process prints
    :param say: told the step, the number of steps, and what is being done
    :return: the row of its final evaluation
    :raises BaselineError: its process has ended
    """
    budget = budget_of(data, baseline, options)
    python = Path(getattr(options, f"{baseline.worker}_python"))
    vec_env = make_seeded_envs(data.task, data.settings(), options.n_eval_envs)
    with (
        contextlib.closing(vec_env),
        BaselineProcess(python, WORKERS[baseline.worker], log) as process,
        tempfile.TemporaryDirectory() as folder,
    ):
        path = Path(folder) / "episodes.npz"
        export(data, baseline, path, reader_options(vec_env))
        training = process.train(
            path, baseline.settings_for(data), seed, *budget, lambda done, n_steps: say(done, n_steps, "training")
        )
        seeds = range(FINAL_STATES, FINAL_STATES + options.final_episodes)
        n_steps = training.n_steps
        episodes = evaluate(process, vec_env, seeds, lambda n: say(n_steps, n_steps, f"evaluation {n}/{len(seeds)}"))
        action_ms = process.action_ms()
    return {
        **baseline_key(data, baseline, seed, options.label)._asdict(),
        "settings": row_settings(data, baseline, budget),
        "data": provenance.describe_data(provenance.read_data(data.task, data.settings()), data.dataset, data.recorded_from),
        "commit": provenance.commit(),
        "versions": {**provenance.versions(), **{f"baseline's {name}": number for name, number in process.versions.items()}},
        "step": n_steps,
        "final": True,
        **episodes._asdict(),
        "flow_solver": None,
        "flow_steps": None,
        "wall_s": round(training.seconds, 3),
        "steps_per_s": round(n_steps / training.seconds, 3),
        "action_ms": round(action_ms, 3),
        "hardware": {**provenance.hardware(th.device("cpu")), "threads": 1},
    }
