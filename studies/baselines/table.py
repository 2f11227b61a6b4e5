"""
The rows of `make baselines` as a table: success in percent or return, mean over seeds and its 95 % interval (Student's t).

    PYTHONPATH=studies python -m baselines.table results/baselines.csv           # a line for each dataset and algorithm
    PYTHONPATH=studies python -m baselines.table results/baselines.csv --suite results/suite.csv   # and our defaults
"""

import argparse
import itertools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from baselines.entries import HERE, Baseline, Data, read_entries
from baselines.process import STUDIES
from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.report.runs import Run, read_studies
from sb3_dtfm.benchmark.report.statistics import student_t

NONE = "-"
Grouped = dict[tuple[str, str], list[Run]]  # by dataset and algorithm
# Names in studies/suite.yml of datasets that have another one in studies/baselines.yml.
IN_SUITE = {"walker2d-clean": "walker2d-expert", "pusht-human": "pusht"}


def read(folder: Path) -> tuple[Grouped, list[str], list[str]]:
    """The runs, their datasets and their algorithms, as the YAML files have them; the rest of a label names the latter."""
    datasets = list(read_entries(STUDIES / "baselines.yml", Data))
    known = [*ALGORITHMS, *read_entries(HERE / "settings.yml", Baseline)]
    grouped: Grouped = {}
    for group in (group for study in read_studies([folder]) for group in study.groups):
        name = max((each for each in datasets if f"{group.label}-".startswith(f"{each}-")), key=len, default=None)
        if name is None:
            raise ValueError(f"{folder}: label {group.label!r} begins with no data set of studies/baselines.yml.")
        changed = group.label[len(name) + 1 :]
        for (_, _, algo), runs in group.runs.items():
            grouped.setdefault((name, ", ".join(filter(None, (algo, changed)))), []).extend(runs)
    algorithms = sorted({algo for _, algo in grouped}, key=lambda algo: (known.index(algo.partition(",")[0]), algo))
    return grouped, [name for name in datasets if any(name == each for each, _ in grouped)], algorithms


def result(runs: Sequence[Run]) -> str:
    """Mean and interval, of shares within what a share can be; a single run has none, and runs that are all alike."""
    interval = student_t([float(run.value("final") or 0.0) for run in runs])
    unit, lowest, highest = (" %", 0.0, 100.0) if runs[0].counts_success else ("", -math.inf, math.inf)
    low, high = max(interval.low, lowest), min(interval.high, highest)
    limits = "" if math.isnan(interval.low) else f" [{low:,.0f}, {high:,.0f}]"
    return f"{interval.estimate:,.0f}{unit}{limits}" + (" (1 seed)" if len(runs) == 1 else "")


def mean_of(runs: Sequence[Run], key: str, form: str) -> str:
    """Mean over runs of a number in their final rows."""
    return format(np.mean([run.final[key] for run in runs]), form)


def long_table(folder: Path) -> Iterable[Sequence[str]]:
    """Lines of results, minutes of training, gradient steps, and milliseconds an action."""
    grouped, datasets, algorithms = read(folder)
    yield "data", "algorithm", "seeds", "final", "each seed", "minutes", "gradient steps", "ms an action", "commits"
    for name in datasets:
        for algo in algorithms:
            if runs := grouped.get((name, algo)):
                yield (
                    name,
                    algo,
                    ", ".join(str(run.key.seed) for run in runs),
                    result(runs),
                    "; ".join(f"{run.value('final'):,.0f}" for run in runs),
                    f"{np.mean([run.minutes for run in runs]):.1f}",
                    mean_of(runs, "step", ",.0f"),
                    mean_of(runs, "action_ms", ".2f"),
                    ", ".join(dict.fromkeys(run.commit for run in runs)),
                )


def compared(folder: Path, suite: Path) -> tuple[Grouped, list[str], list[str]]:
    """As :func:`read`, with DT and DTFM by the classes' defaults, on the datasets that these have learned from."""
    grouped, datasets, algorithms = read(folder)
    others = [algo for algo in algorithms if algo.partition(",")[0] not in ALGORITHMS]
    defaults: Grouped = {}
    for group in (group for study in read_studies([suite]) for group in study.groups):
        for (task, _, algo), runs in group.runs.items():
            defaults.setdefault((task, algo), []).extend(runs)
    found: Grouped = {(name, algo): runs for (name, algo), runs in grouped.items() if algo in others}
    for name, algo in itertools.product(datasets, ALGORITHMS):
        if runs := defaults.get((IN_SUITE.get(name, name), algo)):
            found[name, algo] = runs
    ours = [name for name in datasets if any((name, algo) in found for algo in ALGORITHMS)]
    return found, ours, [*ALGORITHMS, *others]


def suite_table(folder: Path, suite: Path) -> Iterable[Sequence[str]]:
    """Lines of DT and DTFM by the classes' defaults and of the other algorithms, the best of which has its interval."""
    grouped, datasets, algorithms = compared(folder, suite)
    yield "data", *(algo.upper() if algo in ALGORITHMS else algo for algo in algorithms)
    for name in datasets:
        found = {algo: grouped[name, algo] for algo in algorithms if (name, algo) in grouped}
        others = [algo for algo in found if algo not in ALGORITHMS]
        best = max(others, key=lambda algo: float(np.mean([run.value("final") for run in found[algo]])), default=None)
        cells = {algo: result(runs) for algo, runs in found.items()}
        cells |= {algo: cells[algo].partition(" [")[0] for algo in others if algo != best}
        yield name, *(cells.get(algo, NONE) for algo in algorithms)


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--suite", type=Path, metavar="FOLDER", help="rows of studies/suite.yml")
    options = parser.parse_args()
    folder = options.folder
    table = suite_table(folder, options.suite) if options.suite else long_table(folder)
    header, *lines = table
    for line in (header, ["---"] * len(header), *lines):
        print(f"| {' | '.join(line)} |")


if __name__ == "__main__":
    main()
