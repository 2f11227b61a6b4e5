"""Packaged settings: YAML files as RL-Zoo reads them, and the method's paper's as constructor arguments."""

from importlib import resources
from typing import Any

import yaml


def paper_settings(algo: str) -> dict[str, Any]:
    """
    The settings of the method's paper: `DTFM(env=env, dataset=dataset, **paper_settings("dtfm")).learn(150_000)`.

    The environment is not among them: the paper's is `ReturnToGoWrapper(env, target_return, bound_return_to_go=False)`.

    :param algo: "dt" or "dtfm"
    :return: arguments of the class, `policy` among them
    :raises FileNotFoundError: another name
    """
    text = resources.files("sb3_dtfm.zoo_configs.paper").joinpath(f"{algo}.yml").read_text()
    default: dict[str, Any] = yaml.safe_load(text)["default"]
    return {name: value for name, value in default.items() if name not in ("n_timesteps", "env_wrapper")}
