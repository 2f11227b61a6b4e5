"""`sb3-dtfm plot`: a run's evaluations and training loss over gradient steps; or RL-Zoo's plots of many runs."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.report.statistics import wilson
from sb3_dtfm.files import read_evaluations
from sb3_dtfm.zoo.resuming import EPISODES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EPILOG = """\
RL-Zoo's own scripts, each with its arguments, `--help` among them:
  sb3-dtfm plot all_plots -a dtfm sac -e HalfCheetah-v5 -f logs -o results   evaluations of many runs: curves and a table
  sb3-dtfm plot plot_from_file -i results.pkl                                what all_plots has written with -o
  sb3-dtfm plot plot_train -a sac -e HalfCheetah-v5 -f logs                  training episodes, which dt and dtfm do not have
Their figures are windows; with --figures FOLDER, or without a screen, they are PNG files.
"""
# RL-Zoo's plotting scripts.
SCRIPTS = ("all_plots", "plot_from_file", "plot_train")
COLORS = {"evaluation": "#1b6ca8", "loss": "#c0562b"}


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm plot`.

    :param argv: its arguments
    """
    if argv and argv[0] in SCRIPTS:
        _run_script(argv[0], argv[1:])
        return
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm plot",
        description="Draw evaluation and training loss of one run of `sb3-dtfm train` into a PNG.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_folder", help="e.g. logs/dtfm/robosuite-Lift-v0_1, or one of RL-Zoo's scripts, see below")
    parser.add_argument("--tensorboard", metavar="FOLDER", help="folder of the run's TensorBoard events, for the loss")
    parser.add_argument("--output", metavar="FILE", help="learning_curve.png in the run folder by default")
    options = parser.parse_args(argv)
    output = options.output or Path(options.run_folder) / "learning_curve.png"
    print(f"Learning curve: {plot_learning_curve(options.run_folder, output, options.tensorboard)}")


def _run_script(name: str, arguments: Sequence[str]) -> None:
    from sb3_dtfm.zoo.plots import draw

    for path in draw(name, arguments):
        print(f"Figure: {path}")


def load_evaluations(run_folder: Path | str) -> dict[str, np.ndarray]:
    """
    The arrays of a run's `evaluations.npz`, of E evaluations of n episodes each.

    :return: `timesteps` (E,), `results` (E, n) in environment reward units, and where the task has them `successes` (E, n)
    :raises FileNotFoundError: the run was not evaluated while it trained
    :raises ValueError: a damaged file, or another one
    """
    path = Path(run_folder) / "evaluations.npz"
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected the folder of a run with evaluations (train --eval-freq).")
    return read_evaluations(path)


def load_loss(tensorboard_folder: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """
    The training loss in a TensorBoard log.

    :param tensorboard_folder: folder of the event files of one run
    :return: steps (N,) and values (N,), both empty if no loss was logged
    :raises FileNotFoundError: no event file in it
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    if not list(Path(tensorboard_folder).glob("*tfevents*")):
        raise FileNotFoundError(f"{tensorboard_folder} holds no TensorBoard events; expected the folder of one run's log.")
    accumulator = EventAccumulator(str(tensorboard_folder), size_guidance={"scalars": 0}).Reload()
    events = accumulator.Scalars("train/loss") if "train/loss" in accumulator.Tags()["scalars"] else []
    return np.array([event.step for event in events]), np.array([event.value for event in events])


def plot_learning_curve(
    run_folder: Path | str, output: Path | str, tensorboard_folder: Path | str | None = None, title: str | None = None
) -> Path:
    """
    Draw success (or return) and, next to it, the training loss over gradient steps.

    :param run_folder: folder of one run, as RL-Zoo makes it
    :param output: PNG file to write
    :param tensorboard_folder: folder of the run's TensorBoard events; without it there is no loss to draw
    :param title: heading, by default the run folder's name
    :return: `output`
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    evaluations = load_evaluations(run_folder)
    steps, loss = load_loss(tensorboard_folder) if tensorboard_folder else (np.array([]), np.array([]))
    with mpl.rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True}):
        n_panels = 2 if len(loss) else 1
        figure = Figure(figsize=(5.2 * n_panels, 3.9), layout="constrained")
        axes = figure.subplots(1, n_panels, squeeze=False)[0]
        _draw_evaluations(axes[0], evaluations)
        if len(loss):
            marker = "o" if len(loss) == 1 else ""  # one point makes no line
            axes[1].plot(steps, loss, color=COLORS["loss"], linewidth=1.8, marker=marker)
            axes[1].set(ylabel="train/loss", title="training", yscale="log")
            axes[1].grid(which="minor", color="0.95")
        for axis in axes:
            axis.set(xlabel=_counted(Path(run_folder)), xlim=(0, None))
            axis.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
            axis.grid(color="0.9")
        figure.suptitle(title or Path(run_folder).name)
        Path(output).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(output, dpi=150)
    return Path(output)


def _counted(run: Path) -> str:
    """Name what the time steps of a run count."""
    offline = run.resolve().parent.name in ALGORITHMS and not (run / EPISODES).exists()
    return "gradient steps" if offline else "timesteps"


def _draw_evaluations(axis: "Axes", evaluations: dict[str, np.ndarray]) -> None:
    """Mean over episodes, with a band that the legend explains."""
    steps, returns = evaluations["timesteps"], evaluations["results"]
    if "successes" in evaluations:
        intervals = 100 * np.array([wilson(int(row.sum()), len(row)) for row in evaluations["successes"]])
        means, low, high = intervals.T
        band = "95 % Wilson interval"
        axis.set(ylabel="success rate (%)", ylim=(0, 100))
    else:
        means, deviations = returns.mean(axis=1), returns.std(axis=1)
        low, high = means - deviations, means + deviations
        band = "± standard deviation"
        axis.set(ylabel="return")
    n_episodes = returns.shape[1]
    color = COLORS["evaluation"]
    # Not clipped, since the first marker lies on the axis, and so does one of 0 % or 100 %.
    axis.plot(steps, means, color=color, marker="o", linewidth=1.8, clip_on=False, label=f"mean of {n_episodes} episodes")
    axis.fill_between(steps, low, high, color=color, alpha=0.15, linewidth=0, label=band)
    axis.legend(frameon=False)
    axis.set_title("evaluation")
