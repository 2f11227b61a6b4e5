"""What `sb3-dtfm train` and `enjoy` add to RL-Zoo's own arguments, written in terms of those."""

import argparse
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from rl_zoo3.utils import StoreDict

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.envs import register_gymnasium_robotics
from sb3_dtfm.finetuning import STEERED
from sb3_dtfm.zoo.registration import PACKAGED_CONFIGS, packaged_config

# In a run's settings.
WRAPPER = "sb3_dtfm.envs.ReturnToGoWrapper"
TRAIN_EXAMPLES = """\
  sb3-dtfm train --algo dtfm --env HalfCheetah-v5
  sb3-dtfm train --algo dt --env robosuite/Lift-v0 --dataset lift.hdf5 --dataset-fraction 0.5
"""


class UsageError(ValueError):
    """Arguments that do not go together; the message says which would."""


def asking_for(target_return: float | None, env_wrapper: Any) -> list[Any]:
    """
    :param target_return: that the environment is to ask for, None for none
    :param env_wrapper: RL-Zoo's setting: a wrapper's path, one with its arguments, or a list of these
    :return: the same wrappers, of which a ReturnToGoWrapper asks for it
    """
    named = _with_arguments(env_wrapper)
    own = [each for each in named if _is_return_to_go(each)] or [{WRAPPER: None}]
    asking = {path: {**(arguments or {}), "target_return": target_return} for path, arguments in own[0].items()}
    return [asking if each is own[0] else each for each in named] if own[0] in named else [*named, asking]


def asked_for(env_wrapper: Any) -> float | None:
    """
    :param env_wrapper: as in :func:`asking_for`, None for no wrapper
    :return: the target return of its ReturnToGoWrapper, None where there is none
    """
    arguments = [next(iter(each.values())) or {} for each in _with_arguments(env_wrapper or []) if _is_return_to_go(each)]
    return arguments[0].get("target_return") if arguments else None


def _with_arguments(env_wrapper: Any) -> list[dict[str, Any]]:
    """Each wrapper's path with its arguments, None for none."""
    wrappers = env_wrapper if isinstance(env_wrapper, list) else [env_wrapper]
    return [each if isinstance(each, dict) else {each: None} for each in wrappers]


def _is_return_to_go(wrapper: dict[str, Any]) -> bool:
    return next(iter(wrapper)).endswith(".ReturnToGoWrapper")


def key_values(option: str, texts: Sequence[str]) -> dict[str, Any]:
    """
    Keys with their values, which RL-Zoo evaluates as Python.

    :param option: for the message
    :param texts: `key:value` each
    :raises UsageError: one cannot be evaluated
    """
    values = {}
    for text in texts:
        parsed = argparse.Namespace()
        try:
            StoreDict([], "values")(argparse.ArgumentParser(), parsed, [text])
        except Exception as error:  # whatever the user's expression raises
            raise UsageError(f"{option} {text}: expected key:value with a value in Python ({error}).") from error
        values.update(parsed.values)
    return values


def import_packages(modules: Sequence[str], where: str = "--gym-packages") -> None:
    """
    Import what registers tasks, as RL-Zoo's `--gym-packages` does; gymnasium-robotics needs no mention.

    :param modules: dotted names
    :param where: they were named, for the message
    :raises UsageError: there is none of that name
    """
    register_gymnasium_robotics()
    for module in modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise UsageError(f"{where} {module}: {error}.") from error


def train_parser() -> argparse.ArgumentParser:
    """Arguments of `train` that RL-Zoo does not have, or that get a default or a meaning here."""
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm train",
        add_help=False,
        usage="sb3-dtfm train --algo dtfm --env ENV [options] [RL-Zoo options]",
        description="Train with RL-Zoo. One timestep of dt and dtfm is one gradient step on recorded episodes.",
        epilog=f"examples:\n{TRAIN_EXAMPLES}\nRL-Zoo's own options follow.\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    offline = parser.add_argument_group(f"of {' and '.join(ALGORITHMS)}").add_argument
    offline(
        "--dataset",
        nargs="+",
        help="Minari id, robomimic hdf5 file, or .npz or hdf5 file of flat arrays to learn from; or several",
    )
    offline("--dataset-fraction", type=float, help="randomly drawn share of the episodes, in (0, 1]")
    offline("--dataset-cache", metavar="DIR", help="learn from memory-mapped files made in this folder")
    offline("--target-return", type=float, help="return to ask for when acting, in reward units")
    offline(
        "-conf",
        "--conf-file",
        help="the packaged settings if not given, 'paper' for those of the method's paper; "
        "else a YAML file or a Python package, as in RL-Zoo",
    )
    offline(
        "--resume",
        metavar="RUN",
        help="go on with an interrupted run, as logs/dtfm/HalfCheetah-v5_1, with the arguments that it was started with",
    )
    shared = parser.add_argument_group("read on the way to RL-Zoo").add_argument
    shared("--algo", default="ppo", help=argparse.SUPPRESS)
    shared("--env", default="CartPole-v1", help=argparse.SUPPRESS)
    shared("-params", "--hyperparams", nargs="+", action="extend", default=[], help=argparse.SUPPRESS)
    return parser


def resumed_run(argv: Sequence[str]) -> tuple[Path | None, list[str]]:
    """
    The run that `--resume` names, None without, and the other arguments.

    :param argv: the user's arguments
    """
    parser = argparse.ArgumentParser(prog="sb3-dtfm train", add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    options, others = parser.parse_known_args(argv)
    return options.resume, others


def resumed_arguments(run: Path, started: list[str], others: Sequence[str]) -> list[str]:
    """
    Arguments for RL-Zoo's `train` of a run that goes on.

    :param run: its folder
    :param started: what it was started with
    :param others: the user's arguments beside `--resume`: none, or all of them once more
    :raises UsageError: others, of another algorithm or task
    """
    if not others:
        return started
    arguments = train_arguments(others)
    of_the_run, given = (train_parser().parse_known_args(each)[0] for each in (started, arguments))
    if (of_the_run.algo, of_the_run.env) != (given.algo, given.env):
        raise UsageError(
            f"--resume {run}: takes no other arguments; it was started with --algo {of_the_run.algo} --env {of_the_run.env}."
        )
    return arguments


def train_arguments(argv: Sequence[str]) -> list[str]:
    """
    Arguments for RL-Zoo's `train`.

    The shorthands become hyperparameters. They are merged with the user's own, since RL-Zoo keeps only the last `-params`.

    :param argv: the user's arguments
    :raises UsageError: a shorthand for an algorithm that knows no dataset, or one that is missing
    """
    options, rest = train_parser().parse_known_args(argv)
    if options.algo == STEERED:
        raise UsageError(f"--algo {STEERED}: such models come from `sb3-dtfm finetune`; `enjoy` plays them.")
    given = key_values("-params", options.hyperparams)
    conf_file = options.conf_file
    if options.algo in ALGORITHMS and conf_file in PACKAGED_CONFIGS:
        conf_file = str(packaged_config(options.algo, conf_file))
    shorthands = _shorthands(options, given, _wrappers(conf_file, options.env))
    if options.algo not in ALGORITHMS and shorthands:
        names = ", ".join(option for option, _ in shorthands)
        raise UsageError(f"{names}: for --algo {' and '.join(ALGORITHMS)} only, not for {options.algo}.")
    hyperparams = [*options.hyperparams, *(value for _, value in shorthands)]
    if options.algo in ALGORITHMS and options.conf_file in PACKAGED_CONFIGS:
        _check_task(conf_file, options.env, hyperparams)
    arguments = ["--algo", options.algo, "--env", options.env, *rest]
    if conf_file is not None:
        arguments += ["--conf-file", conf_file]
    if hyperparams:
        arguments += ["--hyperparams", *hyperparams]
    return arguments


def _check_task(conf_file: str, env_id: str, hyperparams: Sequence[str]) -> None:
    """
    Say what a task that the packaged settings do not list still needs.

    :raises UsageError: no dataset or no target return
    """
    if env_id in yaml.safe_load(Path(conf_file).read_text()):
        return
    given = {hyperparam.split(":")[0] for hyperparam in hyperparams}
    needed = {"dataset": "--dataset", "env_wrapper": "--target-return"}
    missing = [option for key, option in needed.items() if key not in given]
    if missing and env_id in gym.registry:
        raise UsageError(f"{', '.join(missing)}: needed for {env_id}, which {conf_file} does not list.")


def _wrappers(conf_file: str | None, env_id: str) -> Any:
    """What wraps a task, as a YAML file has it; nothing in a file of another kind, or where there is none to read."""
    if conf_file is None or not Path(conf_file).is_file() or Path(conf_file).suffix not in (".yml", ".yaml"):
        return []
    entries = yaml.safe_load(Path(conf_file).read_text()) or {}
    return (entries.get(env_id) or entries.get("default") or {}).get("env_wrapper") or []


def _shorthands(options: argparse.Namespace, given: dict[str, Any], wrappers: Any) -> list[tuple[str, str]]:
    """Pairs of an option that was given and its `key:value`, whose value RL-Zoo evaluates as Python."""
    wrapper = asking_for(options.target_return, given.get("env_wrapper") or wrappers)
    cached = {**(given.get("dataset_kwargs") or {}), "cache_dir": options.dataset_cache}
    dataset = options.dataset[0] if options.dataset and len(options.dataset) == 1 else options.dataset
    candidates = [
        ("--dataset", "dataset", dataset, dataset),
        ("--dataset-fraction", "dataset_fraction", options.dataset_fraction, options.dataset_fraction),
        ("--dataset-cache", "dataset_kwargs", options.dataset_cache, cached),
        ("--target-return", "env_wrapper", options.target_return, wrapper),
    ]
    return [(option, f"{key}:{value!r}") for option, key, wanted, value in candidates if wanted is not None]


def enjoy_arguments(argv: Sequence[str]) -> list[str]:
    """
    Arguments for RL-Zoo's `enjoy`: ours are looked for where `train` puts them, not among the Zoo's own agents.

    :param argv: the user's arguments
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("-f", "--folder")
    options, _ = parser.parse_known_args(argv)
    if options.algo in (*ALGORITHMS, STEERED) and options.folder is None:
        return [*argv, "--folder", "logs"]
    return list(argv)
