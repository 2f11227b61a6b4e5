"""Training runs made of results: the achievement of each, and summaries of several seeds."""

import math
import os
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from sb3_dtfm.benchmark.report.statistics import Interval, mean_and_deviation, student_t, t_interval, wilson
from sb3_dtfm.benchmark.results import Result, read_results
from sb3_dtfm.benchmark.rows import BASELINES, RunKey

# The paper's comparison, which is shown whether it was run or not.
PAPER_ALGORITHMS = ("dt", "dtfm")
PAPER_SHARES = (1.0, 0.5)
N_LATE = 5  # evaluations in the late average
MEASURES = {"late": "late average", "best": "best evaluation", "final": "final evaluation"}
THRESHOLD = 0.95  # share of the scale that training takes its minutes to reach
THRESHOLD_NAME = f"{100 * THRESHOLD:.0f} % of recorded return, or success"
OVER_EPISODES, OVER_SEEDS = "95 % interval over episodes", "range over seeds"


class Run(NamedTuple):
    """
    One training run.

    :param key: identity of the run
    :param evaluations: results of the evaluations before and during training, by gradient step
    :param final: result of the final evaluation
    """

    key: RunKey
    evaluations: list[Result]
    final: Result

    @property
    def counts_success(self) -> bool:
        """Return whether its task reports success; the mean return measures it otherwise."""
        return self.final["successes"] is not None

    def value(self, measure: str) -> float | None:
        """
        Success in percent, or mean return in reward units.

        :param measure: "late", "best" or "final"; an evaluation before the first gradient step counts for none
        :return: None where there was no evaluation during training
        """
        if measure == "final":
            return row_value(self.final)
        values = [row_value(row) for row in self.evaluations if row["step"] > 0]
        if not values:
            return None
        return max(values) if measure == "best" else float(np.mean(values[-N_LATE:]))

    def score(self, measure: str) -> float | None:
        """
        The value on a scale common to tasks, see :meth:`to_score`.

        :return: None where there is no scale, or no value
        """
        value = self.value(measure)
        return None if value is None else self.to_score(value)

    def to_score(self, value: float) -> float | None:
        """
        A value on the scale of scores, from the reference of 0 to that of 1.

        :param value: success in percent, or mean return in reward units
        :return: None where there is no scale
        """
        return None if self.scale is None else (value - self.zero) / (self.scale - self.zero)

    @property
    def knows_random(self) -> bool:
        """Return whether the return of random actions was measured, as it is since rows tell of the best tenth, too."""
        return not self.counts_success and "random_return" in self.final["data"]

    @property
    def zero(self) -> float:
        """Reference of score 0: no success, or the mean return of random actions; a return of 0 where that is not known."""
        return float(self.final["data"]["random_return"]) if self.knows_random else 0.0

    @property
    def scale(self) -> float | None:
        """
        Reference of score 1: the successes of the best tenth of the recorded episodes, in percent, or 100 if unknown;
        without successes the mean return of the best tenth, or of all where that of random actions is not known.

        :return: None where that is not known, or not above the reference of 0
        """
        data = self.final["data"]
        if self.counts_success:
            return 100.0 * (data.get("best_success") or 1.0)
        scale = data.get("best_return" if self.knows_random else "mean_return")
        return scale if isinstance(scale, float | int) and scale > self.zero else None

    @property
    def threshold(self) -> float | None:
        """95 % of the way from the reference of score 0 to that of score 1; None where there is no scale."""
        return None if self.scale is None else self.zero + THRESHOLD * (self.scale - self.zero)

    @property
    def steps(self) -> int:
        """Gradient steps of training."""
        return self.final["step"]

    @property
    def minutes(self) -> float:
        """Training time without evaluations."""
        return self.final["wall_s"] / 60

    @property
    def minutes_to_threshold(self) -> float | None:
        """
        Minutes of training until an evaluation, the final one included, is first at the threshold or above.

        :return: inf where none is; None where there is no threshold
        """
        if self.threshold is None:
            return None
        rows = (row for row in (*self.evaluations, self.final) if row["step"] > 0)
        return next((row["wall_s"] / 60 for row in rows if row_value(row) >= self.threshold), math.inf)

    @property
    def commit(self) -> str:
        """Short hash of the code that trained it."""
        commit, dash, dirty = (self.final["commit"] or "unknown").partition("-")
        return commit[:7] + dash + dirty


class Curve(NamedTuple):
    """
    A learning curve of several runs.

    :param steps: gradient steps (E,)
    :param minutes: minutes of training until then, mean over runs (E,)
    :param mean: mean over runs of success in percent, or of return in reward units (E,)
    :param low: limit of a band around it (E,)
    :param high: other limit of that band (E,)
    :param band: name of the band
    """

    steps: np.ndarray
    minutes: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    band: str


class Group(NamedTuple):
    """
    All runs of one profile and label in a study: one part of the report.

    :param profile: name of the settings
    :param label: name of further changes, "" for none
    :param tasks: tasks that the table shows, run or not
    :param runs: runs by task, share of the data and algorithm, in the order of seeds
    """

    profile: str
    label: str
    tasks: list[str]
    runs: dict[tuple[str, float, str], list[Run]]

    @property
    def title(self) -> str:
        """Heading."""
        return f"{self.profile}, {self.label}" if self.label else self.profile

    @property
    def algorithms(self) -> list[str]:
        """The paper's, and others that were run."""
        return list(dict.fromkeys([*PAPER_ALGORITHMS, *sorted(algo for _, _, algo in self.runs)]))

    @property
    def data_shares(self) -> list[float]:
        """Shares of the data, the paper's (unless it is another comparison) and those run, largest first."""
        paper = () if self.label or self.has_baselines else PAPER_SHARES
        return sorted({*paper, *(data_share for _, data_share, _ in self.runs)}, reverse=True)

    @property
    def has_baselines(self) -> bool:
        """Return whether behaviour cloning was run, too."""
        return any(algo in BASELINES for _, _, algo in self.runs)

    @property
    def baselines_first(self) -> list[str]:
        """The algorithms, behaviour cloning before the others."""
        return sorted(self.algorithms, key=lambda algo: algo not in BASELINES)

    @property
    def data_sets(self) -> list[tuple[str, str, float]]:
        """Describe all data sets: a name, with a star where a default was chosen with it, the task, its share of data."""
        found = []
        for task, data_share in sorted({(task, data_share) for task, data_share, _ in self.runs}):
            star = "*" if any(run.final["data"].get("chosen_with") for run in self.of_task(task)) else ""
            share = f", {data_share:.0%}" if len(self.data_shares) > 1 else ""
            found.append((f"{task}{star}{share}", task, data_share))
        return found

    @property
    def compares(self) -> bool:
        """Return whether several algorithms were run."""
        return len({algo for _, _, algo in self.runs}) > 1

    @property
    def success_tasks(self) -> list[str]:
        """Return the tasks with runs, all of which report success."""
        return [task for task in self.tasks if (runs := self.of_task(task)) and all(run.counts_success for run in runs)]

    def of(self, task: str, data_share: float, algo: str) -> list[Run]:
        """Runs of all seeds, none if there was no run."""
        return self.runs.get((task, data_share, algo), [])

    def of_task(self, task: str) -> list[Run]:
        """All runs on one task."""
        return [run for (each, _, _), runs in self.runs.items() if each == task for run in runs]


class Study(NamedTuple):
    """
    Content of one folder or table of results.

    :param name: name of the folder or table, "" for results that were named themselves
    :param groups: groups of its runs by profile and label
    :param unfinished: runs left out because they have no final evaluation
    """

    name: str
    groups: list[Group]
    unfinished: list[RunKey]


def read_studies(paths: Iterable[str | os.PathLike[str]], tasks: Sequence[str] = ()) -> list[Study]:
    """
    The studies in tables, and in files and folders of rows; those with runs of a profile as it is come first.

    :param paths: paths of results, see :func:`~sb3_dtfm.benchmark.results.read_results`
    :param tasks: tasks to show first, see :func:`group_runs`
    :raises FileNotFoundError: one of them does not exist
    :raises RowError: a malformed line, or two different results of the same evaluation in one study
    """
    studies = [Study(name, *group_runs(results, tasks)) for name, results in read_results(paths).items()]
    return sorted(studies, key=lambda study: (all(group.label for group in study.groups), study.name))


def full_name(algo: str) -> str:
    """Long name of an algorithm in figures and tables."""
    return {"bc-best": "BC of the best tenth"}.get(algo, algo.upper())


def row_value(result: Result) -> float:
    """Success in percent where the task reports it, else the mean return."""
    successes: int | None = result["successes"]
    return float(result["mean_return"]) if successes is None else 100.0 * (successes / result["n_episodes"])


def group_runs(results: Iterable[Result], tasks: Sequence[str] = ()) -> tuple[list[Group], list[RunKey]]:
    """
    Runs by profile and label.

    :param results: results in any order
    :param tasks: tasks to show first and in this order; without a label also those that were not run
    :return: the groups, and runs left out because they have no final evaluation
    """
    evaluations: dict[RunKey, list[Result]] = {}
    finals: dict[RunKey, Result] = {}
    for result in sorted(results, key=lambda result: int(result["step"])):
        during = evaluations.setdefault(RunKey.of(result), [])
        if result["final"]:
            finals[RunKey.of(result)] = result
        else:
            during.append(result)
    groups: dict[tuple[str, str], Group] = {}
    for key in sorted(finals):
        group = groups.setdefault((key.profile, key.label), Group(key.profile, key.label, [], {}))
        group.tasks.append(key.task)
        group.runs.setdefault((key.task, key.data_share, key.algo), []).append(Run(key, evaluations[key], finals[key]))
    for group in groups.values():
        # A label's changes may not be meant for all tasks.
        first = [task for task in tasks if task in group.tasks] if group.label else tasks
        group.tasks[:] = dict.fromkeys([*first, *group.tasks])
    return [groups[key] for key in sorted(groups)], sorted(set(evaluations) - set(finals))


def spread(runs: Sequence[Run], measure: str) -> tuple[float, float] | None:
    """Mean and standard deviation of a measure over runs; None where it was not taken."""
    values = [value for run in runs if (value := run.value(measure)) is not None]
    return mean_and_deviation(values) if values else None


def final_interval(runs: Sequence[Run]) -> Interval:
    """
    Final evaluation: return with Student's interval over runs; success in percent with the wider of that and Wilson's of all
    episodes, which tells more where runs are alike, or there is one.
    """
    over_runs = student_t([row_value(run.final) for run in runs])
    if not all(run.counts_success for run in runs):
        return over_runs
    over_episodes = _pooled_success([run.final for run in runs])
    low, high = np.clip(over_runs[1:], 0.0, 100.0).tolist()
    wider = high - low > over_episodes.high - over_episodes.low
    return Interval(over_runs.estimate, low, high) if wider else over_episodes


def score_interval(runs: Sequence[Run]) -> Interval | None:
    """Student's interval of the final result on the scale of scores; None where there is none."""
    scores = [runs[0].to_score(limit) for limit in final_interval(runs)]
    return None if None in scores else Interval(*scores)  # type: ignore[arg-type]


def late_interval(runs: Sequence[Run]) -> Interval | None:
    """
    Late average with Student's interval over runs, as the evaluations of one run repeat the same states.

    :return: interval, cut to [0, 100] for success; None where there was no evaluation during training
    """
    values = [value for run in runs if (value := run.value("late")) is not None]
    if not values:
        return None
    interval = student_t(values)
    return Interval(*np.clip(interval, 0.0, 100.0).tolist()) if runs[0].counts_success else interval


def _pooled_success(results: Sequence[Result]) -> Interval:
    counts = (sum(result[key] for result in results) for key in ("successes", "n_episodes"))
    return Interval(*(100.0 * limit for limit in wilson(*counts)))


def steps_to_success(runs: Sequence[Run]) -> np.ndarray:
    """Environment steps that each final episode of all runs took to succeed, ascending; inf for those that failed."""
    solved = [step for run in runs for step in run.final["steps_to_success"]]
    n_failed = sum(run.final["n_episodes"] for run in runs) - len(solved)
    return np.array(sorted(solved) + [np.inf] * n_failed, float)


def learning_curve(runs: Sequence[Run]) -> Curve:
    """
    Mean over runs at each gradient step at which all of them were evaluated.

    The band is Wilson's interval over the episodes of all runs for success; for returns it is Student's over the episodes of
    a single run, and what the runs reached where there are several: an interval over two or three seeds says little more.
    """
    by_step = [{row["step"]: row for row in run.evaluations} for run in runs]
    steps = sorted(set.intersection(*(set(rows) for rows in by_step)))
    several = len(runs) > 1 and not all(run.counts_success for run in runs)
    points = []
    for step in steps:
        rows = [each[step] for each in by_step]
        values = [row_value(row) for row in rows]
        if several:
            interval = Interval(float(np.mean(values)), min(values), max(values))
        elif runs[0].counts_success:
            interval = _pooled_success(rows)
        else:
            interval = t_interval(*(rows[0][key] for key in ("mean_return", "std_return", "n_episodes")))
        seconds = np.mean([row["wall_s"] for row in rows])
        points.append((seconds / 60, np.mean(values), interval.low, interval.high))
    minutes, mean, low, high = np.array(points, float).reshape(-1, 4).T
    return Curve(np.array(steps, int), minutes, mean, low, high, OVER_SEEDS if several else OVER_EPISODES)


def paired_scores(
    group: Group, algo: str, other: str, measure: str
) -> tuple[list[tuple[str, float]], list[np.ndarray], list[np.ndarray]]:
    """
    Scores of the tasks and shares that two algorithms have run.

    :return: task and data_share of each, and the runs' scores of the first and of the second
    """
    found = []
    for task in group.tasks:
        for data_share in group.data_shares:
            scores = [[run.score(measure) for run in group.of(task, data_share, each)] for each in (algo, other)]
            if all(values and None not in values for values in scores):
                found.append(((task, data_share), *(np.array(values, float) for values in scores)))
    keys, mine, theirs = map(list, zip(*found, strict=True)) if found else ([], [], [])
    return keys, mine, theirs
