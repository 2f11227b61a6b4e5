"""`sb3-dtfm sweep`: the return that models reach against their target return."""

import argparse
import contextlib
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from tqdm import tqdm

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.evaluation import SeededEpisodes, evaluate
from sb3_dtfm.benchmark.provenance import commit, versions
from sb3_dtfm.benchmark.report.statistics import Interval, student_t
from sb3_dtfm.data import load_dataset_for
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.files import replacing
from sb3_dtfm.recording.loading import AgentFiles, algorithm_of, find_agent, load_agent
from sb3_dtfm.zoo.arguments import UsageError, at_least, import_packages, key_values

COLORS = ("#1b6ca8", "#c0562b", "#3f8f5f", "#7b5ea7")
# First seed of the initial states, apart from those of recordings and benchmarks.
FIRST_STATE = 4_000_000
# Distance between the first initial states of two seeds.
SEED_STRIDE = 10_000
# Largest p-value at which means differ, shuffles of the test, and fewest episodes for each return that can show it.
SIGNIFICANT, N_SHUFFLES, FEWEST_EPISODES = 0.05, 1_999, 6


class Reached(NamedTuple):
    """
    Episodes of a model with one target return.

    :param target: target return in environment reward units
    :param returns: returns (n,) of the episodes, environment reward units
    :param successes: whether each episode (n,) solved the task; None where the task does not tell
    """

    target: float
    returns: list[float]
    successes: list[bool] | None = None

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
    import_packages(options.gym_packages)
    algorithms = [options.algo or algorithm_of(model) for model in options.models]
    agents = [find_agent(model, options.env) for model in options.models]
    known, dataset_kwargs = (
        max(agents, key=lambda agent: agent.of_run),
        key_values("--dataset-kwargs", options.dataset_kwargs),
    )
    with contextlib.closing(_wrapper(known)(gym.make(options.env, **_env_kwargs(known, options)))) as env:
        returns = load_dataset_for(env, options.dataset, **dataset_kwargs).episode_returns
    models = [load_agent(algo, agent.model, "cpu") for algo, agent in zip(algorithms, agents, strict=True)]
    acting = key_values("--acting", options.acting)
    for model in models:
        set_acting(model, acting)
    targets = options.returns or evenly(returns, options.points)
    reached = []
    with tqdm(total=len(models) * len(targets) * options.episodes, unit="episode", disable=None) as progress:
        for model, agent in zip(models, agents, strict=True):
            reached.append(sweep(model, agent, options, targets, progress))
    names = [f"{algo.upper()}, {Path(model).stem}" for algo, model in zip(algorithms, options.models, strict=True)]
    if len(set(names)) < len(names):
        names = [f"{i}: {name}" for i, name in enumerate(distinguished(options.models), 1)]
    curves = dict(zip(names, reached, strict=True))
    print("\n".join(table(curves)))
    if len(targets) > 1:
        print("\n".join(f"- {name}: {finding(reached)}" for name, reached in curves.items()))
    picture = draw(curves, returns, Path(options.output), options.env)
    numbers = picture.with_suffix(".json")
    origin = {"task": options.env, "dataset": options.dataset, "acting": acting, "first_state": first_state(options)}
    numbers_of = {name: [each._asdict() for each in reached] for name, reached in curves.items()}
    with replacing(numbers) as beside:
        beside.write_text(
            json.dumps({**origin, "commit": commit(), "versions": versions(), "models": numbers_of}, indent=1) + "\n"
        )
    print(f"\nPicture: {picture}\nReturns of all episodes: {numbers}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm sweep",
        description="Evaluate models with one target return after the other: a table and a picture.",
    )
    argument = parser.add_argument
    argument("models", nargs="+", metavar="MODEL", help="zip file of dt or dtfm, or folder of a run of `train`")
    argument("--env", required=True, metavar="TASK", help="Gymnasium id")
    argument(
        "--dataset", required=True, metavar="DATASET", help="data that the models learned from: Minari id, file or folder"
    )
    argument("--dataset-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="options of its reader")
    argument("--algo", choices=ALGORITHMS, help="algorithm of all models; by default the folder dt or dtfm that they are in")
    argument(
        "--returns", nargs="+", type=float, metavar="R", help="target returns; evenly over the dataset's returns by default"
    )
    argument(
        "--points", type=at_least(2), default=9, metavar="N", help="number of target returns without --returns; 9 by default"
    )
    argument("--episodes", type=at_least(1), default=10, metavar="N", help="episodes for each target return; 10 by default")
    argument("--n-envs", type=at_least(1), default=10, metavar="N", help="environments side by side; 10 by default")
    argument(
        "--acting",
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="way of acting, for example flow_steps:10; as saved by default",
    )
    argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first, which register tasks")
    argument("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="arguments of the environment, as in train")
    argument("--seed", type=int, default=0, help="seed of the initial states, which all returns and models share")
    argument(
        "-o",
        "--output",
        default="sweep.png",
        metavar="FILE",
        help="PNG to write; sweep.png by default, and beside it sweep.json",
    )
    return parser


def set_acting(model: BaseAlgorithm, choices: dict[str, Any]) -> None:
    """
    :param model: DT or DTFM
    :param choices: arguments of :meth:`SequencePolicy.set_acting`, for all models
    :raises UsageError: a setting that the model does not have, or a value out of range
    """
    try:
        model.policy.set_acting(**choices)  # type: ignore[operator]
    except ValueError as error:
        raise UsageError(f"--acting: {error}") from error


def evenly(returns: np.ndarray, n: int) -> list[float]:
    """
    :param returns: returns (E,) of the recorded episodes
    :param n: number of target returns
    :return: target returns from the smallest to the largest, four digits each; fewer where they do not differ by as much
    """
    return np.unique([float(f"{each:.4g}") for each in np.linspace(returns.min(), returns.max(), n)]).tolist()


def _env_kwargs(agent: AgentFiles, options: argparse.Namespace) -> dict[str, Any]:
    """Arguments of the environment that an agent was trained in, with the command's changes."""
    return {**agent.env_kwargs, **key_values("--env-kwargs", options.env_kwargs)}


def _wrapper(agent: AgentFiles) -> Callable[[gym.Env], gym.Env]:
    """Wrapper of an agent's environment; its target return is set later."""
    return agent.wrapper or ReturnToGoWrapper


def sweep(
    model: BaseAlgorithm, agent: AgentFiles, options: argparse.Namespace, targets: Sequence[float], progress: tqdm
) -> list[Reached]:
    """
    Play episodes from the same initial states for each return.

    :param model: model that acts
    :param agent: the model's files, which say what its environment was in training
    :param options: arguments of the command
    :param targets: target returns, environment reward units
    :param progress: progress bar that counts episodes
    """
    vec_env = make_vec_env(
        options.env,
        min(options.n_envs, options.episodes),
        wrapper_class=lambda env: SeededEpisodes(_wrapper(agent)(env)),
        env_kwargs=_env_kwargs(agent, options),
    )
    model.check_controller(vec_env)  # type: ignore[attr-defined]
    first = first_state(options)
    reached = []
    for target in targets:
        vec_env.env_method("set_target_return", target)

        def count(n_done: int, before: int = progress.n) -> None:
            progress.update(before + n_done - progress.n)

        episodes = evaluate(model, vec_env, range(first, first + options.episodes), count)
        reached.append(Reached(target, episodes.returns, episodes.successes))
    vec_env.close()
    return reached


def distinguished(paths: Sequence[str]) -> list[str]:
    """Paths without the folders in which all of them lie and the parts by which all of them end; one part at least."""
    parts = [Path(path).parts for path in paths]
    shortest = min(map(len, parts))
    n_first = min(_n_alike(parts), shortest - 1)
    n_last = min(_n_alike([each[::-1] for each in parts]), shortest - n_first - 1)
    return [str(Path(*each[n_first : len(each) - n_last])) for each in parts]


def _n_alike(sequences: Sequence[Sequence[str]]) -> int:
    """Return how many elements all sequences begin with."""
    return sum(1 for _ in itertools.takewhile(lambda place: len(set(place)) == 1, zip(*sequences, strict=False)))


def first_state(options: argparse.Namespace) -> int:
    """Seed of the first of the episodes' initial states, which follow each other."""
    return FIRST_STATE + SEED_STRIDE * options.seed


def table(curves: dict[str, list[Reached]]) -> list[str]:
    """
    :param curves: episodes of each model for each target return, by the model's name
    :return: lines of Markdown: mean return and its 95 % interval, and how many episodes solved the task if it reports that
    """
    lines = [f"| target return | {' | '.join(curves)} |", f"| --- |{' --- |' * len(curves)}"]
    for row in zip(*curves.values(), strict=True):
        lines.append(f"| {row[0].target:,.6g} | {' | '.join(map(_summary, row))} |")
    return lines


def _summary(reached: Reached) -> str:
    estimate, low, high = reached.interval
    limits = "" if np.isnan(low) else f" [{low:,.6g}, {high:,.6g}]"
    solved = "" if reached.successes is None else f", {sum(reached.successes)} of {len(reached.successes)} solved"
    return f"{estimate:,.6g}{limits}{solved}"


def finding(reached: Sequence[Reached]) -> str:
    """
    Say whether the target return has an effect, and which is the best one.

    :param reached: episodes for each of two or more target returns, the same number for each
    :return: sentence
    """
    returns = np.array([each.returns for each in reached])
    n_episodes, means = returns.shape[1], returns.mean(axis=1)
    if chance(returns) < SIGNIFICANT:
        best = max(reached, key=lambda each: (sum(each.successes or []), np.mean(each.returns)))
        solved = "" if best.successes is None else f" and solved {sum(best.successes)} of {n_episodes}"
        return f"The best target return is {best.target:g}: it returned {np.mean(best.returns):,.6g} on average{solved}."
    span = f"{reached[0].target:,.6g} to {reached[-1].target:,.6g}"
    if n_episodes < FEWEST_EPISODES or np.ptp(means) > np.sqrt(returns.var(axis=1, ddof=1).mean()):
        more = max(4 * n_episodes, 20)
        return f"It takes more episodes to tell whether a target return of {span} changes the return: --episodes {more}."
    unchanged = f"A target return of {span} changes the return by less than its spread between episodes"
    return f"{unchanged}: this model copies the data whatever its target return."


def chance(returns: np.ndarray) -> float:
    """
    A permutation test of the means against the spread between episodes, be it by their initial states or not.

    :param returns: returns (R, E) of E episodes for each of R target returns
    :return: share of the ways to shuffle all returns by which the R means differ at least as much, in (0, 1]
    """
    rng = np.random.default_rng(0)
    shuffled = rng.permuted(np.tile(returns.ravel(), (N_SHUFFLES, 1)), axis=1).reshape(N_SHUFFLES, *returns.shape)
    as_much = shuffled.mean(axis=2).var(axis=1) >= (1.0 - 1e-9) * returns.mean(axis=1).var()
    return (1 + np.count_nonzero(as_much)) / (1 + N_SHUFFLES)


def draw(curves: dict[str, list[Reached]], recorded: np.ndarray, output: Path, title: str) -> Path:
    """
    Draw reached returns over target returns, above the returns of the recorded episodes.

    :param curves: episodes of each model, as for :func:`table`
    :param recorded: (E,) returns of the dataset's episodes
    :param output: PNG file to write
    :param title: heading
    :return: `output`
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.4), layout="constrained")
    axis, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    targets = np.array([each.target for each in next(iter(curves.values()))])
    axis.plot(targets, targets, color="0.6", linestyle="--", linewidth=1.2, label="target return")
    for (name, reached), color in zip(curves.items(), COLORS * len(curves), strict=False):
        estimate, low, high = np.array([each.interval for each in reached]).T
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
