"""
Results of fine-tuning: runs of `sb3-dtfm finetune` as rows, and their curves.

    python studies/finetuning.py measure logs/dtfm/robosuite-Can-v0_2 --before logs/dtfm/robosuite-Can-v0_1 \\
        --like mine/robosuite-Can-v0_0.05_dtfm_seed0_small.jsonl --label own-episodes --output mine
    python studies/finetuning.py plot results/finetuning.csv --task HalfCheetah-v5 --labels noise-space sac sac-with-data \\
        --output docs/studies/finetuning.png
    python studies/finetuning.py rollouts results/rollouts.csv --output docs/studies/rollouts.png

`measure` plays 100 final episodes, as `sb3-dtfm benchmark` does, with the model before (rows of the label "before"), with
the last one after, and with the best of its evaluations (rows of the label with "-best"), and takes the curve from the run's
evaluations.npz. Its steps are the environments', its seconds those until then, evaluations included. `--like` is the run of
the model before: its rows tell task, data and seed. Final episodes are played in the environments of the run's evaluations.
`rollouts` shows models that learned from more or fewer rollouts, each label so many, by how many steps of the environment
these took, each task beside the others.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.benchmark.report.runs import Group, Run, read_studies, row_value
from sb3_dtfm.benchmark.report.statistics import student_t
from sb3_dtfm.benchmark.rows import Row, RunKey, read_rows, write_row
from sb3_dtfm.files import read_run
from sb3_dtfm.finetuning import FINETUNED
from sb3_dtfm.recording.loading import load_agent

N_EPISODES, N_ENVS = 100, 10
BEFORE = "before"


def measure(run: Path, before: Path, like: Row, label: str, output: Path) -> None:
    """
    Write rows of what a run began with, and of what it came to.

    :param run: folder of a run of `finetune`, `--algo dtfm` or of a fine-tuned model with n_action_steps=1
    :param before: folder of the run that it went on from
    :param like: a row of the model before
    :param label: of the rows
    :param output: folder for the files
    """
    (folder,) = (path.parent for path in run.glob("*/config.yml"))
    if (
        run.parent.name == FINETUNED
        and load_agent(FINETUNED, run / f"{folder.name}.zip", "cpu").policy.options.n_action_steps > 1
    ):
        raise SystemExit(f"{run}: its timesteps are decisions of several actions; rows have the environment's steps.")
    settings = {**like["settings"], **read_run(before / folder.name), **read_run(folder)}
    settings.pop("callback", None)
    envs = make_seeded_envs(like["task"], {**settings, "env_kwargs": settings["eval_env_kwargs"]}, N_ENVS)
    times = environment_steps(run)
    evaluations = curve(run)
    with np.load(run / "evaluations.npz") as saved:
        best_steps = int(saved["timesteps"][saved["results"].mean(axis=1).argmax()])  # the first of equal ones, as SB3 keeps
    for path, name, earlier, steps in (
        (before / f"{folder.name}.zip", BEFORE, [], 0),
        (run / f"{folder.name}.zip", label, evaluations, evaluations[-1]["step"]),
        (run / "best_model.zip", f"{label}-best", [], best_steps),
    ):
        row = {**like, "settings": settings, "label": name, "commit": provenance.commit(), "versions": provenance.versions()}
        rows = [*earlier, {"step": steps, "final": True, **final_episodes(path, envs)}]
        file = output / f"{RunKey.of(row).file_name}.jsonl"
        file.unlink(missing_ok=True)
        for each in rows:
            seconds = float(np.interp(each["step"], times[:, 1], times[:, 0]))
            speed = {"wall_s": round(seconds, 3), "steps_per_s": round(each["step"] / seconds if seconds else 0.0, 3)}
            write_row(file, {**row, **each, **speed, "hardware": provenance.hardware(th.device("cpu"))})


def environment_steps(run: Path) -> np.ndarray:
    """Return when the episodes of a run ended, (E + 1, 2): seconds since its start, and the steps of all of them by then."""
    ends = np.zeros((1, 2))
    for path in run.glob("*.monitor.csv"):
        columns = np.loadtxt(path, delimiter=",", skiprows=2, usecols=(2, 1), ndmin=2)
        if (np.diff(columns[:, 0]) < 0).any():
            raise SystemExit(f"{path}: the run was resumed, and its clock began anew; measure one that was not.")
        ends = np.concatenate([ends, columns])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    ends[:, 1] = np.cumsum(ends[:, 1])
    return ends


def curve(run: Path) -> list[dict[str, Any]]:
    """Its evaluations; where there are two after as many steps, the one after the last round's gradient steps."""
    with np.load(run / "evaluations.npz") as saved:
        columns = {name: saved[name].tolist() for name in saved.files}
    successes = columns.get("successes", [None] * len(columns["timesteps"]))
    rows = {
        step: {
            "step": step,
            "final": False,
            "returns": returns,
            "lengths": lengths,
            "successes": told if told is None else [bool(each) for each in told],
        }
        for step, returns, lengths, told in zip(
            columns["timesteps"], columns["results"], columns["ep_lengths"], successes, strict=True
        )
    }
    return list(rows.values())


def final_episodes(path: Path, envs: Any) -> dict[str, Any]:
    """
    Return what a model of a run reaches from the initial states of final evaluations.

    :param path: its file, in its run's folder, which lies in that of the algorithm
    :param envs: to act in
    """
    model = load_agent(path.parents[1].name, path, "cpu")
    seeds = range(FINAL_STATES, FINAL_STATES + N_EPISODES)
    with tqdm(total=N_EPISODES, desc=str(path)) as bar:
        return evaluate(model, envs, seeds, lambda n: bar.update(n - bar.n) and None)._asdict()


def plot(folder: Path, task: str, labels: list[str], output: Path) -> None:
    """
    Curves of the seeds, their mean with a 95 % interval (Student's t), and the means of the final episodes as dots.

    :param folder: of rows
    :param task: to show
    :param labels: of the rows to show
    :param output: the PNG
    """
    groups = {group.label: group for study in read_studies([folder]) for group in study.groups}
    figure, (axes,) = new_figure()
    for number, label in enumerate(labels):
        runs = runs_of(groups[label], task)
        steps = [row["step"] for row in runs[0].evaluations]
        values = np.array([[row_value(row) for row in run.evaluations] for run in runs])  # (runs, evaluations)
        color = f"C{number}"
        draw_curve(axes, steps, values, color)
        after = np.mean([row_value(run.final) for run in runs])
        axes.plot(steps[-1], after, "o", color=color, label=f"{label}: {after:,.0f} in the final episodes", clip_on=False)
    began = np.mean([row_value(run.final) for run in runs_of(groups[BEFORE], task)])
    axes.plot(0, began, "o", color="black", label=f"{BEFORE}: {began:,.0f}", clip_on=False)
    axes.set(xlabel="environment steps", ylabel="solved, %, or return")
    if runs[0].final["successes"] is not None:
        axes.set_ylim(top=100)
    axes.legend()
    figure.savefig(output, dpi=110)


def plot_rollouts(folder: Path) -> Figure:
    """
    Success in the final episodes by rollouts that were learned from: mean over seeds, 95 % interval (Student's t).

    :param folder: of rows, whose tasks are shown side by side
    """
    tasks = sorted({task for study in read_studies([folder]) for group in study.groups for task, _, _ in group.runs})
    figure, fields = new_figure(len(tasks))
    for axes, task in zip(fields, tasks, strict=True):
        draw_curve(axes, *by_rollout_steps(folder, task), "C0", marker="o")
        axes.set(title=task, xlabel="thousand environment steps of all rollouts")
        axes.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}")
    fields[0].set_ylim(top=100)
    fields[0].set_ylabel("solved, %")
    return figure


def by_rollout_steps(folder: Path, task: str) -> tuple[np.ndarray, np.ndarray]:
    """
    :param folder: of rows; each label has learned from so many rollouts beside the same demonstrations, one from none
    :param task: to look at
    :return: how many steps the rollouts of a seed have on average, (N,) from 0 on, and what each seed's final episodes came
        to, (seeds, N)
    """
    groups = [runs_of(group, task) for study in read_studies([folder]) for group in study.groups]
    found = sorted(filter(None, groups), key=mean_steps)
    if len({tuple(run.key.seed for run in runs) for runs in found}) != 1:
        raise SystemExit(f"{folder}: rows of {task} with the same seeds for each label are needed.")
    steps = np.array([mean_steps(runs) for runs in found])
    return steps - steps[0], np.array([[row_value(run.final) for run in runs] for runs in found]).T


def mean_steps(runs: list[Run]) -> float:
    """Return the mean number of steps that runs learned from."""
    return float(np.mean([run.final["data"]["n_steps"] for run in runs]))


def new_figure(n: int = 1) -> tuple[Figure, list[Axes]]:
    """Make a figure with `n` fields side by side."""
    figure = Figure(figsize=(2.9 + 3.6 * n, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, n, sharey=True, squeeze=False)[0])


def draw_curve(axes: Axes, steps: Any, values: np.ndarray, color: str, marker: str = "") -> None:
    """
    Runs, their mean and its 95 % interval.

    :param axes: to draw into
    :param steps: (N,) increasing
    :param values: (runs, N)
    :param color: of all
    :param marker: of the mean
    """
    mean, low, high = np.transpose([student_t(column) for column in values.T]).astype(float)
    axes.plot(steps, values.T, color=color, alpha=0.3, linewidth=0.8)
    axes.fill_between(steps, low, high, color=color, alpha=0.15, linewidth=0)
    axes.plot(steps, mean, marker=marker, color=color)


def runs_of(group: Group, task: str) -> list[Run]:
    """All seeds of a task."""
    return [run for (of_task, _, _), runs in group.runs.items() if of_task == task for run in runs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure").add_argument
    measuring("run", type=Path)
    measuring("--before", type=Path, required=True)
    measuring("--like", type=Path, required=True)
    measuring("--label", required=True)
    measuring("--output", type=Path, required=True)
    plotting = commands.add_parser("plot").add_argument
    plotting("folder", type=Path)
    plotting("--task", required=True)
    plotting("--labels", nargs="+", required=True)
    plotting("--output", type=Path, required=True)
    rolling = commands.add_parser("rollouts").add_argument
    rolling("folder", type=Path)
    rolling("--output", type=Path, required=True)
    options = parser.parse_args()
    if options.command == "plot":
        plot(options.folder, options.task, options.labels, options.output)
    elif options.command == "rollouts":
        plot_rollouts(options.folder).savefig(options.output, dpi=110)
    else:
        options.output.mkdir(parents=True, exist_ok=True)
        measure(options.run, options.before, read_rows(options.like)[-1], options.label, options.output)


if __name__ == "__main__":
    main()
