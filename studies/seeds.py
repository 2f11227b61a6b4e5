"""
The final evaluations of a study as a picture: a dot for each seed, their mean, and its 95 % interval (Student's t).

    python studies/seeds.py results/adroit.csv docs/studies/adroit.png --labels "" adroit
    python studies/seeds.py results/chunks.csv docs/studies/few.png --labels chunks --below demonstrations
"""

import argparse
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sb3_dtfm.benchmark.report.figures import STYLES
from sb3_dtfm.benchmark.report.runs import Run, read_studies
from sb3_dtfm.benchmark.report.statistics import student_t

Grouped = dict[tuple[str, str], list[Run]]  # by what stands below, and the algorithm


def read(folder: Path, labels: list[str]) -> Grouped:
    """The runs of some labels, by task or, where there is one task only, by the number of episodes learned from."""
    groups = [group for study in read_studies([folder]) for group in study.groups if group.label in labels]
    if not groups:
        raise SystemExit(f"{folder} holds no rows of the labels {labels}.")
    one_task = len({task for group in groups for task, _, _ in group.runs}) == 1
    grouped: Grouped = {}
    for group in groups:
        for (task, share, algo), runs in sorted(group.runs.items()):
            episodes = round(share * runs[0].final["data"]["n_episodes"])
            grouped.setdefault((f"{episodes}" if one_task else task.partition("-v")[0], algo), []).extend(runs)
    return grouped


def draw(grouped: Grouped, path: Path, below: str) -> None:
    """
    :param grouped: what to show
    :param path: of the PNG
    :param below: what stands below the axis
    """
    places = list(dict.fromkeys(place for place, _ in grouped))
    figure = Figure(figsize=(1.6 + 1.5 * len(places), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.add_subplot()
    for aside, algo, (color, marker) in zip((-0.13, 0.13), ("dt", "dtfm"), cycle(STYLES), strict=False):
        for x, place in enumerate(places):
            values = np.array([run.value("final") for run in grouped.get((place, algo), [])], float)
            at = x + aside
            axis.plot(np.full(len(values), at + 0.06), values, ".", color=color, alpha=0.6)
            if len(values) > 1:
                estimate, low, high = student_t(values)
                axis.plot([at, at], [low, high], color=color, linewidth=1.8)
                axis.plot(at, estimate, color=color, marker=marker, markersize=6)
        axis.plot([], [], color=color, marker=marker, label=algo.upper())
    runs = next(iter(grouped.values()))
    axis.set_xticks(range(len(places)), places)
    axis.set_xlabel(below)
    axis.set_ylabel("success, %" if runs[0].counts_success else "return")
    if runs[0].counts_success:
        axis.set_ylim(0, 102)
    axis.grid(axis="y", color="0.9")
    axis.legend(frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--labels", nargs="+", default=[""])
    parser.add_argument("--below", default="")
    arguments = parser.parse_args()
    draw(read(arguments.folder, arguments.labels), arguments.output, arguments.below)


if __name__ == "__main__":
    main()
