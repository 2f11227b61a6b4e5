"""RL-Zoo's scripts as functions of their arguments, which they read from `sys.argv`."""

import functools
import importlib
import re
import runpy
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import rl_zoo3.enjoy
import rl_zoo3.train
import rl_zoo3.utils
import yaml
from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import create_test_env, get_model_path
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.data import check_controller
from sb3_dtfm.files import holds_pickles, read_configuration, settings_loader
from sb3_dtfm.finetuning import FINETUNED
from sb3_dtfm.zoo.arguments import Restored, StoreLiterals, StoreValues
from sb3_dtfm.zoo.comparison import EpisodesOf, compare
from sb3_dtfm.zoo.finetuning import FinetunedManager, OnlineManager
from sb3_dtfm.zoo.manager import OfflineExperimentManager
from sb3_dtfm.zoo.registration import ONLINE


class FoundModel(NamedTuple):
    """
    A model in the folder of a run, as RL-Zoo's `get_model_path` tells of it.

    :param prefix: name of the model among those of its run, for the names of videos
    :param path: zip file of the model
    :param run: folder of the run
    """

    prefix: str
    path: str
    run: str


def train(arguments: Sequence[str], resumed: Path | None = None, restored: Restored | None = None) -> None:
    """
    Train through :class:`OfflineExperimentManager`.

    :param arguments: arguments of RL-Zoo's `train`
    :param resumed: folder of an interrupted run to go on with
    :param restored: the user's arguments beside `--resume`, where all others come from that folder
    :raises TrainingError: training failed in its midst
    :raises SystemExit: SIGTERM has ended it, after the model was saved
    """
    manager = functools.partial(OfflineExperimentManager, arguments=list(arguments), resumed=resumed, restored=restored)
    _train("train", manager, arguments, restored)


def finetune(
    arguments: Sequence[str],
    model: Path,
    target_return: float | None = None,
    started_with: Sequence[str] = (),
    resumed: Path | None = None,
    evaluations_of_a_run: int | None = None,
    restored: Restored | None = None,
) -> None:
    """
    Go on from a DTFM: by :class:`OnlineManager` where it learns itself, else by :class:`FinetunedManager`.

    :param arguments: arguments of RL-Zoo's `train`
    :param model: zip file of the DTFM, or folder of its run
    :param target_return: target return, environment reward units; None for that of the run
    :param started_with: the command's own arguments
    :param resumed: folder of an interrupted run to go on with
    :param evaluations_of_a_run: number of evaluations at equal shares of a run's timesteps; None where RL-Zoo's
        `--eval-freq` decides
    :param restored: the user's arguments beside `--resume`, where all others come from that folder
    :raises TrainingError: training failed in its midst
    :raises SystemExit: SIGTERM has ended it, after the model was saved
    """
    kind = OnlineManager if arguments[list(arguments).index("--algo") + 1] == ONLINE else FinetunedManager
    goes_on = dict(base=model, target_return=target_return, evaluations_of_a_run=evaluations_of_a_run)
    manager = functools.partial(kind, **goes_on, arguments=list(started_with), resumed=resumed, restored=restored)
    _train("finetune", manager, arguments, restored)


def _train(command: str, manager: Any, arguments: Sequence[str], restored: Restored | None) -> None:
    """Call RL-Zoo's `train`; what a run's folder says is neither evaluated nor imported."""
    script: Any = rl_zoo3.train
    script.ExperimentManager = manager
    script.StoreDict = StoreValues if restored is None else StoreLiterals
    if restored is not None:
        restored.check_upload(arguments)
    script.importlib = importlib if restored is None else SimpleNamespace(import_module=restored.check_package)
    _call(script.train, command, arguments)


def enjoy(arguments: Sequence[str], target_return: float | None = None) -> None:
    """
    Act with a trained model, and compare its episodes with those that it learned from.

    :param arguments: arguments of RL-Zoo's `enjoy`
    :param target_return: target return, environment reward units; None for that of the model's run
    :raises FileNotFoundError: no such run, or no such model in it
    """
    found: list[tuple[FoundModel, str, EnvironmentName]] = []
    envs: list[EpisodesOf] = []
    asked: list[float] = []

    def find(exp_id: int, folder: str, algo: str, env_name: EnvironmentName, *args: Any) -> FoundModel:
        found.append((find_model(exp_id, folder, algo, env_name, *args), algo, env_name))
        return found[-1][0]

    def make(*args: Any, **kwargs: Any) -> EpisodesOf:
        envs.append(EpisodesOf(_without_pickles(*found[-1][:2], *args, **kwargs)))
        if target_return is not None:
            envs[-1].env_method("set_target_return", target_return)
        if not holds_pickles(found[-1][0].path):  # those of RL-Zoo's own algorithms
            asked.append(envs[-1].get_attr("target_return")[0])
        return envs[-1]

    script: Any = rl_zoo3.enjoy
    script.get_model_path, script.create_test_env, script.StoreDict = find, make, StoreValues
    _call(script.enjoy, "enjoy", arguments)
    model, _, env_name = found[-1]
    if asked:
        attributes = {**read_configuration(model.path)["attributes"], "target_return": asked[-1]}
        for sentence in compare(attributes, envs[-1].returns, envs[-1].successes, Path(model.run), env_name):
            print(sentence)


def record_video(model: FoundModel, arguments: Sequence[str]) -> None:
    """
    Film a trained model.

    :param model: model that acts
    :param arguments: arguments of RL-Zoo's `record_video`, but for those that choose a model
    """
    make = functools.partial(_without_pickles, model, arguments[list(arguments).index("--algo") + 1])
    with mock.patch.multiple(rl_zoo3.utils, get_model_path=lambda *_: model, create_test_env=make, StoreDict=StoreValues):
        _call(lambda: runpy.run_module("rl_zoo3.record_video", run_name="__main__"), "video", arguments)


def _without_pickles(model: FoundModel, algo: str, *args: Any, **kwargs: Any) -> VecEnv:
    """
    Call RL-Zoo's `create_test_env`; VecNormalize's pickled statistics are loaded only for an algorithm whose models are
    pickles, too.

    :raises DatasetError: an action does something else there than in the data of the model
    :raises ModelFileError: a model of dt or dtfm that is a pickle
    """
    if algo not in (*ALGORITHMS, FINETUNED):
        return create_test_env(*args, **kwargs)
    env = create_test_env(*args, **{**kwargs, "stats_path": None})
    check_controller(read_configuration(model.path)["attributes"].get("controller"), env.get_attr("env_args", [0])[0])
    return env


def plot(name: str, arguments: Sequence[str]) -> None:
    """
    Plot runs.

    :param name: name of a script in `rl_zoo3.plots`
    :param arguments: arguments of the script
    """
    import rl_zoo3.plots  # it asks for seaborn

    _call(getattr(rl_zoo3.plots, name), f"plot {name}", arguments)


def find_model(exp_id: int, folder: str, algo: str, env_name: EnvironmentName, *args: Any, **kwargs: Any) -> FoundModel:
    """
    Find a model as RL-Zoo's `get_model_path` does; but the latest run is the latest that has such a model, as a search for
    hyperparameters and a run that has just begun have none.

    :param exp_id: number of a run, 0 for the latest, -1 for no folder of a run
    :param folder: folder of all runs
    :param algo: algorithm of the run
    :param env_name: environment of the run
    :raises FileNotFoundError: no such run, or no such model in it
    """
    ids = [exp_id] if exp_id else _runs(Path(folder, algo), env_name) or [0]
    errors = []
    for number in ids:
        try:
            found = FoundModel(*get_model_path(number, folder, algo, env_name, *args, **kwargs))
        except (AssertionError, ValueError) as error:
            errors.append(error)
        else:
            if not exp_id:
                print(f"Loading latest experiment that has such a model, id={number}")
            return found
    if "rl-trained-agents" in folder:  # RL-Zoo waits for such an error to download the agent
        raise errors[0]
    raise FileNotFoundError(f"{errors[0]}. -f names the folder that train wrote to, --exp-id the run in it.") from errors[0]


def _runs(folder: Path, env_name: EnvironmentName) -> list[int]:
    """Numbers of the runs of a task, the latest first."""
    named = (re.fullmatch(rf"{re.escape(env_name)}_(\d+)", path.name) for path in folder.glob("*/"))
    return sorted((int(match[1]) for match in named if match), reverse=True)


def _call(function: Callable[[], object], command: str, arguments: Sequence[str]) -> None:
    argv = mock.patch.object(sys, "argv", [f"sb3-dtfm {command}", *arguments])
    with argv, mock.patch.object(yaml, "UnsafeLoader", settings_loader()):  # by which RL-Zoo reads a run's folder
        function()
