"""
The rows of a study as a table: one line for each cell, a value for each seed, and the commits that they come from.

    python studies/summary.py results/windows

The tables of results/*/README.md are what this prints, and results/README.md says what the columns are.
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sb3_dtfm.benchmark.report.runs import N_LATE, Run, read_studies, steps_to_success

NONE = "-"
HORIZON = 1000  # Steps of an episode of MuJoCo's tasks in which nobody falls.
FIRST_STEPS = 100


def measured(run: Run, measure: str) -> str:
    """Success in percent, or mean return."""
    value = run.value(measure)
    if value is None:
        return NONE
    return f"{value:.0f}%" if run.counts_success else f"{value:,.0f}"


def fallen(run: Run) -> str:
    """How many of the late and the final episodes ended early, and in brackets how many of them in their first steps."""
    if run.counts_success:
        return NONE
    lengths = [length for row in [*run.evaluations[-N_LATE:], run.final] for length in row["lengths"]]
    return f"{sum(n < HORIZON for n in lengths)} ({sum(n < FIRST_STEPS for n in lengths)})"


def median_steps(run: Run) -> str:
    """Environment steps in which half of the final episodes had succeeded."""
    median = np.median(steps_to_success([run])) if run.counts_success else np.inf
    return f"{median:g}" if np.isfinite(median) else NONE


def milliseconds(runs: Sequence[Run]) -> str:
    """Of an action in one environment, the mean over those runs that tell."""
    told = [time for run in runs if (time := run.final.get("action_ms")) is not None]
    return f"{np.mean(told):.1f}" if told else NONE


def lines(folder: Path) -> Iterable[dict[str, str]]:
    """One for each label, task, share of the data and algorithm."""
    groups = [group for study in read_studies([folder]) for group in study.groups]
    for group in sorted(groups, key=lambda group: group.label):
        for (task, share, algo), runs in sorted(group.runs.items()):
            values = {
                "late average": [measured(run, "late") for run in runs],
                "final evaluation": [measured(run, "final") for run in runs],
                "fell": [fallen(run) for run in runs],
                "median steps": [median_steps(run) for run in runs],
            }
            yield {
                "label": f"`{group.label}`" if group.label else NONE,
                "task": task,
                "data": f"{share:.0%}",
                "algorithm": algo.upper(),
                "seeds": ", ".join(str(run.cell.seed) for run in runs),
                **{name: NONE if set(each) == {NONE} else "; ".join(each) for name, each in values.items()},
                "minutes": f"{np.mean([run.minutes for run in runs]):.1f}",
                "ms an action": milliseconds(runs),
                "commits": ", ".join(dict.fromkeys(run.commit for run in runs)),
            }


def table(folder: Path) -> str:
    """Markdown, without the columns that say nothing of these rows."""
    found = list(lines(folder))
    header = [name for name in found[0] if any(line[name] != NONE for line in found)]
    return "\n".join(
        f"| {' | '.join(line)} |"
        for line in [header, ["---"] * len(header), *([line[name] for name in header] for line in found)]
    )


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
