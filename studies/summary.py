"""
The results of a study as a table: a line for each task, share and algorithm, a value for each seed, and the commits.

    python studies/summary.py results/windows.csv       # or a folder of rows
    python studies/summary.py results/*.csv             # of several, what results/README.md says of each
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sb3_dtfm.benchmark.report.runs import N_LATE, PAPER_ALGORITHMS, Run, read_studies, steps_to_success

NONE = "-"


def measured(run: Run, measure: str) -> str:
    """Success in percent, or mean return."""
    value = run.value(measure)
    if value is None:
        return NONE
    return f"{value:.0f}%" if run.counts_success else f"{value:,.0f}"


def fallen(run: Run) -> str:
    """Return how many late and final episodes ended early, and in brackets how many of them in their first steps."""
    if run.counts_success:
        return NONE
    results = [*run.evaluations[-N_LATE:], run.final]
    early, at_once = (sum(result[key] for result in results) for key in ("n_under_1000", "n_under_100"))
    return f"{early} ({at_once})"


def median_steps(run: Run) -> str:
    """Environment steps in which half of the final episodes had succeeded."""
    median = np.median(steps_to_success([run])) if run.counts_success else np.inf
    return f"{median:g}" if np.isfinite(median) else NONE


def milliseconds(runs: Sequence[Run]) -> str:
    """Milliseconds of an action in one environment, the mean over those runs that tell."""
    told = [time for run in runs if (time := run.final.get("action_ms")) is not None]
    return f"{np.mean(told):.1f}" if told else NONE


def about(path: Path) -> dict[str, str]:
    """The line of a study in results/README.md."""
    runs = [run for study in read_studies([path]) for group in study.groups for of in group.runs.values() for run in of]
    algos = sorted({run.key.algo for run in runs}, key=lambda algo: (algo not in PAPER_ALGORITHMS, algo))
    seeds = sorted({run.key.seed for run in runs})
    commits = [commit for commit, _ in Counter(run.commit for run in runs).most_common()]
    return {
        "study": f"[{path.stem}]({path.name})",
        "algorithms": _first([algo.upper() for algo in algos], 4),
        "seeds": str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]}-{seeds[-1]}",
        "commits": _first(commits, 2),
    }


def _first(names: Sequence[str], n: int) -> str:
    return ", ".join(names) if len(names) <= n else f"{', '.join(names[:2])}, +{len(names) - 2}"


def lines(path: Path) -> Iterable[dict[str, str]]:
    """One for each label, task, share of the data and algorithm."""
    groups = [group for study in read_studies([path]) for group in study.groups]
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
                "seeds": ", ".join(str(run.key.seed) for run in runs),
                **{name: NONE if set(each) == {NONE} else "; ".join(each) for name, each in values.items()},
                "minutes": f"{np.mean([run.minutes for run in runs]):.1f}",
                "ms an action": milliseconds(runs),
                "commits": ", ".join(dict.fromkeys(run.commit for run in runs)),
            }


def table(path: Path) -> str:
    """Markdown, without the columns that say nothing of these results."""
    found = list(lines(path))
    return _markdown(found, [name for name in found[0] if any(line[name] != NONE for line in found)])


def _markdown(found: Sequence[dict[str, str]], header: Sequence[str]) -> str:
    return "\n".join(
        f"| {' | '.join(line)} |"
        for line in [header, ["---"] * len(header), *([line[name] for name in header] for line in found)]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, help="CSV files of results, or folders of rows")
    paths = parser.parse_args().paths
    print(table(*paths) if len(paths) == 1 else _markdown(each := [about(path) for path in paths], list(each[0])))
