"""Enter `dt` and `dtfm` into RL-Zoo's tables of algorithms and of hyperparameter searches."""

from importlib import resources
from pathlib import Path
from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dtfm import DT, DTFM

OFFLINE_ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"dt": DT, "dtfm": DTFM}

# What `--conf-file` accepts besides files and Python packages; None is no `--conf-file` at all.
PACKAGED_CONFIGS = {None: "sb3_dtfm.zoo_configs", "small": "sb3_dtfm.zoo_configs.small"}

# Everything a trial changes inside `policy_kwargs`. RL-Zoo lets a trial's `policy_kwargs` replace the YAML's as a whole, so
# the search covers all that the packaged settings choose there.
_POLICY_KEYS = (
    "embed_dim",
    "n_layers",
    "n_heads",
    "dropout",
    "timestep_embedding",
    "clip_return_to_go",
    "flow_hidden_dim",
    "flow_n_layers",
    "flow_prediction",
    "flow_tau_exponent",
    "n_solver_steps",
)


def register() -> None:
    """Add both algorithms in place, so that RL-Zoo's functions see them wherever they were imported."""
    ALGOS.update(OFFLINE_ALGORITHMS)
    HYPERPARAMS_SAMPLER.update({"dt": sample_dt_params, "dtfm": sample_dtfm_params})
    HYPERPARAMS_CONVERTER.update({"dt": convert_params, "dtfm": convert_params})


def packaged_config(algo: str, name: str | None = None) -> Path:
    """
    Hyperparameter file that comes with the package.

    :param algo: "dt" or "dtfm"
    :param name: None for the paper's settings, "small" for those of a 2-core machine
    """
    return Path(str(resources.files(PACKAGED_CONFIGS[name]).joinpath(f"{algo}.yml")))


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Constructor arguments from the parameters of a trial.

    :param sampled_params: as Optuna stores them: flat, powers of two by their exponent
    """
    params = {
        name.removesuffix("_pow"): 2**value if name.endswith("_pow") else value for name, value in sampled_params.items()
    }
    policy_kwargs = {key: params.pop(key) for key in _POLICY_KEYS if key in params}
    return {**params, "policy_kwargs": policy_kwargs}


def sample_dt_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict) -> dict[str, Any]:
    """
    Search space of :class:`~sb3_dtfm.DT`; the signature is RL-Zoo's.

    :param trial: the trial that draws
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor arguments
    """
    return convert_params(_sample_trunk(trial))


def sample_dtfm_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict) -> dict[str, Any]:
    """
    Search space of :class:`~sb3_dtfm.DTFM`: that of DT and the flow head's; the signature is RL-Zoo's.

    :param trial: the trial that draws
    :param n_actions: unused
    :param n_envs: unused
    :param additional_args: unused
    :return: constructor arguments
    """
    flow = {
        "flow_hidden_dim_pow": trial.suggest_int("flow_hidden_dim_pow", 7, 9),
        "flow_n_layers": trial.suggest_int("flow_n_layers", 2, 4),
        "flow_prediction": trial.suggest_categorical("flow_prediction", ["velocity", "action"]),
        "flow_tau_exponent": trial.suggest_categorical("flow_tau_exponent", [1.0, 2.0]),
        "n_solver_steps": trial.suggest_categorical("n_solver_steps", [1, 3, 10, 50]),
    }
    return convert_params({**_sample_trunk(trial), **flow})


def _sample_trunk(trial: optuna.Trial) -> dict[str, Any]:
    """What both algorithms share: optimiser, context and Transformer."""
    return {
        "learning_rate": trial.suggest_float("learning_rate", 3e-5, 3e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 8),
        "weight_decay": trial.suggest_float("weight_decay", 1e-5, 1e-1, log=True),
        "ema_decay": trial.suggest_categorical("ema_decay", [0.0, 0.99, 0.999]),
        "context_length": trial.suggest_categorical("context_length", [5, 10, 20, 50]),
        "embed_dim_pow": trial.suggest_int("embed_dim_pow", 6, 8),
        "n_layers": trial.suggest_int("n_layers", 2, 10),
        "n_heads_pow": trial.suggest_int("n_heads_pow", 0, 2),
        "dropout": trial.suggest_float("dropout", 0.0, 0.3),
        "timestep_embedding": trial.suggest_categorical("timestep_embedding", [True, False]),
        "clip_return_to_go": trial.suggest_categorical("clip_return_to_go", [True, False]),
    }
