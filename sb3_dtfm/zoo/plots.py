"""RL-Zoo's plots, in which runs of dt and dtfm stand beside the others', as windows or files."""

import argparse
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

from matplotlib import pyplot as plt

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import UsageError, check_algorithm

ONE_RUN = (
    "plot_from_file draws nothing of which there is one run alone: train another one, or leave it out with --skip-keys."
)

UNEQUAL = "all_plots averages the evaluations of runs with equal numbers of episodes; these had different --eval-episodes."
NOTHING = "nothing to draw in the folders of these algorithms and tasks, or fewer episodes than plot_train's window, -w."


def draw(name: str, arguments: Sequence[str]) -> list[Path]:
    """
    Run one of RL-Zoo's plotting scripts. With `--figures FOLDER`, or without a screen, each figure becomes a PNG file.

    :param name: plot_train, all_plots or plot_from_file
    :param arguments: arguments of the script, and `--figures`
    :return: the files, none where windows were shown
    :raises UsageError: training episodes are asked for of an algorithm that is unknown or has none
    """
    folder, others = _folder(arguments)
    if name == "plot_train":
        _check_that_it_acts_while_it_learns(others)
    if folder is None and plt.get_backend().lower() == "agg":  # Matplotlib takes it where there is no screen
        folder = Path()
    if folder is not None:
        plt.switch_backend("agg")
    plt.close("all")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "FigureCanvasAgg is non-interactive")
        warnings.filterwarnings("ignore", "No artists with labels")  # said of an axis without curves
        try:
            commands.plot(name, others)
        except ValueError as error:
            if name == "plot_from_file" and str(error).startswith("min() "):
                raise UsageError(ONE_RUN) from error
            if "inhomogeneous" in str(error):
                raise UsageError(UNEQUAL) from error
            raise
    return [] if folder is None else _save(name, folder)


def _folder(arguments: Sequence[str]) -> tuple[Path | None, list[str]]:
    """Folder that `--figures` names, and the other arguments."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--figures", type=Path)
    options, others = parser.parse_known_args(arguments)
    return options.figures, others


def _check_that_it_acts_while_it_learns(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-a", "--algo")
    algo = parser.parse_known_args(arguments)[0].algo
    if algo is not None:
        check_algorithm(algo)
    if algo in ALGORITHMS:
        raise UsageError(
            f"--algo {algo}: it learns from recorded episodes, so there are no episodes of its training to draw; "
            "`sb3-dtfm plot RUN` and `sb3-dtfm plot all_plots` draw evaluations."
        )


def _save(name: str, folder: Path) -> list[Path]:
    """All figures that there are, each under its name."""
    figures = [plt.figure(number) for number in plt.get_fignums()]
    if not any(axis.has_data() for figure in figures for axis in figure.axes):
        raise UsageError(NOTHING)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for figure in figures:
        label = re.sub(r"[^\w-]+", "-", str(figure.get_label()))
        paths.append(folder / f"{name}-{label}.png")
        figure.savefig(paths[-1], dpi=150)
    plt.close("all")
    return paths
