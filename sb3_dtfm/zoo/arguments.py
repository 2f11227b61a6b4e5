"""Arguments of `sb3-dtfm train` and `enjoy` beside RL-Zoo's own, written in terms of those."""

import argparse
import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
import yaml
from rl_zoo3.utils import ALGOS, StoreDict

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.arguments import with_nearest
from sb3_dtfm.envs.packages import import_packages
from sb3_dtfm.envs.return_to_go import check_target_return
from sb3_dtfm.files import CLASSES, EVALUATED, check_settings, literal
from sb3_dtfm.finetuning import FINETUNED
from sb3_dtfm.zoo.registration import PACKAGED_CONFIGS, is_packaged, online_config, packaged_config

# Name of the wrapper in a run's settings.
WRAPPER = "sb3_dtfm.envs.ReturnToGoWrapper"
TRAIN_EXAMPLES = """\
  sb3-dtfm train --algo dtfm --env HalfCheetah-v5
  sb3-dtfm train --algo dt --env robosuite/Lift-v0 --dataset lift.hdf5 --dataset-fraction 0.5
"""


# File in a run's folder that says how it was started.
START = "start.json"
# RL-Zoo's task where none is named.
RL_ZOO_ENV = "CartPole-v1"


class UsageError(ValueError):
    """Arguments that do not go together; the message says which would."""


def with_target_return(target_return: float | None, env_wrapper: Any) -> list[dict[Any, dict[str, Any]]]:
    """
    Wrappers of an environment with its target return.

    :param target_return: target return, environment reward units; None removes that of the settings
    :param env_wrapper: RL-Zoo's setting: a wrapper, its path, one of these with its arguments, a list of these, or None
    :return: the same wrappers with their arguments; a ReturnToGoWrapper follows where there was none
    :raises UsageError: no finite return, or no wrapper
    """
    try:
        target = {} if target_return is None else {"target_return": check_target_return(target_return)}
    except ValueError as error:
        raise UsageError(f"--target-return: {error} `sb3-dtfm inspect DATASET` suggests one.") from error
    wrappers = _with_arguments(env_wrapper)
    if not any(_shows_return_to_go(wrapper) for wrapper, _ in wrappers):
        wrappers.append((WRAPPER, {}))
    with_target = []
    for wrapper, arguments in wrappers:
        if _shows_return_to_go(wrapper):
            arguments = {key: value for key, value in arguments.items() if key != "target_return"} | target
        with_target.append({wrapper: arguments})
    return with_target


def find_target_return(env_wrapper: Any) -> float | None:
    """
    :param env_wrapper: RL-Zoo's setting, as for :func:`with_target_return`
    :return: the target return of its ReturnToGoWrapper, None where there is none
    """
    own = (arguments for wrapper, arguments in _with_arguments(env_wrapper) if _shows_return_to_go(wrapper))
    return next(own, {}).get("target_return")


def _with_arguments(env_wrapper: Any) -> list[tuple[Any, dict[str, Any]]]:
    """Each wrapper, or its path, with its arguments."""
    given = env_wrapper if isinstance(env_wrapper, list) else [env_wrapper] if env_wrapper else []
    pairs = [next(iter(each.items()), (None, None)) if isinstance(each, dict) else (each, None) for each in given]
    if not all(isinstance(wrapper, str | type) and isinstance(kwargs, dict | None) for wrapper, kwargs in pairs):
        raise UsageError(
            f"env_wrapper: {env_wrapper!r}; expected a dotted name in quotes, {{name: {{argument: value}}}}, or a list."
        )
    return [(wrapper, arguments or {}) for wrapper, arguments in pairs]


def _shows_return_to_go(wrapper: str | type) -> bool:
    name = wrapper if isinstance(wrapper, str) else wrapper.__qualname__
    return name.rpartition(".")[2] == WRAPPER.rpartition(".")[2]


def zoo_value(text: str) -> Any:
    """A value of the command line, which RL-Zoo evaluates as Python."""
    parsed = argparse.Namespace()
    StoreDict([], "values")(argparse.ArgumentParser(), parsed, [f"value:{text}"])
    return parsed.values["value"]


def key_values(option: str, texts: Sequence[str], evaluate: Callable[[str], Any] = zoo_value) -> dict[str, Any]:
    """
    Keys with their values.

    :param option: option that the message names
    :param texts: texts `key:value`
    :param evaluate: function from a text to its value; by default it is evaluated as Python, as RL-Zoo does
    :raises UsageError: a value that cannot be evaluated
    """
    values = {}
    for text in texts:
        key, _, value = text.partition(":")
        try:
            if not key.isidentifier():
                raise ValueError("there is no name before the colon")
            values[key] = evaluate(value)
        except Exception as error:  # whatever the user's expression raises
            mend = (
                f"; text needs quotes of its own: \"{key}:'{value}'\"" if isinstance(error, NameError | SyntaxError) else ""
            )
            raise UsageError(f"{option} {text}: expected key:value with a value in Python ({error}){mend}.") from error
    return values


class StoreValues(argparse.Action):
    """RL-Zoo's `StoreDict`, with a user's mistake in one line."""

    def __call__(self, _: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        setattr(namespace, self.dest, key_values(str(option), values))


class StoreLiterals(argparse.Action):
    """Keys and values that others may have written: nothing is evaluated, and classes are known ones."""

    def __call__(self, _: Any, namespace: argparse.Namespace, values: Any, option: str | None = None) -> None:
        given, where = key_values(f"{START}: {option}", values, literal), f"{START}: {option}"
        if self.dest == "hyperparams":
            setattr(namespace, self.dest, check_settings(given, where, [*CLASSES, *EVALUATED]))
        else:
            setattr(namespace, self.dest, check_settings({self.dest: given}, where, [])[self.dest])


class Restored(NamedTuple):
    """
    Arguments beside `--resume RUN`, where all other arguments come from the run's folder.

    :param run: folder of the run
    :param packages: packages of `--gym-packages`
    :param conf_file: file of `--conf-file`, None for none
    """

    run: Path
    packages: list[str]
    conf_file: str | None

    def check_package(self, name: str) -> None:
        """
        :param name: name of a module, which the run's folder gives
        :raises UsageError: the user does not name it
        """
        if name not in self.packages:
            raise UsageError(
                f"--resume {self.run}: {START} names the package {name}, which is imported only if you name it, too: "
                f"--resume {self.run} --gym-packages {name}."
            )

    def check_upload(self, arguments: Sequence[str]) -> None:
        """
        :param arguments: arguments that the run's folder gives
        :raises UsageError: they would upload the run
        """
        if any(each.startswith("--trac") for each in arguments):  # argparse takes abbreviations
            raise UsageError(
                f"--resume {self.run}: {START} says --track, which uploads the run; repeat the command's other arguments "
                "beside --resume to upload it."
            )

    def check_config(self, path: str, settings: dict[str, Any] | None = None) -> dict[str, Any]:
        """
        :param path: path of settings, which the run's folder gives
        :param settings: content of that file, None before it is read
        :return: these settings with literals, if they did not come with this package and the user does not name them
        :raises UsageError: such settings would run code
        """
        if path == self.conf_file or is_packaged(path):
            return settings or {}
        try:
            if settings is None and not path.endswith((".yml", ".yaml")):
                raise ValueError(f"{START} names the settings {path}, which are Python.")
            return check_settings(settings or {}, path, [*CLASSES, *EVALUATED])
        except ValueError as error:
            trust = f"If you trust it: --resume {self.run} --conf-file {path}"
            raise UsageError(f"--resume {self.run}: {error} {trust}.") from error


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
        help="Minari id, file or folder to learn from; or several",
    )
    offline("--dataset-fraction", type=float, help="randomly drawn share of the episodes, in (0, 1]")
    offline("--dataset-cache", metavar="DIR", help="learn from memory-mapped files made in this folder")
    offline(
        "--target-return",
        type=float,
        help="in reward units; by default the settings' or, without one, the data decide",
    )
    offline(
        "-conf",
        "--conf-file",
        help="the packaged settings if not given, 'paper' for those of the method's paper; "
        "else a YAML file or a Python package, as in RL-Zoo",
    )
    offline(
        "--resume",
        metavar="RUN",
        help="resume an interrupted run, as logs/dtfm/HalfCheetah-v5_1, with the arguments that it was started with",
    )
    shared = parser.add_argument_group("read on the way to RL-Zoo").add_argument
    shared("--algo", default="ppo", help=argparse.SUPPRESS)
    shared("--env", help=argparse.SUPPRESS)
    shared("-params", "--hyperparams", nargs="+", action="extend", default=[], help=argparse.SUPPRESS)
    shared("--gym-packages", nargs="+", default=[], help=argparse.SUPPRESS)
    return parser


def restored_arguments(run: Path, others: Sequence[str]) -> Restored | None:
    """
    Arguments beside `--resume`, whose packages are imported; None where there are other arguments.

    :param run: folder of the run
    :param others: the user's arguments beside `--resume`
    :raises UsageError: no such package
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-conf", "--conf-file")
    options, rest = parser.parse_known_args(others)
    if rest:
        return None
    import_packages(options.gym_packages)
    return Restored(run, options.gym_packages, options.conf_file)


def resumed_run(argv: Sequence[str]) -> tuple[Path | None, list[str]]:
    """
    The run that `--resume` names, None without, and the other arguments.

    :param argv: the user's arguments
    """
    parser = argparse.ArgumentParser(prog="sb3-dtfm train", add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    options, others = parser.parse_known_args(argv)
    return options.resume, others


def repeated_arguments(run: Path, started: list[str], others: Sequence[str]) -> list[str]:
    """
    Arguments for RL-Zoo's `train` of a run that is resumed.

    :param run: folder of the run
    :param started: arguments that it was started with
    :param others: the user's arguments beside `--resume`: all of them once more
    :raises UsageError: others, of another algorithm or task
    """
    arguments = train_arguments(others)
    of_the_run, given = (train_parser().parse_known_args(each)[0] for each in (started, arguments))
    if (of_the_run.algo, of_the_run.env) != (given.algo, given.env):
        raise UsageError(
            f"--resume {run}: takes no other arguments but --gym-packages and --conf-file; it was started with "
            f"--algo {of_the_run.algo} --env {of_the_run.env}."
        )
    return arguments


def train_arguments(argv: Sequence[str]) -> list[str]:
    """
    Arguments for RL-Zoo's `train`.

    The shorthands become hyperparameters. They are merged with the user's own, since RL-Zoo keeps only the last `-params`.

    :param argv: the user's arguments
    :raises UsageError: no task, a shorthand for an algorithm that knows no dataset, or one that is missing
    """
    options, rest = train_parser().parse_known_args(argv)
    check_algorithm(options.algo)
    options.env = options.env or _no_env(options.algo)
    check_env_id(options.env)
    if options.algo == FINETUNED:
        raise UsageError(f"--algo {FINETUNED}: such models come from `sb3-dtfm finetune`; `enjoy` plays them.")
    if options.dataset_fraction is not None and not 0.0 < options.dataset_fraction <= 1.0:
        raise UsageError(f"--dataset-fraction must be a number in (0, 1], got {options.dataset_fraction}.")
    import_packages(options.gym_packages)
    given = key_values("-params", options.hyperparams)
    conf_file = options.conf_file
    if options.algo in ALGORITHMS and conf_file in PACKAGED_CONFIGS:
        conf_file = str(packaged_config(options.algo, conf_file))
    elif conf_file is None:
        conf_file = online_config(options.algo, options.env)
    shorthands = _shorthands(options, {**listed_settings(conf_file, options.env), **given})
    if options.algo not in ALGORITHMS and shorthands:
        names = ", ".join(option for option, _ in shorthands)
        raise UsageError(f"{names}: for --algo {' and '.join(ALGORITHMS)} only, not for {options.algo}.")
    hyperparams = [*options.hyperparams, *(value for _, value in shorthands)]
    if options.algo in ALGORITHMS and options.conf_file in PACKAGED_CONFIGS:
        _check_task(conf_file, options.env, hyperparams)
    arguments = ["--algo", options.algo, "--env", options.env, *rest, *_packages(options)]
    if conf_file is not None:
        arguments += ["--conf-file", conf_file]
    if hyperparams:
        arguments += ["--hyperparams", *hyperparams]
    return arguments


def _no_env(algo: str) -> str:
    """
    The task where none is named: RL-Zoo's, for its own algorithms.

    :raises UsageError: another algorithm
    """
    if algo in ALGORITHMS:
        raise UsageError(
            f"--env: {algo} needs the Gymnasium id of its task; `sb3-dtfm inspect DATASET` tells whether the data name one. "
            f'Without an environment learn in Python: {algo.upper()}("MultiInputPolicy", dataset=...).'
        )
    return RL_ZOO_ENV


def check_algorithm(algo: str) -> None:
    """
    :param algo: RL-Zoo's name of an algorithm
    :raises UsageError: it knows none of that name
    """
    known = list(dict.fromkeys([*ALGOS, *ALGORITHMS, FINETUNED]))
    if algo not in known:
        nearest = with_nearest([algo.lower()], known).replace(algo.lower(), algo, 1)
        raise UsageError(f"--algo {nearest}: expected one of {', '.join(known)}.")


def check_env_id(env_id: str | None) -> None:
    """
    :param env_id: Gymnasium id, None where RL-Zoo has a default
    :raises UsageError: an id with a module, which RL-Zoo does not import
    """
    module, colon, name = (env_id or "").partition(":")
    if colon:
        raise UsageError(f"--env {env_id}: expected an id without its module: --gym-packages {module} --env {name}.")


def check_device(device: str | th.device) -> None:
    """
    :param device: PyTorch's name of a device
    :raises UsageError: it knows none of that name
    """
    try:
        th.device("cpu" if device == "auto" else device)
    except RuntimeError as error:
        raise UsageError(f"--device {device}: expected auto, cpu, cuda or cuda:N.") from error


def _packages(options: argparse.Namespace) -> list[str]:
    return ["--gym-packages", *options.gym_packages] if options.gym_packages else []


def _check_task(conf_file: str, env_id: str, hyperparams: Sequence[str]) -> None:
    """
    :raises UsageError: no dataset for a task that the packaged settings do not list
    """
    given = {hyperparam.split(":")[0] for hyperparam in hyperparams}
    listed = yaml.safe_load(Path(conf_file).read_text())
    if "dataset" not in given and env_id in gym.registry and env_id not in listed:
        raise UsageError(f"--dataset: needed for {env_id}, which {conf_file} does not list.")


def listed_settings(conf_file: str | None, env_id: str) -> dict[str, Any]:
    """
    The settings of a task in a YAML file; none in a file of another kind, or where there is none to read.

    :raises UsageError: a file that is not YAML, or holds something else than settings
    """
    if conf_file is None or not Path(conf_file).is_file() or Path(conf_file).suffix not in (".yml", ".yaml"):
        return {}
    entries = read_yaml(Path(conf_file))
    name = env_id if env_id in entries else "default"
    settings = entries.get(name, {})
    if not isinstance(settings, dict):
        raise UsageError(f"{conf_file}: {name}: expected settings, found {settings!r:.40}.")
    return settings


def read_yaml(path: Path) -> dict[str, Any]:
    """
    Read a mapping by task.

    :raises UsageError: a file that is not YAML, or holds something else
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise UsageError(f"{path}: expected a mapping by task, found {content!r:.40}.")
    return {str(task): value for task, value in content.items()}


def _shorthands(options: argparse.Namespace, settings: dict[str, Any]) -> list[tuple[str, str]]:
    """
    :param settings: settings of the task without these options
    :return: pairs of an option that was given and its `key:value`, whose value RL-Zoo evaluates as Python
    """
    wrapper = with_target_return(options.target_return, settings.get("env_wrapper") or [])
    of_the_data = {"fraction": options.dataset_fraction, "cache_dir": options.dataset_cache}
    wanted = {name: value for name, value in of_the_data.items() if value is not None}
    kwargs = {**(settings.get("dataset_kwargs") or {}), **wanted}
    dataset = options.dataset[0] if options.dataset and len(options.dataset) == 1 else options.dataset
    changes = [
        ("--dataset", "dataset", dataset, dataset),
        ("--dataset-fraction", "dataset_kwargs", options.dataset_fraction, kwargs),
        ("--dataset-cache", "dataset_kwargs", options.dataset_cache, kwargs),
        ("--target-return", "env_wrapper", options.target_return, wrapper),
    ]
    return [(option, f"{key}:{value!r}") for option, key, wanted, value in changes if wanted is not None]


def at_least(low: int) -> Callable[[str], int]:
    """
    The type of an argument that is a whole number.

    :param low: smallest number that is accepted
    """

    def number(text: str) -> int:
        with contextlib.suppress(ValueError):
            if (found := int(text)) >= low:
                return found
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least {low}")

    return number


def enjoy_parser() -> argparse.ArgumentParser:
    """Arguments of `enjoy` that RL-Zoo does not have, or that get a default here."""
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm enjoy",
        add_help=False,
        usage="sb3-dtfm enjoy --algo dtfm --env ENV [options] [RL-Zoo options]",
        description="Act with a trained model, and compare its episodes with the recorded ones.",
        epilog="RL-Zoo's own options follow.\n",
    )
    offline = parser.add_argument_group(f"of {' and '.join(ALGORITHMS)}").add_argument
    offline("--target-return", type=float, help="in reward units; the run's by default")
    shared = parser.add_argument_group("read on the way to RL-Zoo").add_argument
    shared("--algo", default="ppo", help=argparse.SUPPRESS)
    shared("--env", help=argparse.SUPPRESS)
    shared("-f", "--folder", help=argparse.SUPPRESS)
    shared("-n", "--n-timesteps", type=int, help=argparse.SUPPRESS)
    shared("--device", help=argparse.SUPPRESS)
    shared("--gym-packages", nargs="+", default=[], help=argparse.SUPPRESS)
    return parser


def enjoy_arguments(argv: Sequence[str]) -> tuple[float | None, list[str]]:
    """
    The target return that is given, None without, and arguments for RL-Zoo's `enjoy`.

    Our models are looked for where `train` puts them, not among the Zoo's own agents.

    :param argv: the user's arguments
    :raises UsageError: a target return for an algorithm that has none
    """
    options, rest = enjoy_parser().parse_known_args(argv)
    check_algorithm(options.algo)
    check_env_id(options.env)
    check_device(options.device or "auto")
    import_packages(options.gym_packages)
    ours = options.algo in (*ALGORITHMS, FINETUNED)
    if options.target_return is not None and not ours:
        raise UsageError(f"--target-return: for --algo {' and '.join(ALGORITHMS)} only, not for {options.algo}.")
    if options.folder == "":
        raise UsageError("-f: expected a folder, got ''; . is the current one.")
    if options.n_timesteps is not None and options.n_timesteps < 1:
        raise UsageError(f"-n: must be at least 1, got {options.n_timesteps}.")
    folder = options.folder or ("logs" if ours else None)
    with_target_return(options.target_return, None)  # refuses what is none
    n_steps = None if options.n_timesteps is None else str(options.n_timesteps)
    given = {"-n": n_steps, "--env": options.env, "--device": options.device, "--folder": folder}
    known = [word for option, value in given.items() if value for word in (option, value)]
    return options.target_return, ["--algo", options.algo, *rest, *known, *_packages(options)]
