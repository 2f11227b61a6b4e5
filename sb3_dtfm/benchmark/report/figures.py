"""The figures of a comparison: a row for each task, shares of the data side by side, or one row for each data set."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_dtfm.benchmark.report.runs import (
    OVER_EPISODES,
    OVER_SEEDS,
    THRESHOLD_NAME,
    Group,
    full_name,
    learning_curve,
    score_interval,
    steps_to_success,
)
from sb3_dtfm.files import read_evaluations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers can tell apart; markers differ too.
STYLES = (("#D55E00", "s"), ("#0072B2", "o"), ("#56B4E9", "^"), ("#F0E442", "D"))
SCORE_STYLES = {"bc": ("#E69F00", "v"), "bc-best": ("#009E73", "^"), "dt": STYLES[0], "dtfm": STYLES[1]}
OTHER_STYLES = (("#CC79A7", "D"), ("#56B4E9", "P"), ("0.1", "X"))
BASELINE_COLORS = ("#009E73", "#CC79A7", "#E69F00")
AGENT_COLOR = "0.35"
PANEL = (4.15, 2.5)  # inches; two panels are as wide as a README
SCORE_ROW = 0.34  # inches
SCORES_SHOWN = (-0.25, 1.5)  # at most
# How a band is drawn; the legend shows it in grey.
BANDS: dict[str, dict[str, Any]] = {
    OVER_EPISODES: dict(alpha=0.15, linewidth=0),
    OVER_SEEDS: dict(alpha=0.3, linewidth=0, hatch="////"),
}
# Horizontal axes of a learning curve: the name of the axis, and the style of the line of the recorded episodes.
X_AXES: dict[str, tuple[str, dict[str, Any]]] = {
    "steps": ("gradient steps", dict(linewidth=1.4, label="recorded episodes")),
    "minutes": ("minutes of training", dict(linewidth=0.8, label=THRESHOLD_NAME)),
}


class Baseline(NamedTuple):
    """
    Evaluations of another SB3 run.

    :param task: task that it was trained on, None where the figure has a single task
    :param name: name in the legend
    :param steps: environment steps (E,)
    :param returns: mean return (E,)
    :param successes: success rate in percent (E,), None where it was not evaluated
    """

    task: str | None
    name: str
    steps: np.ndarray
    returns: np.ndarray
    successes: np.ndarray | None


def read_baseline(text: str) -> Baseline:
    """
    A baseline from `[TASK:]NAME=FILE`.

    :param text: text of this form; FILE is the `evaluations.npz` of an SB3 run
    :raises ValueError: malformed text
    :raises FileNotFoundError: no such file
    """
    label, separator, file = text.partition("=")
    task, colon, name = label.rpartition(":")
    if not (separator and name and file):
        raise ValueError(f"--baseline {text}: expected NAME=FILE or TASK:NAME=FILE.")
    if not Path(file).is_file():
        raise FileNotFoundError(f"--baseline {text}: {file} does not exist; expected an evaluations.npz of an SB3 run.")
    arrays = read_evaluations(Path(file))
    successes = 100.0 * arrays["successes"].mean(axis=1) if "successes" in arrays else None
    return Baseline(task if colon else None, name, arrays["timesteps"], arrays["results"].mean(axis=1), successes)


def check_baselines(baselines: Sequence[Baseline], tasks: Sequence[str]) -> None:
    """
    :raises ValueError: a baseline whose task is not known
    """
    for baseline in baselines:
        if baseline.task is None and len(tasks) > 1:
            raise ValueError(f"--baseline {baseline.name}: of which task? Write TASK:{baseline.name}=FILE.")
        if baseline.task is not None and baseline.task not in tasks:
            raise ValueError(f"--baseline {baseline.task}:{baseline.name}: the results hold {', '.join(tasks)}.")


def plot_group(
    group: Group, output: Path, x: str = "steps", baselines: Sequence[Baseline] = (), agent_line: bool = True
) -> Path:
    """
    Draw the learning curves of all runs of a group.

    :param group: the runs
    :param output: PNG file to write
    :param x: horizontal axis: gradient "steps", or "minutes" of training without evaluations
    :param baselines: further curves
    :param agent_line: whether to draw the mean return of the recorded episodes; by minutes the threshold, see
        :attr:`Run.threshold`
    :return: `output`
    """
    with _figure(group, group.tasks, output, X_AXES[x][0]) as axes:
        for task, row in zip(group.tasks, axes, strict=True):
            own = [baseline for baseline in baselines if baseline.task in (None, task)]
            for data_share, axis in zip(group.data_shares, row, strict=True):
                _draw_panel(axis, group, task, data_share, x, own, agent_line)
            runs = group.of_task(task)
            if runs and runs[0].counts_success:
                row[0].set(ylabel="success rate (%)", ylim=(-3, 103))
            elif runs:
                row[0].set(ylabel="return")
            else:
                row[0].set(yticks=[])
    return output


def plot_solved(group: Group, output: Path) -> Path | None:
    """
    Draw how soon the final episodes succeed: the share of them that has, by environment step.

    :param group: the runs
    :param output: PNG file to write
    :return: `output`, or None if no task counts successes
    """
    tasks = group.success_tasks
    if not tasks:
        return None
    with _figure(group, tasks, output, "environment steps") as axes:
        for task, row in zip(tasks, axes, strict=True):
            for data_share, axis in zip(group.data_shares, row, strict=True):
                for algo, (color, _) in zip(group.algorithms, cycle(STYLES), strict=False):
                    if runs := group.of(task, data_share, algo):
                        steps = steps_to_success(runs)
                        share = 100.0 * np.arange(1, len(steps) + 1) / len(steps)
                        solved = np.isfinite(steps)
                        longest = max(run.final["max_length"] for run in runs)
                        x = np.concatenate(([0.0], steps[solved], [longest]))
                        y = np.concatenate(([0.0], share[solved], [100.0 * solved.mean()]))
                        axis.step(x, y, where="post", color=color, linewidth=1.8, label=algo.upper())
                axis.set_xlim(left=0)
            row[0].set(ylabel="episodes solved (%)", ylim=(-3, 103))
    return output


def plot_scores(group: Group, output: Path) -> Path | None:
    """
    Draw the scores of the final evaluation: a row for each data set, a mark for each algorithm.

    :param group: the runs
    :param output: PNG file to write
    :return: `output`, or None if no data set has a scale
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    algos, data_sets = group.baselines_first, group.data_sets
    styles = {**dict(zip((algo for algo in algos if algo not in SCORE_STYLES), cycle(OTHER_STYLES))), **SCORE_STYLES}
    drawn = [
        (row, algo, interval)
        for row, (_, task, data_share) in enumerate(data_sets)
        for algo in algos
        if (runs := group.of(task, data_share, algo)) and (interval := score_interval(runs)) is not None
    ]
    if not drawn:
        return None
    means = [interval.estimate for *_, interval in drawn]
    low, high = max(SCORES_SHOWN[0], min(0.0, *means)), min(SCORES_SHOWN[1], max(1.0, *means))
    with mpl.rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.left": False, "axes.spines.right": False}):
        figure = Figure(figsize=(2 * PANEL[0], SCORE_ROW * len(data_sets) + 1.2), layout="constrained")
        FigureCanvasAgg(figure)
        axis = figure.subplots()
        for row in range(0, len(data_sets), 2):
            axis.axhspan(row - 0.5, row + 0.5, color="0.95", linewidth=0)
        axis.axvline(0.0, color="0.75", linewidth=0.8)
        for row, algo, interval in drawn:
            color, marker = styles[algo]
            y = row + 0.8 * ((algos.index(algo) + 0.5) / len(algos) - 0.5)
            axis.hlines(y, interval.low, interval.high, color=color, linewidth=1.4, alpha=0.5)
            x = np.clip(interval.estimate, low, high)
            style: dict[str, Any] = dict(
                color=color, marker=marker, markersize=6.5, markeredgecolor="white", markeredgewidth=0.5
            )
            axis.plot(x, y, linestyle="", clip_on=False, zorder=3, label=full_name(algo), **style)
        axis.axvline(1.0, color=AGENT_COLOR, linestyle="--", linewidth=1.2, label="best tenth of the recordings")
        axis.set(xlim=(low - 0.03, high + 0.03), xlabel="score", ylim=(len(data_sets) - 0.5, -0.5))
        axis.set_yticks(range(len(data_sets)), [name for name, *_ in data_sets])
        axis.tick_params(axis="y", length=0)
        _save(figure, [axis], output, ncols=min(len(algos) + 1, 5), columnspacing=1.3, handletextpad=0.4, handlelength=1.5)
    return output


@contextlib.contextmanager
def _figure(group: Group, tasks: Sequence[str], output: Path, x_label: str) -> Iterator[np.ndarray]:
    """Panels (task, share of the data) to draw in, with one legend; saved at the end."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True}):
        shape = len(tasks), len(group.data_shares)
        width = max(PANEL[0] * shape[1], 6.0)  # of the legend
        figure = Figure(figsize=(width, PANEL[1] * shape[0] + 0.5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(*shape, squeeze=False, sharey="row")
        for task, row in zip(tasks, axes, strict=True):
            for data_share, axis in zip(group.data_shares, row, strict=True):
                axis.set_title(f"{task}, {_share(data_share)}", fontsize=11)
                axis.grid(color="0.9")
        for axis in axes[-1]:
            axis.set_xlabel(x_label)
        yield axes
        _save(figure, axes.flat, output, ncols=3 if width > 6.0 else 2)


def _save(figure: "Figure", axes: Iterable["Axes"], output: Path, **legend: Any) -> None:
    """Save a figure with one legend of all that is drawn."""
    handles = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", frameon=False, **legend)
    figure.align_ylabels()
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=150)


def _share(data_share: float) -> str:
    return {1.0: "full data", 0.5: "half of the data"}.get(data_share, f"{data_share:.0%} of the data")


def _draw_panel(
    axis: "Axes", group: Group, task: str, data_share: float, x: str, baselines: Sequence[Baseline], agent_line: bool
) -> None:
    from matplotlib.ticker import EngFormatter, MaxNLocator

    drawn = {algo: runs for algo in group.algorithms if (runs := group.of(task, data_share, algo))}
    missing = [algo.upper() for algo in group.algorithms if algo not in drawn]
    if missing:
        text = f"{', '.join(missing)}: not run" if drawn else "not run"
        axis.text(0.5, 0.5, text, transform=axis.transAxes, ha="center", va="center", color="0.45")
    if not drawn:
        axis.set(xticks=[])
        return
    for algo, (color, marker) in zip(group.algorithms, cycle(STYLES), strict=False):
        if algo in drawn:
            curve = learning_curve(drawn[algo])
            at = getattr(curve, x)
            axis.plot(at, curve.mean, color=color, marker=marker, markersize=4, linewidth=1.8, label=algo.upper())
            axis.fill_between(at, curve.low, curve.high, color=color, **BANDS[curve.band])
            axis.fill_between([], [], color="0.4", **BANDS[curve.band], label=curve.band)
    first = next(iter(drawn.values()))[0]
    last = max(getattr(run, x) for runs in drawn.values() for run in runs)
    for baseline, color in zip(baselines, cycle(BASELINE_COLORS), strict=False):
        _draw_baseline(axis, baseline, last, color, first.counts_success)
    recorded = None if first.counts_success else first.final["data"].get("mean_return")
    level = first.threshold if x == "minutes" else recorded
    if agent_line and level is not None:
        axis.axhline(level, color=AGENT_COLOR, linestyle="--", **X_AXES[x][1])
    axis.set_xlim(-0.02 * last, 1.03 * last)
    axis.xaxis.set_major_locator(MaxNLocator(5, integer=True) if x == "steps" else MaxNLocator(5, steps=[1, 2, 5, 10]))
    if last >= 10_000:
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))


def _draw_baseline(axis: "Axes", baseline: Baseline, last_step: int, color: str, by_success: bool) -> None:
    """
    Stretch a baseline over the panel: environment steps are no gradient steps, and the legend says how many they are.

    :raises ValueError: a baseline without successes, where the task counts them
    """
    values = baseline.successes if by_success else baseline.returns
    if values is None:
        raise ValueError(f"--baseline {baseline.name}: holds no successes, by which the task is measured.")
    label = f"{baseline.name} ({int(baseline.steps[-1]):,} environment steps)"
    axis.plot(
        baseline.steps / baseline.steps[-1] * last_step, values, color=color, linewidth=1.5, linestyle=":", label=label
    )
