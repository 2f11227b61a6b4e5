"""The figure of a comparison: a row for each task, full and half data side by side."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_dtfm.benchmark.runs import ALGORITHMS, Group, learning_curve, steps_to_success
from sb3_dtfm.zoo.arguments import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette, which colour-blind readers can tell apart; markers differ too.
COLORS = {"dt": "#D55E00", "dtfm": "#0072B2"}
MARKERS = {"dt": "s", "dtfm": "o"}
BASELINE_COLORS = ("#009E73", "#CC79A7", "#E69F00")
AGENT_COLOR = "0.35"
PANEL = (4.15, 2.5)  # inches; two panels are as wide as a README


class Baseline(NamedTuple):
    """
    Evaluations of another SB3 run.

    :param task: what it was trained on, None where the figure has a single task
    :param name: for the legend
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

    :param text: FILE is the `evaluations.npz` of an SB3 run
    :raises UsageError: malformed
    :raises FileNotFoundError: no such file
    """
    label, separator, file = text.partition("=")
    task, colon, name = label.rpartition(":")
    if not (separator and name and file):
        raise UsageError(f"--baseline {text}: expected NAME=FILE or TASK:NAME=FILE.")
    if not Path(file).is_file():
        raise FileNotFoundError(f"--baseline {text}: {file} does not exist; expected an evaluations.npz of an SB3 run.")
    with np.load(file) as arrays:
        if not {"timesteps", "results"} <= set(arrays):
            raise UsageError(f"--baseline {text}: {file} holds {', '.join(arrays)}, expected timesteps and results.")
        successes = 100.0 * arrays["successes"].mean(axis=1) if "successes" in arrays else None
        return Baseline(task if colon else None, name, arrays["timesteps"], arrays["results"].mean(axis=1), successes)


def check_baselines(baselines: Sequence[Baseline], tasks: Sequence[str]) -> None:
    """
    :raises UsageError: a baseline whose task is not known
    """
    for baseline in baselines:
        if baseline.task is None and len(tasks) > 1:
            raise UsageError(f"--baseline {baseline.name}: of which task? Write TASK:{baseline.name}=FILE.")
        if baseline.task is not None and baseline.task not in tasks:
            raise UsageError(f"--baseline {baseline.task}:{baseline.name}: the results hold {', '.join(tasks)}.")


def plot_group(group: Group, output: Path, baselines: Sequence[Baseline] = (), agent_line: bool = True) -> Path:
    """
    Draw the learning curves of all cells of a group.

    :param group: the runs
    :param output: PNG file to write
    :param baselines: further curves
    :param agent_line: draw the mean return of the recorded episodes
    :return: `output`
    """
    regimes = group.regimes
    with _figure(len(group.tasks), len(regimes), output, "gradient steps") as axes:
        for task, row in zip(group.tasks, axes, strict=True):
            own = [baseline for baseline in baselines if baseline.task in (None, task)]
            for regime, axis in zip(regimes, row, strict=True):
                _draw_panel(axis, group, task, regime, own, agent_line)
                axis.set_title(f"{task}, {_share(regime)}", fontsize=11)
            row[0].set_ylabel(_unit(group, task))
            _limit(row, group, task, agent_line)
    return output


def plot_solved(group: Group, output: Path) -> Path | None:
    """
    Draw how soon the final episodes succeed: the share of them that has, by environment step.

    :param group: the runs
    :param output: PNG file to write
    :return: `output`, or None if no task counts successes
    """
    tasks, regimes = group.success_tasks, group.regimes
    if not tasks:
        return None
    with _figure(len(tasks), len(regimes), output, "environment steps") as axes:
        for task, row in zip(tasks, axes, strict=True):
            for regime, axis in zip(regimes, row, strict=True):
                for algo, name in ALGORITHMS.items():
                    if runs := group.of(task, regime, algo):
                        steps = steps_to_success(runs)
                        share = 100.0 * np.arange(1, len(steps) + 1) / len(steps)
                        solved = np.isfinite(steps)
                        longest = max(max(run.final["lengths"]) for run in runs)
                        x = np.concatenate(([0.0], steps[solved], [longest]))
                        y = np.concatenate(([0.0], share[solved], [100.0 * solved.mean()]))
                        axis.step(x, y, where="post", color=COLORS[algo], linewidth=1.8, label=name)
                axis.set_title(f"{task}, {_share(regime)}", fontsize=11)
                axis.set_xlim(left=0)
                axis.grid(color="0.9")
            row[0].set_ylabel("episodes solved (%)")
            row[0].set_ylim(-3, 103)
    return output


@contextlib.contextmanager
def _figure(n_rows: int, n_columns: int, output: Path, x_label: str) -> Iterator[np.ndarray]:
    """Panels (n_rows, n_columns) to draw in, with one legend; saved at the end."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True}):
        figure = Figure(figsize=(PANEL[0] * n_columns, PANEL[1] * n_rows + 0.5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(n_rows, n_columns, squeeze=False, sharey="row")
        yield axes
        for axis in axes[-1]:
            axis.set_xlabel(x_label)
        handles = {
            label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            handles.values(), handles.keys(), loc="outside upper center", ncols=min(4, len(handles)), frameon=False
        )
        output.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(output, dpi=150)


def _share(regime: float) -> str:
    return {1.0: "full data", 0.5: "half of the data"}.get(regime, f"{regime:.0%} of the data")


def _unit(group: Group, task: str) -> str:
    runs = group.of_task(task)
    if not runs:
        return ""
    return "success rate (%)" if runs[0].counts_success else "return"


def _agent_return(group: Group, task: str) -> float | None:
    """Mean return of the recorded episodes; nothing for tasks that are measured by success."""
    runs = group.of_task(task)
    if not runs or runs[0].counts_success:
        return None
    return runs[0].final["data"].get("mean_return")


def _draw_panel(
    axis: "Axes", group: Group, task: str, regime: float, baselines: Sequence[Baseline], agent_line: bool
) -> None:
    from matplotlib.ticker import EngFormatter, MaxNLocator

    last_step = 0
    for algo, name in ALGORITHMS.items():
        runs = group.of(task, regime, algo)
        if not runs:
            continue
        curve = learning_curve(runs)
        last_step = max(last_step, *(run.final["step"] for run in runs))
        axis.plot(curve.steps, curve.mean, color=COLORS[algo], marker=MARKERS[algo], markersize=4, linewidth=1.8, label=name)
        axis.fill_between(curve.steps, curve.low, curve.high, color=COLORS[algo], alpha=0.15, linewidth=0)
    missing = [name for algo, name in ALGORITHMS.items() if not group.of(task, regime, algo)]
    if missing:
        text = "not run" if len(missing) == len(ALGORITHMS) else f"{missing[0]}: not run"
        axis.text(0.5, 0.5, text, transform=axis.transAxes, ha="center", va="center", color="0.45")
    if last_step == 0:
        axis.set(xticks=[])
        return
    for baseline, color in zip(baselines, BASELINE_COLORS * len(baselines), strict=False):
        _draw_baseline(axis, baseline, last_step, color, _unit(group, task) != "return")
    agent_return = _agent_return(group, task)
    if agent_line and agent_return is not None:
        axis.axhline(agent_return, color=AGENT_COLOR, linestyle="--", linewidth=1.4, label="recorded episodes")
    axis.set_xlim(0, 1.03 * last_step)
    axis.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    if last_step >= 10_000:
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.grid(color="0.9")


def _draw_baseline(axis: "Axes", baseline: Baseline, last_step: int, color: str, by_success: bool) -> None:
    """Stretched over the panel: environment steps are no gradient steps, and the legend says how many they are."""
    values = baseline.successes if by_success else baseline.returns
    if values is None:
        raise UsageError(f"--baseline {baseline.name}: holds no successes, by which the task is measured.")
    label = f"{baseline.name} ({int(baseline.steps[-1]):,} environment steps)"
    axis.plot(
        baseline.steps / baseline.steps[-1] * last_step, values, color=color, linewidth=1.5, linestyle=":", label=label
    )


def _limit(row: Sequence["Axes"], group: Group, task: str, agent_line: bool) -> None:
    """Limits by the curves: the band of two runs may be far wider than all that was measured."""
    runs = group.of_task(task)
    if not runs:
        row[0].set(yticks=[])
        return
    if runs[0].counts_success:
        row[0].set_ylim(-3, 103)
        return
    values = [value for axis in row for line in axis.get_lines() for value in np.ravel(line.get_ydata())]
    values = [value for value in values if np.isfinite(value)]
    if values:
        margin = 0.12 * (max(values) - min(values)) or 1.0
        row[0].set_ylim(min(values) - margin, max(values) + margin)
