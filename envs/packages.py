"""Packages that register tasks."""

import importlib
import os
import sys
from collections.abc import Sequence

from sb3_dtfm.envs.robotics import register_gymnasium_robotics


def import_packages(modules: Sequence[str], where: str = "--gym-packages") -> None:
    """
    Import what registers tasks, as RL-Zoo's `--gym-packages` does, also from the current folder; gymnasium-robotics needs no
    mention.

    :param modules: dotted names of modules
    :param where: name of the option that listed them, for the message
    :raises ValueError: there is none of that name
    """
    register_gymnasium_robotics()
    if modules and os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())  # where `python -m` looks, but no installed command does
    for module in modules:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise ValueError(f"{where} {module}: {error}.") from error
