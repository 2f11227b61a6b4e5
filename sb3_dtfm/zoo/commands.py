"""RL-Zoo's `train` and `enjoy` as functions of their arguments, which they read from `sys.argv`."""

import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rl_zoo3.enjoy
import rl_zoo3.train
from rl_zoo3.utils import get_model_path

from sb3_dtfm.zoo.manager import OfflineExperimentManager


def train(arguments: Sequence[str], resumed: Path | None = None) -> None:
    """
    Train through :class:`OfflineExperimentManager`.

    :param arguments: of RL-Zoo's `train`
    :param resumed: folder of an interrupted run to go on with
    :raises TrainingError: training failed in its midst
    :raises SystemExit: SIGTERM has ended it, after what there is was saved
    """
    manager = functools.partial(OfflineExperimentManager, arguments=list(arguments), resumed=resumed)
    rl_zoo3.train.ExperimentManager = manager  # type: ignore[misc,assignment]
    _call(rl_zoo3.train.train, "train", arguments)


def enjoy(arguments: Sequence[str]) -> None:
    """
    Act with a trained model.

    :param arguments: of RL-Zoo's `enjoy`
    :raises FileNotFoundError: no such run, or no such model in it
    """
    rl_zoo3.enjoy.get_model_path = _find_model
    _call(rl_zoo3.enjoy.enjoy, "enjoy", arguments)


def _find_model(exp_id: int, folder: str, *args: Any, **kwargs: Any) -> tuple[str, str, str]:
    try:
        return get_model_path(exp_id, folder, *args, **kwargs)
    except (AssertionError, ValueError) as error:
        if "rl-trained-agents" in folder:  # RL-Zoo waits for such an error to download the agent
            raise
        raise FileNotFoundError(f"{error}. -f names the folder that train wrote to, --exp-id the run in it.") from error


def _call(function: Callable[[], None], command: str, arguments: Sequence[str]) -> None:
    saved = sys.argv
    sys.argv = [f"sb3-dtfm {command}", *arguments]
    try:
        function()
    finally:
        sys.argv = saved
