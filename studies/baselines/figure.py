"""
DT and DTFM by the defaults and the rows of `make baselines` as a picture: means, as shares of the best one on the same data.

    PYTHONPATH=studies python -m baselines.figure results/baselines.csv results/suite.csv docs/studies/baselines.png
"""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from baselines.table import Grouped, compared

# Ours in colours of their own, the others in grey shapes.
OURS = {"dt": ("DT", "D", "C1"), "dtfm": ("DTFM", "o", "C0")}
OTHERS = {
    "d3rlpy-dt": ("d3rlpy's DT", "s"),
    "bc": ("BC", "v"),
    "bc-best": ("BC of the best 10 %", "^"),
    "td3-bc": ("TD3+BC", "<"),
    "iql": ("IQL", ">"),
    "rebrac": ("ReBRAC", "x"),
    "bc-rnn-gmm": ("BC-RNN-GMM", "+"),
}


def plot(folder: Path, suite: Path, output: Path) -> None:
    """
    :param folder: of the other algorithms' rows
    :param suite: of the defaults' rows
    :param output: the PNG
    """
    grouped, datasets, _ = compared(folder, suite)
    figure = Figure(figsize=(9.0, 0.42 * len(datasets) + 1.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    styles = {name: (label, marker, "0.55", 5.0) for name, (label, marker) in OTHERS.items()}
    styles |= {name: (*style, 8.0) for name, style in OURS.items()}
    for algo, (label, marker, colour, size) in styles.items():
        shares = {row: _mean(grouped, name, algo) / _best(grouped, name, styles) for row, name in enumerate(datasets)}
        found = {row: max(share, 0.0) for row, share in shares.items() if not np.isnan(share)}
        shown: dict[str, Any] = {
            "color": colour,
            "label": label,
            "markersize": size,
            "fillstyle": "none",
            "markeredgewidth": 1.6,
        }
        axes.plot(list(found.values()), list(found), marker, **shown, clip_on=False)
    axes.set_yticks(range(len(datasets)), datasets)
    axes.invert_yaxis()
    axes.grid(axis="y", alpha=0.3)
    axes.set(xlim=(0.0, 1.0), xlabel="mean of three seeds, as a share of the best one's")
    axes.xaxis.set_major_formatter("{x:.0%}")
    figure.legend(loc="outside right center", frameon=False)
    figure.savefig(output, dpi=110)


def _mean(grouped: Grouped, name: str, algo: str) -> float:
    """Over seeds; NaN where there are none."""
    runs = grouped.get((name, algo), [])
    return float(np.mean([float(run.value("final") or 0.0) for run in runs])) if runs else np.nan


def _best(grouped: Grouped, name: str, algos: Iterable[str]) -> float:
    """The largest mean on a dataset."""
    return float(np.nanmax([_mean(grouped, name, algo) for algo in algos]))


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("folder", "suite", "output"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    plot(options.folder, options.suite, options.output)


if __name__ == "__main__":
    main()
