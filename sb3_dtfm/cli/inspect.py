"""`sb3-dtfm inspect`: what is in a dataset, as a table and a picture, and a command to begin with."""

import argparse
import contextlib
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace, same_actions
from sb3_dtfm.cli.literals import key_value
from sb3_dtfm.data import DatasetError, TrajectoryBuffer, check_action_space, load_dataset, load_dataset_for
from sb3_dtfm.data.decisions import decide, sentences
from sb3_dtfm.data.inspection import Inspection, Range, inspect_buffer
from sb3_dtfm.envs import (
    ReturnToGoWrapper,
    flatten_observation_space,
    image_spaces,
    register_gymnasium_robotics,
    without_images,
)
from sb3_dtfm.envs.packages import import_packages
from sb3_dtfm.files import printable

BLUE, RED, GREY = "#1b6ca8", "#c0562b", "0.6"
ROBOSUITE = "robosuite/"  # begins the ids of its tasks
# Options that choose among episodes by their results.
CHOOSING = {"min_return", "best_share", "success_only"}
# Discrete actions that are counted in the table, the most frequent ones.
N_CHOICES = 10
# Dimensions of the observations that have a row each.
N_DIMENSIONS = 24
# Episodes whose rewards are drawn.
N_DRAWN = 50


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm inspect`.

    :param argv: its arguments
    """
    options = _parser().parse_args(argv)
    import_packages(options.gym_packages)
    dataset = options.dataset[0] if len(options.dataset) == 1 else options.dataset
    buffer = load(dataset, dict(options.dataset_kwargs), options.env, dict(options.env_kwargs))
    found = inspect_buffer(buffer)
    for line in [*table(buffer, found), *dimensions(found.observations)]:
        print(printable(line))
    for remark in found.remarks:
        print(f"- {printable(remark)}")
    print("\nDecided from the data, unless you say otherwise:")
    for sentence in sentences(decide(buffer)):
        print(f"- {printable(sentence)}")
    print("\nTo load it in Python:")
    for line in loading(dataset, dict(options.dataset_kwargs), options.env, dict(options.env_kwargs)):
        print(f"  {printable(line)}")
    training = command(options.dataset, options.dataset_kwargs, options.gym_packages, buffer, found)
    print(f"\nTo begin with:\n  {printable(training)}")
    print(f"\nPicture: {draw(buffer, found, Path(options.output), ' + '.join(options.dataset))}")


def load(
    dataset: str | list[str],
    options: dict[str, Any],
    env_id: str | None = None,
    env_kwargs: Mapping[str, Any] = MappingProxyType({}),
) -> TrajectoryBuffer:
    """
    A dataset as its task would learn from it: up to the time limit, where the task is known here, and the best of that.

    :param dataset: Minari id, file, or several of them
    :param options: options of its reader
    :param env_id: Gymnasium id of the task; None leaves it to the dataset
    :param env_kwargs: arguments of `gymnasium.make` for this task
    :raises DatasetError: the dataset cannot be read, or is not of this task
    """
    register_gymnasium_robotics()
    if env_id is not None:
        return _load_for(env_id, env_kwargs, dataset, options)
    buffer = load_dataset(dataset, **{name: value for name, value in options.items() if name not in CHOOSING})
    spec = gym.registry.get(buffer.env_id or "")
    limit = None if spec is None else spec.max_episode_steps
    if limit is not None and buffer.episode_lengths.max() > limit:
        return load_dataset(dataset, **{"max_episode_steps": limit, **options})
    return load_dataset(dataset, **options) if CHOOSING & options.keys() else buffer


def _load_for(
    env_id: str, env_kwargs: Mapping[str, Any], dataset: str | list[str], options: dict[str, Any]
) -> TrajectoryBuffer:
    with contextlib.closing(gym.make(env_id, **env_kwargs)) as env:
        observed, action_space = env.observation_space, env.action_space
        buffer = load_dataset_for(ReturnToGoWrapper(env), dataset, **options)
    flat, cameras = flatten_observation_space(without_images(observed)), image_spaces(observed)
    if _images(cameras) != _images(buffer.image_spaces):
        held = f"images {_images(buffer.image_spaces)}"
        raise DatasetError(f"{buffer.source} holds {held}; those of {env_id} are {_images(cameras)}.")
    fits = same_actions(check_action_space(action_space, env_id), buffer.action_space)
    if flat.shape != buffer.observation_space.shape or not fits:
        held = f"{buffer.observation_space.shape} and actions of {buffer.action_space}"
        raise DatasetError(
            f"{buffer.source} holds observations of shape {held}; those of {env_id} are {flat.shape} and {action_space}."
        )
    buffer.env_id = env_id
    return buffer


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm inspect",
        description="Summarise a dataset, list possible faults and suggest a target return.",
    )
    argument = parser.add_argument
    argument("dataset", nargs="+", metavar="DATASET", help="Minari id, file or folder; or several")
    argument(
        "--dataset-kwargs",
        nargs="+",
        type=key_value,
        default=[],
        metavar="KEY:VALUE",
        help="arguments of load_dataset, e.g. best_share:0.1",
    )
    argument("--env", metavar="ID", help="Gymnasium id to check the dataset against; the dataset's by default")
    argument(
        "--env-kwargs",
        nargs="+",
        type=key_value,
        default=[],
        metavar="KEY:VALUE",
        help="arguments of gymnasium.make for --env",
    )
    argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first, which register tasks")
    argument("-o", "--output", default="dataset.png", metavar="FILE", help="PNG to write; dataset.png by default")
    return parser


def table(buffer: TrajectoryBuffer, found: Inspection) -> list[str]:
    """
    :param buffer: dataset
    :param found: inspection of it
    :return: lines of Markdown
    """
    returns, lengths, successes = buffer.episode_returns, buffer.episode_lengths, buffer.successes
    told = int((~np.isnan(successes)).sum())
    n_stopped = int((~buffer.terminated & ~buffer.truncated).sum())
    ends = f"{buffer.terminated.sum()} terminated, {buffer.truncated.sum()} truncated, {n_stopped} just stop"
    spread = f"{lengths.min():,} to {lengths.max():,}, {np.median(lengths):,.6g} in the median"
    tenths = ", ".join(f"{each:,.6g}" for each in np.quantile(returns, (0.0, 0.1, 0.5, 0.9, 1.0)))
    rows = {
        "task": buffer.env_id or "not said",
        "episodes": f"{buffer.n_episodes:,}: {ends}",
        "steps": f"{len(buffer):,}; an episode has {spread}",
        "successes": f"{np.nansum(successes):,.0f} of {told:,}" if told else "not said",
        "returns": f"{returns.mean():,.6g} on average; worst, 10 %, median, 90 %, best: {tenths}",
        "observations": _numbers(found.observations),
        "actions": _actions(buffer, found),
    }
    if buffer.image_spaces:
        rows["images"] = _images(buffer.image_spaces)
    return [f"| {buffer.source} | |", "| --- | --- |", *(f"| {name} | {what} |" for name, what in rows.items())]


def dimensions(found: Range) -> list[str]:
    """
    :param found: range of the observations
    :return: lines of Markdown, one for each of the first dimensions
    """
    rows = zip(found.low[:N_DIMENSIONS], found.high, found.mean, found.std, strict=False)
    lines = [
        f"| observation {number} | {low:.4g} to {high:.4g}, {mean:.4g} on average, standard deviation {std:.4g} |"
        for number, (low, high, mean, std) in enumerate(rows)
    ]
    n_more = len(found.low) - N_DIMENSIONS
    return [*lines, f"| {n_more} observations more | |"] if n_more > 0 else lines


def loading(
    dataset: str | list[str],
    options: Mapping[str, Any],
    env_id: str | None,
    env_kwargs: Mapping[str, Any] = MappingProxyType({}),
) -> list[str]:
    """
    :param dataset: dataset, as for :func:`load`
    :param options: options of its reader
    :param env_id: Gymnasium id of the task, None for no environment
    :param env_kwargs: arguments of `gymnasium.make` for this task
    :return: lines of Python, the last of which reads the dataset
    """
    lines, known = [], {}
    if env_id is not None:
        arguments = [repr(env_id), *(f"{name}={value!r}" for name, value in env_kwargs.items())]
        lines.append(f"env = gymnasium.make({', '.join(arguments)})")
        known = {
            "action_space": "env.action_space",
            "observation_space": "env.observation_space",
            "max_episode_steps": "env.spec.max_episode_steps",
            **({"env_args": "env.unwrapped.env_args"} if env_id.startswith(ROBOSUITE) else {}),
        }
    given = {**known, **{name: repr(value) for name, value in options.items()}}
    return [*lines, f"sb3_dtfm.data.load_dataset({', '.join([repr(dataset), *map('='.join, given.items())])})"]


def _images(cameras: Mapping[str, spaces.Box]) -> str:
    return ", ".join(f"{camera} {' x '.join(map(str, space.shape))}" for camera, space in cameras.items()) or "none"


def _actions(buffer: TrajectoryBuffer, found: Inspection) -> str:
    space = buffer.action_space
    if isinstance(space, spaces.Box):
        bounds = f"the space is {_interval(space.low, space.high)}, {found.at_bounds:.0%} at a bound"
        return f"{_numbers(found.actions)}; {bounds}"
    often = np.argsort(-found.actions.mean, kind="stable")[:N_CHOICES]
    counts = ", ".join(f"{space.start + i} in {found.actions.mean[i] * len(buffer):,.0f} steps" for i in often)
    return f"{space}: {counts}{' ...' if space.n > N_CHOICES else ''}"


def _numbers(found: Range) -> str:
    return f"{len(found.low)} numbers in {_interval(found.low, found.high)}"


def _interval(low: np.ndarray, high: np.ndarray) -> str:
    return f"[{low.min():.4g}, {high.max():.4g}]"


def command(
    datasets: Sequence[str],
    dataset_kwargs: Sequence[tuple[str, Any]],
    gym_packages: Sequence[str],
    buffer: TrajectoryBuffer,
    found: Inspection,
) -> str:
    """
    Command of a training on this dataset.

    :param datasets: datasets as the user gave them
    :param dataset_kwargs: options of their reader as the user gave them
    :param gym_packages: packages as the user gave them
    :param buffer: dataset
    :param found: inspection of it
    """
    algo = "dtfm" if isinstance(buffer.action_space, spaces.Box) else "dt"
    words = ["sb3-dtfm", "train", "--algo", algo, "--env", buffer.env_id or "TASK"]
    words += ["--dataset", *datasets, "--target-return", f"{found.target_return:g}"]
    words += ["--gym-packages", *gym_packages] if gym_packages else []
    if buffer.image_spaces and (buffer.env_id or "").startswith(ROBOSUITE):  # whose cameras are off by default
        shown = [camera.removesuffix("_image") for camera in buffer.image_spaces]
        size = next(iter(buffer.image_spaces.values())).shape[1]
        words += ["--env-kwargs", f"cameras:{shown}", f"camera_size:{size}"]
    if dataset_kwargs:
        inside = ", ".join(f"{key}={value!r}" for key, value in dataset_kwargs)
        words += ["-params", f"dataset_kwargs:dict({inside})"]
    return shlex.join(words)


def draw(buffer: TrajectoryBuffer, found: Inspection, output: Path, title: str) -> Path:
    """
    Draw returns, lengths, rewards over time, the actions' ranges, and what each camera saw in the first episode.

    :param buffer: dataset
    :param found: inspection of it
    :param output: PNG file to write
    :param title: heading
    :return: `output`
    """
    from matplotlib.figure import Figure

    n_cameras = len(buffer.image_spaces)
    figure = Figure(figsize=(9.0, 6.2 + 2.6 * n_cameras), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(6.2, 2.6 * n_cameras + 0.01))
    above, below = parts
    (returns, lengths), (over_time, actions) = above.subplots(2, 2)
    _draw_images(below, buffer)
    n_bins = min(50, max(10, buffer.n_episodes // 4))
    returns.hist(buffer.episode_returns, bins=n_bins, color=BLUE)
    returns.axvline(found.target_return, color=RED, linestyle="--")
    returns.set_title(f"target return: {found.target_return:,g}", color=RED, fontsize="medium")
    returns.set(xlabel="return of an episode", ylabel="episodes")
    lengths.hist(buffer.episode_lengths, bins=n_bins, color=BLUE)
    lengths.set(xlabel="steps of an episode", ylabel="episodes")
    order = np.argsort(buffer.episode_returns)
    chosen = order[np.linspace(0, len(order) - 1, min(N_DRAWN, len(order))).astype(int)]
    for episode in chosen:
        some = buffer.select(np.array([episode]))
        over_time.plot(some.returns_to_go.cpu().numpy(), color=BLUE, alpha=0.35, linewidth=1.0)
    over_time.set(xlabel="step", ylabel="return-to-go")
    _draw_actions(actions, buffer.action_space, found.actions)
    for axis in (returns, lengths, over_time, actions):
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=130)
    return output


def _draw_images(figure: Any, buffer: TrajectoryBuffer) -> None:
    """First, middle and last images of the first episode, a row for each camera."""
    start, length = int(buffer.episodes.starts[0]), int(buffer.episode_lengths[0])
    for row, camera in enumerate(buffer.image_spaces):
        for column, step in enumerate((0, length // 2, length - 1)):
            axis = figure.add_subplot(len(buffer.image_spaces), 3, 3 * row + column + 1)
            image = buffer.images(th.tensor([start + step]), (1,))[camera][0].cpu().numpy()
            axis.imshow(np.moveaxis(image, 0, 2), cmap="gray", vmin=0, vmax=255)
            axis.set_title(f"{camera}, step {step}", fontsize="medium")
            axis.axis("off")


def _draw_actions(axis: Any, space: ActionSpace, found: Range) -> None:
    """Draw the used range of each dimension, or how often each of the Discrete actions was chosen."""
    dimensions = np.arange(len(found.low))
    if isinstance(space, spaces.Discrete):
        axis.bar(space.start + dimensions, found.mean, color=BLUE)
        axis.set(xlabel="action", ylabel="share of steps", xticks=space.start + dimensions if len(dimensions) <= 24 else [])
        return
    axis.vlines(dimensions, space.low, space.high, color="0.9", linewidth=8.0, label="action space")
    axis.vlines(dimensions, found.low, found.high, color=GREY, linewidth=3.0, label="used")
    spread = (found.mean + sign * found.std for sign in (-1.0, 1.0))
    spread = (np.clip(each, found.low, found.high) for each in spread)
    axis.vlines(dimensions, *spread, color=BLUE, linewidth=5.0, label="usual")
    axis.set(xlabel="dimension of the action", ylabel="action", xticks=dimensions if len(dimensions) <= 24 else [])
    axis.legend(frameon=False, fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
