"""`sb3-dtfm sweep`: the return that models reach against the return that they are asked for."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rl_zoo3.utils import get_saved_hyperparams
from stable_baselines3.common.base_class import BaseAlgorithm
from tqdm import tqdm

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.evaluation import evaluate, make_seeded_envs
from sb3_dtfm.benchmark.report.statistics import Interval, student_t
from sb3_dtfm.benchmark.settings import WRAPPER
from sb3_dtfm.data import load_dataset
from sb3_dtfm.zoo.arguments import UsageError, key_values

COLORS = ("#1b6ca8", "#c0562b", "#3f8f5f", "#7b5ea7")
# First seed of the initial states: apart from those of recordings and benchmarks.
FIRST_STATE = 4_000_000


class Asked(NamedTuple):
    """
    Episodes of a model that was asked for one return.

    :param target: in environment reward units
    :param returns: (n,) what the episodes reached
    """

    target: float
    returns: list[float]

    @property
    def interval(self) -> Interval:
        """Mean return with Student's t interval over the episodes."""
        return student_t(self.returns)


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm sweep`.

    :param argv: its arguments
    """
    options = _parser().parse_args(argv)
    models = [Path(model) for model in options.models]
    returns = load_dataset(options.dataset, **key_values("--dataset-kwargs", options.dataset_kwargs)).episode_returns
    targets = options.returns or np.linspace(returns.min(), returns.max(), options.points).round(2).tolist()
    swept = {}
    with tqdm(total=len(models) * len(targets) * options.episodes, unit="episode", disable=None) as progress:
        for path in models:
            swept[str(path)] = sweep(path, options, targets, progress)
    names = [f"{_algorithm_of(path).upper()}, {path.stem if path.is_file() else path.name}" for path in models]
    curves = dict(zip(names if len(set(names)) == len(names) else map(str, models), swept.values(), strict=True))
    print("\n".join(table(curves)))
    print(f"\nPicture: {draw(curves, returns, Path(options.output), options.env)}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm sweep",
        description="Ask models for one return after the other, and measure what they reach: a table and a picture.",
    )
    argument = parser.add_argument
    argument("models", nargs="+", metavar="MODEL", help="zip file of dt or dtfm, or folder of a run of `train`")
    argument("--env", required=True, metavar="TASK", help="Gymnasium id")
    argument("--dataset", required=True, metavar="DATASET", help="what was learned from: Minari id, robomimic or .npz file")
    argument("--dataset-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="options of its reader")
    argument("--algo", choices=ALGORITHMS, help="of all models; by the folder dt or dtfm that they are in by default")
    argument("--returns", nargs="+", type=float, metavar="R", help="to ask for; evenly over the dataset's by default")
    argument("--points", type=_at_least(2), default=9, metavar="N", help="how many then; 9 by default")
    argument("--episodes", type=_at_least(1), default=10, metavar="N", help="for each return; 10 by default")
    argument("--n-envs", type=_at_least(1), default=10, metavar="N", help="environments side by side; 10 by default")
    argument("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="as in train")
    argument("--seed", type=int, default=0, help="of the initial states, the same for each return and model")
    argument("-o", "--output", default="sweep.png", metavar="FILE", help="PNG to write; sweep.png by default")
    return parser


def _at_least(low: int) -> Any:
    def number(text: str) -> int:
        if not text.isdigit() or int(text) < low:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least {low}")
        return int(text)

    return number


def sweep(path: Path, options: argparse.Namespace, targets: Sequence[float], progress: tqdm) -> list[Asked]:
    """
    Play episodes from the same initial states for each return.

    :param path: zip file or run folder
    :param options: of the command
    :param targets: returns to ask for, environment reward units
    :param progress: counts episodes
    """
    file = path / f"{options.env.replace('/', '-')}.zip" if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"{file} does not exist; expected a model of dt or dtfm, or the folder of a run of `train`.")
    model: BaseAlgorithm = ALGORITHMS[options.algo or _algorithm_of(path)].load(file, device="cpu")
    settings = _settings(file, targets[0])
    if options.env_kwargs:
        settings["env_kwargs"] = key_values("--env-kwargs", options.env_kwargs)
    vec_env = make_seeded_envs(options.env, settings, min(options.n_envs, options.episodes))
    seeds = range(FIRST_STATE + options.seed, FIRST_STATE + options.seed + options.episodes)
    reached = []
    for target in targets:
        vec_env.env_method("set_target_return", target)
        before = progress.n
        episodes = evaluate(
            model, vec_env, seeds, lambda n_done, before=before: progress.update(before + n_done - progress.n)
        )
        reached.append(Asked(target, episodes.returns))
    vec_env.close()
    return reached


def _settings(file: Path, target: float) -> dict[str, Any]:
    """Of the run that a model lies in, or the return-to-go wrapper alone."""
    run = file.parent / file.stem
    if (run / "config.yml").is_file():
        return dict(get_saved_hyperparams(str(run))[0])
    return {"env_wrapper": [{WRAPPER: {"target_return": target}}]}


def _algorithm_of(path: Path) -> str:
    for part in path.parts:
        if part in ALGORITHMS:
            return part
    raise UsageError(f"{path}: of which algorithm? Expected a folder {' or '.join(ALGORITHMS)} in its path, or --algo.")


def table(curves: dict[str, list[Asked]]) -> list[str]:
    """
    :param curves: what each model reached, by its name
    :return: lines of Markdown: mean return and its 95 % interval
    """
    lines = [f"| asked | {' | '.join(curves)} |", f"| --- |{' --- |' * len(curves)}"]
    for row in zip(*curves.values(), strict=True):
        lines.append(f"| {row[0].target:,.6g} | {' | '.join(_interval(asked.interval) for asked in row)} |")
    return lines


def _interval(interval: Interval) -> str:
    limits = "" if np.isnan(interval.low) else f" [{interval.low:,.6g}, {interval.high:,.6g}]"
    return f"{interval.estimate:,.6g}{limits}"


def draw(curves: dict[str, list[Asked]], recorded: np.ndarray, output: Path, title: str) -> Path:
    """
    Draw what was reached against what was asked for, above the returns of the recorded episodes.

    :param curves: as for :func:`table`
    :param recorded: (E,) returns of the dataset's episodes
    :param output: PNG file to write
    :param title: heading
    :return: `output`
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.4), layout="constrained")
    axis, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    targets = np.array([asked.target for asked in next(iter(curves.values()))])
    axis.plot(targets, targets, color="0.6", linestyle="--", linewidth=1.2, label="what was asked for")
    for (name, reached), color in zip(curves.items(), COLORS * len(curves), strict=False):
        estimate, low, high = np.array([asked.interval for asked in reached]).T
        axis.plot(targets, estimate, color=color, marker="o", markersize=4, linewidth=1.8, label=name)
        axis.fill_between(targets, low, high, color=color, alpha=0.15, linewidth=0)
    axis.set(ylabel="return reached", title=title)
    axis.legend(frameon=False)
    axis.grid(color="0.9")
    below.hist(recorded, bins=min(50, max(10, len(recorded) // 4)), color="0.6")
    below.set(xlabel="return", ylabel="recorded\nepisodes")
    for each in (axis, below):
        each.spines[["top", "right"]].set_visible(False)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=150)
    return output
