"""The tables of a report, in Markdown."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from sb3_dtfm.benchmark.changes import changed_settings, compared_cells, split_changes
from sb3_dtfm.benchmark.rows import Cell
from sb3_dtfm.benchmark.runs import (
    ALGORITHMS,
    MEASURES,
    N_LATE,
    Group,
    Run,
    final_interval,
    late_interval,
    paired_scores,
    spread,
    steps_to_success,
)
from sb3_dtfm.benchmark.statistics import (
    Interval,
    pooled_interquartile_mean,
    probability_of_improvement,
    stratified_bootstrap,
)

NOT_RUN = "*not run*"
NONE = "-"
CAPTION = (
    "Mean over seeds of the evaluations during training, and a 95 % band: Wilson's over the episodes of all seeds for "
    "success, Student's t over seeds for returns (over the episodes where there is one seed)."
)
SOLVED_CAPTION = (
    "Share of the final episodes, of all seeds, that had succeeded by an environment step, and the median of it."
)


def make_report(groups: Sequence[Group], figures: dict[str, list[str]], unfinished: Sequence[Cell] = ()) -> str:
    """
    The whole report.

    :param groups: runs by profile and label
    :param figures: file names by the group's title: of its learning curves, and of its successes by step if there are any
    :param unfinished: cells left out
    :return: Markdown
    """
    parts = ["# DT and DTFM compared", ""]
    alone, changed = split_changes(groups)
    for group in alone:
        curves, *solved = figures[group.title]
        parts += [f"## Settings: {group.title}", "", f"![learning curves]({curves})", "", CAPTION, ""]
        parts += [*_achieved(group), "", *_intervals(group), ""]
        for file in solved:
            parts += [f"![episodes solved by environment step]({file})", "", SOLVED_CAPTION, "", *_steps(group), ""]
        parts += [*_scores(group), "", *_aggregates(group), ""]
        parts += [*_time(group), "", *_sources(group), ""]
    for base, labelled in changed:
        parts += [f"## Changes to: {base.title}", "", *_changes(base, labelled), ""]
    if unfinished:
        parts += ["Left out, as they have no final evaluation: " + "; ".join(map(str, unfinished)) + ".", ""]
    return "\n".join(parts)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(line)} |" for line in lines]


def _cells(group: Group) -> list[tuple[str, float]]:
    return [(task, regime) for task in group.tasks for regime in group.regimes]


def _achieved(group: Group) -> list[str]:
    """Table in the shape of the paper's."""
    header = [
        "task",
        "data",
        *(f"{name} {MEASURES[measure]}" for measure in MEASURES for name in ALGORITHMS.values()),
        "seeds",
    ]
    rows = []
    for task, regime in _cells(group):
        runs = {algo: group.of(task, regime, algo) for algo in ALGORITHMS}
        values = [_mean_and_deviation(runs[algo], measure) for measure in MEASURES for algo in ALGORITHMS]
        rows.append([task, f"{regime:.0%}", *values, " / ".join(str(len(each)) for each in runs.values())])
    text = (
        f"Mean ± standard deviation over seeds: success in percent, or mean return. The late average is the mean of the "
        f"last {N_LATE} evaluations of a run. Seeds of DT / DTFM."
    )
    return [text, "", *_table(header, rows)]


def _mean_and_deviation(runs: Sequence[Run], measure: str) -> str:
    if not runs:
        return NOT_RUN
    found = spread(runs, measure)
    if found is None:
        return NONE
    mean, deviation = found
    digits = 1 if runs[0].counts_success else _digits(mean)
    return f"{mean:,.{digits}f}" if math.isnan(deviation) else f"{mean:,.{digits}f} ± {deviation:,.{digits}f}"


def _percent(value: float) -> str:
    return f"{value:.1f}"


def _number(value: float) -> str:
    return f"{value:,.{_digits(value)}f}"


def _digits(value: float) -> int:
    """Digits behind the point of a return of this size."""
    return 0 if abs(value) >= 100 else 2


def _intervals(group: Group) -> list[str]:
    rows = []
    for task, regime in _cells(group):
        runs = [group.of(task, regime, algo) for algo in ALGORITHMS]
        rows.append([task, f"{regime:.0%}", *map(_late, runs), *map(_final, runs)])
    header = [f"{name} {MEASURES[measure]}" for measure in ("late", "final") for name in ALGORITHMS.values()]
    text = (
        "95 % intervals. Late average: Student's t over seeds. Final evaluation: Wilson's over the episodes of all seeds "
        "for success, Student's t over seeds for returns."
    )
    return [text, "", *_table(["task", "data", *header], rows)]


def _late(runs: Sequence[Run]) -> str:
    if not runs:
        return NOT_RUN
    interval = late_interval(runs)
    if interval is None:
        return NONE
    return _bracket(interval, _percent if runs[0].counts_success else _number)


def _final(runs: Sequence[Run]) -> str:
    if not runs:
        return NOT_RUN
    interval = final_interval(runs)
    if runs[0].counts_success:
        n_episodes = sum(len(run.final["returns"]) for run in runs)
        return f"{_bracket(interval, _percent)} % of {n_episodes} episodes"
    return _bracket(interval, _number)


def _bracket(interval: Interval, format_: Callable[[float], str]) -> str:
    if math.isnan(interval.low):
        return f"{format_(interval.estimate)} (one seed, no interval)"
    return f"{format_(interval.estimate)} [{format_(interval.low)}, {format_(interval.high)}]"


def _steps(group: Group) -> list[str]:
    """Table of how soon the median episode succeeds."""
    rows = []
    for task, regime in _cells(group):
        if task in group.success_tasks:
            rows.append([task, f"{regime:.0%}", *(_median_steps(group.of(task, regime, algo)) for algo in ALGORITHMS)])
    return _table(["task", "data", *(f"{name} median steps to success" for name in ALGORITHMS.values())], rows)


def _median_steps(runs: Sequence[Run]) -> str:
    if not runs:
        return NOT_RUN
    median = float(np.median(steps_to_success(runs)))
    return f"{median:.0f}" if math.isfinite(median) else NONE


def _scores(group: Group) -> list[str]:
    """Returns as shares of what the data's own agent reached."""
    rows = []
    for task, regime in _cells(group):
        runs = {algo: group.of(task, regime, algo) for algo in ALGORITHMS}
        if any(run.counts_success for each in runs.values() for run in each):
            continue
        shares = [_share(runs[algo], measure) for measure in ("late", "final") for algo in ALGORITHMS]
        rows.append([task, f"{regime:.0%}", _scale([run for each in runs.values() for run in each]), *shares])
    if not rows:
        return ["Success needs no scale: the score of a run is its success rate."]
    header = [
        "task",
        "data",
        "1.00 is",
        *(f"{name} {MEASURES[measure]}" for measure in ("late", "final") for name in ALGORITHMS.values()),
    ]
    text = (
        "Normalised scores: 0 is a return of 0, 1 is the mean return of the recorded episodes (of the whole dataset, "
        "whatever share was learned from). Mean over seeds."
    )
    return [text, "", *_table(header, rows)]


def _share(runs: Sequence[Run], measure: str) -> str:
    if not runs:
        return NOT_RUN
    scores = [score for run in runs if (score := run.score(measure)) is not None]
    return f"{sum(scores) / len(scores):.2f}" if scores else NONE


def _scale(runs: Sequence[Run]) -> str:
    """The returns that count as 1, and whose they are."""
    scales = {
        (run.final["data"].get("mean_return"), run.final["data"].get("recorded_from", "not named")): None for run in runs
    }
    named = [
        f"{_number(mean_return)} ({_escape(source)})"
        for mean_return, source in scales
        if isinstance(mean_return, float | int) and mean_return > 0
    ]
    return "; ".join(named) or NONE


def _escape(text: object) -> str:
    """Text that may stand in a table."""
    return " ".join(str(text).split()).replace("|", "\\|")


def _aggregates(group: Group) -> list[str]:
    rows, keys_used = [], []
    for measure in ("late", "final"):
        keys, dt, dtfm = paired_scores(group, measure)
        if not keys:
            continue
        keys_used = keys
        intervals = [
            stratified_bootstrap(pooled_interquartile_mean, dt),
            stratified_bootstrap(pooled_interquartile_mean, dtfm),
            stratified_bootstrap(probability_of_improvement, dtfm, dt),
        ]
        rows.append([MEASURES[measure], *(_bracket(interval, lambda value: f"{value:.2f}") for interval in intervals)])
    if not rows:
        return ["Aggregates over tasks: " + NOT_RUN + " (no task has runs of both algorithms with a scale)."]
    n_cells, n_runs = len(keys_used), sum(len(group.of(*key, algo)) for key in keys_used for algo in ALGORITHMS)
    text = (
        f"Aggregates over the {n_cells} pairs of task and data that both algorithms have run ({n_runs} runs), of scores "
        "(success rate, or share of the recorded return): interquartile mean, and probability that a run of DTFM beats one "
        "of DT. In brackets 95 % intervals by stratified bootstrap (Agarwal et al., 2021)."
    )
    return [text, "", *_table(["score", "DT IQM", "DTFM IQM", "P(DTFM > DT)"], rows)]


def _time(group: Group) -> list[str]:
    header = ["task", "data"]
    for name in ALGORITHMS.values():
        header += [f"{name} minutes", f"{name} steps/s", f"{name} score (%) per minute"]
    rows = []
    for task, regime in _cells(group):
        row = [task, f"{regime:.0%}"]
        for algo in ALGORITHMS:
            row += _pace(group.of(task, regime, algo))
        rows.append(row)
    text = (
        "Wall-clock time of training without evaluations, mean over seeds; the last column is success (or the share of the "
        "recorded return) of the final evaluation, in percent, for each minute of training. Compare only what ran on the "
        "same machine."
    )
    return [text, "", *_table(header, rows)]


def _pace(runs: Sequence[Run]) -> list[str]:
    if not runs:
        return [NOT_RUN] * 3
    minutes = sum(run.minutes for run in runs) / len(runs)
    steps_per_s = sum(run.final["steps_per_s"] for run in runs) / len(runs)
    paces = [100.0 * score / run.minutes for run in runs if (score := run.score("final")) is not None and run.minutes > 0]
    return [f"{minutes:.1f}", f"{steps_per_s:.1f}", f"{sum(paces) / len(paces):.1f}" if paces else NONE]


def _changes(base: Group, labelled: Sequence[Group]) -> list[str]:
    rows = []
    for group in labelled:
        for task, regime, algo, runs, same in compared_cells(base, group):
            settings = _escape(changed_settings(runs[0], base.of(task, regime, algo)))
            minutes = f"{sum(run.minutes for run in runs) / len(runs):.1f}"
            results = [_mean_and_deviation(each, measure) for measure in ("late", "final") for each in (runs, same)]
            rows.append(
                [group.label, settings or NONE, task, f"{regime:.0%}", ALGORITHMS[algo], *results, str(len(runs)), minutes]
            )
    measures = [f"{MEASURES[measure]}{which}" for measure in ("late", "final") for which in ("", " without")]
    text = (
        "What a label's settings did, beside the runs without it of the same seeds: mean ± standard deviation over seeds, "
        "success in percent or mean return; minutes of training."
    )
    header = ["label", "settings", "task", "data", "algorithm", *measures, "seeds", "minutes"]
    return [text, "", *_table(header, rows)]


def _sources(group: Group) -> list[str]:
    """Data, code and machines behind the numbers."""
    lines = ["Data, machines and code:", ""]
    finals = [run.final for runs in group.runs.values() for run in runs]
    for task in group.tasks:
        data = {
            f"`{each.get('dataset', 'not named')}`, {each.get('n_episodes', '?')} episodes, "
            f"recorded from {_escape(each.get('recorded_from', 'an agent not named'))}"
            for each in (run.final["data"] for run in group.of_task(task))
        }
        lines += [f"- {task}: {'; '.join(sorted(data)) or NOT_RUN}"]
    machines = {
        f"{each.get('gpu') or each.get('cpu')} ({each.get('threads')} of {each.get('cores')} cores)"
        for each in (row["hardware"] for row in finals)
    }
    solvers = {f"{row['solver']}, {row['n_solver_steps']} steps" for row in finals if row["solver"] is not None}
    lines += [f"- machines: {'; '.join(sorted(machines))}", f"- DTFM's solver: {'; '.join(sorted(solvers)) or NONE}"]
    commits = {
        row["commit"][:10] + ("-dirty" if row["commit"].endswith("-dirty") else "") for row in finals if row["commit"]
    }
    versions = {f"torch {row['versions'].get('torch', '?')}" for row in finals}
    return [*lines, f"- commits: {', '.join(sorted(commits)) or NONE}; {', '.join(sorted(versions))}"]
