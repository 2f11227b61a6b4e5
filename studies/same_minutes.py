"""
Results of a study's runs when those of another one, which need fewer minutes, were finished: same tasks and data.

    python studies/same_minutes.py results/one-token.csv results/small.csv --labels one-token ""

A line for each task and algorithm: the means over the last three evaluations that were made within these minutes of
training, seed by seed. The longer runs are cut short, so their learning rate had not come down yet. Other jobs can only make
a run slower: the steps take as long as in the quickest run of a task and algorithm.
"""

import argparse
from pathlib import Path

import numpy as np

from sb3_dtfm.benchmark.report.runs import Run, read_studies, row_value

N_LAST = 3


def runs_of(folder: Path, label: str) -> dict[tuple, list[Run]]:
    """Return runs by task, share of the data and algorithm."""
    groups = [group for study in read_studies([folder]) for group in study.groups if group.label == label]
    return {key: runs for group in groups for key, runs in group.runs.items()}


def minutes_a_step(runs: list[Run]) -> float:
    """Return the minutes of a step of the quickest run."""
    return min(run.minutes / run.final["step"] for run in runs)


def reached(run: Run, n_steps: float) -> str:
    """Return, or success in percent, after so many gradient steps."""
    rows = [row for row in run.evaluations if row["step"] <= n_steps][-N_LAST:]
    mean = np.mean([row_value(row) for row in rows])
    return f"{mean:.0f}%" if run.counts_success else f"{mean:,.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("quick", type=Path, help="CSV file of results, or folder of rows")
    parser.add_argument("slow", type=Path, help="CSV file of results, or folder of rows")
    parser.add_argument("--labels", nargs=2, default=("", ""), metavar=("QUICK", "SLOW"))
    arguments = parser.parse_args()
    quick, slow = (runs_of(*which) for which in zip((arguments.quick, arguments.slow), arguments.labels, strict=True))
    print("| task | data | algorithm | minutes | whole, seed by seed | cut short |\n| --- | --- | --- | --- | --- | --- |")
    for key in sorted(quick.keys() & slow.keys()):
        task, share, algo = key
        minutes = minutes_a_step(quick[key]) * quick[key][0].final["step"]
        n_steps = minutes / minutes_a_step(slow[key])
        whole, cut = (
            "; ".join(reached(run, limit) for run in runs) for runs, limit in ((quick[key], np.inf), (slow[key], n_steps))
        )
        print(f"| {task} | {share:.0%} | {algo.upper()} | {minutes:.1f} | {whole} | {cut} |")


if __name__ == "__main__":
    main()
