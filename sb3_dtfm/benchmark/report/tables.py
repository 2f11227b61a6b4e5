"""The tables of a report, in Markdown."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from sb3_dtfm.benchmark.report.changes import changed_settings, compared_runs, split_changes
from sb3_dtfm.benchmark.report.runs import (
    MEASURES,
    N_LATE,
    THRESHOLD,
    THRESHOLD_NAME,
    Group,
    Run,
    Study,
    final_interval,
    full_name,
    late_interval,
    paired_scores,
    spread,
    steps_to_success,
)
from sb3_dtfm.benchmark.report.statistics import (
    Interval,
    bootstrap,
    interquartile_mean,
    n_single_runs,
    probability_of_improvement,
)

NOT_RUN = "*not run*"
NONE = "-"
CAPTION = (
    "Mean over seeds of the evaluations before and during training. The band is a 95 % interval over episodes (Wilson's, of "
    "all seeds, for success; Student's t, of the one seed, for returns), or the returns that several seeds reached."
)
SOLVED_CAPTION = (
    "Share of the final episodes, of all seeds, that had succeeded by an environment step, and the median of it."
)
SCORES_CAPTION = (
    "Scores of the final evaluation: 0 is the mean return of random actions, or no success; 1 is what the best tenth of the "
    "recorded episodes reached. A mark is the mean over seeds with the 95 % interval of the table; one beyond the axis is "
    "drawn at its edge. A star marks data that a default was chosen with; the others judge the defaults."
)
COMPACT_TEXT = (
    "Final evaluation: success in percent, or mean return. Mean over seeds and 95 % interval: Student's t over seeds; of "
    "success the wider one of that and Wilson's over the episodes of all seeds. Returns of one seed have no interval."
)
MINUTES_CAPTION = (
    "The same evaluations against minutes of training, without the evaluations' own: means over seeds at each gradient "
    f"step. The thin line is {THRESHOLD_NAME}."
)
TO_THRESHOLD = f"minutes to {100 * THRESHOLD:.0f} %"
TO_THRESHOLD_IS = (
    f"{TO_THRESHOLD.capitalize()}: of training, until an evaluation (the final one counts too) is first at or above "
    f"{THRESHOLD_NAME}. Mean over the seeds that got there; no finer than evaluations "
    "are apart. Compare only minutes of the same machine."
)

Say = Callable[[list[Run]], str]


def make_report(studies: Sequence[Study], figures: Mapping[tuple[str, str], Mapping[str, str]]) -> str:
    """
    The whole report.

    :param studies: studies to report on, in this order
    :param figures: file names by study and title of a group, and by what they show: "scores" beside behaviour cloning,
        "curves" of learning by gradient step or by "minutes", what was "solved" by environment step; each if drawn
    :return: Markdown
    """
    parts = ["# DT and DTFM compared", ""]
    for study in studies:
        level = "###" if study.name else "##"
        parts += [f"## Study: {study.name}", ""] if study.name else []
        alone, changed = split_changes(study, studies)
        for group in alone:
            parts += [f"{level} Settings: {group.title}", "", *_group(group, figures[study.name, group.title])]
        for base, labelled in changed:
            parts += [f"{level} Changes to: {base.title}", "", *_changes(base, labelled), ""]
        if study.unfinished:
            parts += ["Left out, as they have no final evaluation: " + "; ".join(map(str, study.unfinished)) + ".", ""]
    return "\n".join(parts)


def _group(group: Group, figures: Mapping[str, str]) -> list[str]:
    def show(kind: str, title: str, caption: str) -> list[str]:
        return [f"![{title}]({figures[kind]})", "", caption, ""] if kind in figures else []

    parts = [*show("scores", "scores by data set", SCORES_CAPTION), *_compact(group), ""] if group.has_baselines else []
    if parts and "curves" not in figures:  # many data sets, of which the final evaluations count
        return [*parts, *_time(group), "", *_sources(group), ""]
    parts += [*show("curves", "learning curves", CAPTION), *_achieved(group), "", *_intervals(group), ""]
    if group.success_tasks:
        parts += [*show("solved", "episodes solved by environment step", SOLVED_CAPTION), *_steps(group), ""]
    parts += [*_scores(group), "", *_aggregates(group), ""]
    parts += [*show("minutes", "learning curves by minutes of training", MINUTES_CAPTION), *_time(group), ""]
    return [*parts, *_sources(group), ""]


def _compact(group: Group) -> list[str]:
    """A row for each data set: what was recorded, and what each algorithm reached."""
    algos = group.baselines_first
    rows = []
    for name, task, data_share in group.data_sets:
        runs = [group.of(task, data_share, algo) for algo in algos]
        reached = [_reached(each) if each else NOT_RUN for each in runs]
        seeds = [str(len(each)) for each in runs]
        rows.append([_escape(name), _recorded(next(each for each in runs if each)[0]), *reached, "; ".join(seeds)])
    return [COMPACT_TEXT, "", *_table(["data set", "recorded; best tenth", *map(full_name, algos), "seeds"], rows)]


def _reached(runs: Sequence[Run]) -> str:
    if runs[0].counts_success:
        return _bracket(final_interval(runs), "{:.0f}".format) + " %"
    return _bracket(final_interval(runs), _number)


def _recorded(run: Run) -> str:
    """Mean of the recorded episodes, and of the best tenth of them."""
    data = run.final["data"]
    if run.counts_success:
        shares = [data.get("success_rate"), data.get("best_success")]
        return "; ".join(NONE if share is None else f"{share:.0%}".replace("%", " %") for share in shares)
    returns = [data.get("mean_return"), data.get("best_return")]
    return "; ".join(NONE if each is None else _number(each) for each in returns)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows)]


def _task_table(
    group: Group,
    tasks: Sequence[str],
    columns: Mapping[str, Say],
    last: tuple[str, Callable[[list[list[Run]]], str]] | None = None,
) -> list[str]:
    """
    A row for each task and share of the data.

    :param columns: name of each column, and function from the runs of an algorithm to its cell; once for each algorithm
    :param last: name and function of a column at the end, of the runs of all algorithms
    """
    header = ["task", "data", *(f"{algo.upper()} {name}" for name in columns for algo in group.algorithms)]
    rows = []
    for task in tasks:
        for data_share in group.data_shares:
            runs = [group.of(task, data_share, algo) for algo in group.algorithms]
            cells = [say(each) if each else NOT_RUN for say in columns.values() for each in runs]
            rows.append([task, f"{data_share:.0%}", *cells, *([last[1](runs)] if last else [])])
    return _table([*header, last[0]] if last else header, rows)


def _achieved(group: Group) -> list[str]:
    """A table in the shape of the paper's."""
    text = (
        f"Mean ± standard deviation over seeds: success in percent, or mean return. The late average is the mean of the "
        f"last {N_LATE} evaluations of a run. Seeds of {' / '.join(map(str.upper, group.algorithms))}."
    )
    columns = _say_measures(*MEASURES)
    seeds = ("seeds", lambda runs: " / ".join(str(len(each)) for each in runs))
    return [text, "", *_task_table(group, group.tasks, columns, seeds)]


def _say_measures(*measures: str) -> dict[str, Say]:
    return {MEASURES[each]: partial(_mean_and_deviation, measure=each) for each in measures}


def _mean_and_deviation(runs: Sequence[Run], measure: str) -> str:
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
    text = (
        "95 % intervals. Late average: Student's t over seeds. Final evaluation: Student's t over seeds; of success the "
        "wider one of that and Wilson's over the episodes of all seeds."
    )
    columns = {MEASURES["late"]: _late, MEASURES["final"]: _final}
    return [text, "", *_task_table(group, group.tasks, columns)]


def _late(runs: Sequence[Run]) -> str:
    interval = late_interval(runs)
    return NONE if interval is None else _over_seeds(interval, runs)


def _final(runs: Sequence[Run]) -> str:
    interval = final_interval(runs)
    if not runs[0].counts_success:
        return _over_seeds(interval, runs)
    return f"{_bracket(interval, _percent)} % of {sum(run.final['n_episodes'] for run in runs)} episodes"


def _over_seeds(interval: Interval, runs: Sequence[Run]) -> str:
    why = "one seed" if len(runs) == 1 else "all seeds alike"
    return _bracket(interval, _percent if runs[0].counts_success else _number, f" ({why}, no interval)")


def _bracket(interval: Interval, format_: Callable[[float], str], without: str = "") -> str:
    """
    :param without: text that stands for the interval where the data give none
    """
    limits = without if math.isnan(interval.low) else f" [{format_(interval.low)}, {format_(interval.high)}]"
    return format_(interval.estimate) + limits


def _steps(group: Group) -> list[str]:
    """Table of how soon the median episode succeeds."""
    return _task_table(group, group.success_tasks, {"median steps to success": _median_steps})


def _median_steps(runs: Sequence[Run]) -> str:
    median = float(np.median(steps_to_success(runs)))
    return f"{median:.0f}" if math.isfinite(median) else NONE


def _scores(group: Group) -> list[str]:
    """Returns as shares of what the data's own agent reached."""
    tasks = [task for task in group.tasks if not any(run.counts_success for run in group.of_task(task))]
    if not tasks:
        return ["Success needs no scale: the score of a run is its success rate."]
    knows_random = any(run.knows_random for task in tasks for run in group.of_task(task))
    zero, one = ("the mean return of random actions", " best tenth of the") if knows_random else ("a return of 0", "")
    text = (
        f"Normalised scores: 0 is {zero}, 1 is the mean return of the{one} recorded episodes (of the whole dataset, "
        "whatever share was learned from). Mean over seeds."
    )
    columns = {MEASURES[measure]: lambda runs, measure=measure: _share(runs, measure) for measure in ("late", "final")}
    return [text, "", *_task_table(group, tasks, columns, ("1.00 is", _scale))]


def _share(runs: Sequence[Run], measure: str) -> str:
    scores = [score for run in runs if (score := run.score(measure)) is not None]
    return f"{np.mean(scores):.2f}" if scores else NONE


def _scale(runs_of_all: Sequence[Sequence[Run]]) -> str:
    """The returns that score 1, and their sources."""
    runs = [run for each in runs_of_all for run in each]
    scales = dict.fromkeys((run.scale, run.final["data"].get("recorded_from", "not named")) for run in runs)
    named = [f"{_number(scale)} ({_escape(source)})" for scale, source in scales if scale is not None]
    return "; ".join(named) or NONE


def _escape(text: object) -> str:
    """Text that may stand in a table."""
    return " ".join(str(text).split()).replace("|", "\\|")


def _aggregates(group: Group) -> list[str]:
    """Each algorithm beside the first: their interquartile means, and how probably its runs are the better ones."""
    first, *others = group.algorithms
    parts = [part for algo in others for part in _aggregates_of(group, algo, first)]
    return parts[:-1] or [f"Aggregates over tasks: {NOT_RUN} (no task has runs of two algorithms with a scale)."]


def _aggregates_of(group: Group, algo: str, base: str) -> list[str]:
    rows, text = [], ""
    for measure in ("late", "final"):
        keys, scores, others = paired_scores(group, algo, base, measure)
        if not keys:
            continue
        tasks = [task for task, _ in keys]
        aggregates = [
            _aggregate(tasks, interquartile_mean, others),
            _aggregate(tasks, interquartile_mean, scores),
            _aggregate(tasks, probability_of_improvement, scores, others),
        ]
        rows.append([MEASURES[measure], *aggregates])
        claim = "tasks like these, drawn anew with their runs" if len(set(tasks)) > 1 else "this task alone"
        text = (
            f"Aggregates of scores (success rate, or share of the recorded return) over what both have run: "
            f"{_count(len(keys), 'combination')} of task and share of the data, {_count(len(set(tasks)), 'task')}, "
            f"{_count(sum(map(len, [*scores, *others])), 'run')}. Interquartile mean, and probability that a run of "
            f"{algo.upper()} beats one of {base.upper()}; in brackets 95 % intervals for {claim} (Agarwal et al., 2021)."
        )
    header = ["score", f"{base.upper()} IQM", f"{algo.upper()} IQM", f"P({algo.upper()} > {base.upper()})"]
    return [text, "", *_table(header, rows), ""] if rows else []


def _aggregate(tasks: Sequence[str], statistic: Callable[..., float], *scores: Sequence[np.ndarray]) -> str:
    n_single = n_single_runs(*scores)
    without = f" (no interval: {_count(n_single, 'combination')} {'has' if n_single == 1 else 'have'} a single run)"
    return _bracket(bootstrap(statistic, tasks, *scores), lambda value: f"{value:.2f}", without)


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _time(group: Group) -> list[str]:
    text = f"Wall-clock time of training without evaluations, mean over seeds. {TO_THRESHOLD_IS}"
    columns: dict[str, Say] = {
        "minutes": _minutes,
        "steps/s": lambda runs: f"{np.mean([run.final['steps_per_s'] for run in runs]):.1f}",
        TO_THRESHOLD: _minutes_to_threshold,
    }
    return [text, "", *_task_table(group, group.tasks, columns)]


def _minutes(runs: Sequence[Run]) -> str:
    return f"{np.mean([run.minutes for run in runs]):.1f}"


def _minutes_to_threshold(runs: Sequence[Run]) -> str:
    minutes = [each for run in runs if (each := run.minutes_to_threshold) is not None]
    reached = [each for each in minutes if math.isfinite(each)]
    if not reached:
        return "not reached" if minutes else NONE
    seeds = "" if len(reached) == len(minutes) else f" ({len(reached)} of {_count(len(minutes), 'seed')})"
    return f"{np.mean(reached):.2f}{seeds}"


def _changes(base: Group, labelled: Sequence[Group]) -> list[str]:
    columns: dict[str, Say] = {
        **_say_measures("late", "final"),
        "minutes": _minutes,
        TO_THRESHOLD: _minutes_to_threshold,
        "commit": _commits,
    }
    rows = []
    for group in labelled:
        for task, data_share, algo, runs, same in compared_runs(base, group):
            settings = _escape(changed_settings(runs[0], base.of(task, data_share, algo)))
            cells = [say(each) if each else NOT_RUN for say in columns.values() for each in (runs, same)]
            seeds = f"{len(runs)}; {len(same)} without" if same and len(same) != len(runs) else str(len(runs))
            rows.append([group.label, settings or NONE, task, f"{data_share:.0%}", algo.upper(), *cells, seeds])
    text = (
        "Effects of a label's settings, beside the runs without it of the same seeds: mean ± standard deviation over seeds, "
        "success in percent or mean return; minutes of training without evaluations; commits of the code that trained them. "
        f"Where these differ, so may the code. {TO_THRESHOLD_IS}"
    )
    compared = [f"{name}{which}" for name in columns for which in ("", " without")]
    return [text, "", *_table(["label", "settings", "task", "data", "algorithm", *compared, "seeds"], rows)]


def _commits(runs: Sequence[Run]) -> str:
    return ", ".join(sorted({run.commit for run in runs})) or NONE


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
        lines += [f"- {task}: {'; '.join(sorted(data)) or NOT_RUN}; commit {_commits(group.of_task(task))}"]
    machines = {
        f"{each.get('gpu') or each.get('cpu')} ({each.get('threads')} of {each.get('cores')} cores)"
        for each in (row["hardware"] for row in finals)
    }
    solvers = {f"{row['flow_solver']}, {row['flow_steps']} steps" for row in finals if row["flow_solver"] is not None}
    versions = {f"torch {row['versions'].get('torch', '?')}" for row in finals}
    lines += [f"- machines: {'; '.join(sorted(machines))}", f"- flow solver: {'; '.join(sorted(solvers)) or NONE}"]
    return [*lines, f"- versions: {', '.join(sorted(versions))}"]
