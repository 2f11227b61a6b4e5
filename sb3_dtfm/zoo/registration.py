"""Enter the algorithms into RL-Zoo's tables of algorithms and of hyperparameter searches."""

from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, cast

import optuna
import yaml
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.envs import register_gymnasium_robotics
from sb3_dtfm.finetuning import FINETUNED, FinetunedDTFM
from sb3_dtfm.policies import SequencePolicy

# Name of filtered imitation in `finetune --algo`; its run is one of this algorithm, as any other.
ONLINE = "dtfm"
# Folder of the online algorithms' settings.
FINETUNING_CONFIGS = "sb3_dtfm.zoo_configs.finetune"
# Values of `--conf-file` besides files and Python packages; None is no `--conf-file` at all.
PACKAGED_CONFIGS = {None: "sb3_dtfm.zoo_configs", "paper": "sb3_dtfm.zoo_configs.paper"}


def register() -> None:
    """
    Add the algorithms in place, so that RL-Zoo's functions see them wherever they were imported.

    Tasks of gymnasium-robotics, which RL-Zoo does not know, are registered, too.
    """
    register_gymnasium_robotics()
    ALGOS.update({**ALGORITHMS, FINETUNED: FinetunedDTFM})
    HYPERPARAMS_SAMPLER.update({name: partial(sample_params, name) for name in ALGORITHMS})
    HYPERPARAMS_CONVERTER.update({name: partial(convert_params, name) for name in ALGORITHMS})


def packaged_config(algo: str, name: str | None = None) -> Path:
    """
    Hyperparameter file that comes with the package.

    :param algo: a key of `ALGORITHMS`; DT's settings, those of the Transformer, serve a head without a file of its own
    :param name: name of the settings: None for the recommended ones, "paper" for those of the method's paper
    """
    folder = resources.files(PACKAGED_CONFIGS[name])
    own = Path(str(folder.joinpath(f"{algo}.yml")))
    return own if own.is_file() else Path(str(folder.joinpath("dt.yml")))


def online_config(algo: str, env_id: str) -> str | None:
    """
    Hyperparameter file that comes with the package for a task of its own, which RL-Zoo does not list.

    :param algo: RL-Zoo's name of an online algorithm
    :return: path of the file, None where there is none
    """
    path = Path(str(resources.files(PACKAGED_CONFIGS[None]).joinpath(f"{algo}.yml")))
    return str(path) if path.is_file() and env_id in yaml.safe_load(path.read_text()) else None


def is_packaged(path: str) -> bool:
    """Return whether settings came with the package."""
    return Path(str(resources.files(PACKAGED_CONFIGS[None]))).resolve() in Path(path).resolve().parents


def finetuning_config(algo: str) -> Path:
    """
    Hyperparameter file that comes with the package, of an algorithm that `finetune` takes.

    :param algo: RL-Zoo's name of the algorithm
    :raises ValueError: an algorithm without packaged settings
    """
    folder = Path(str(resources.files(FINETUNING_CONFIGS)))
    found = {path.stem: path for path in sorted(folder.glob("*.yml"))}
    if algo not in found:
        raise ValueError(f"--algo {algo}: no packaged settings; those of {', '.join(found)} are. Others need a --conf-file.")
    return found[algo]


def policy_of(algo: str) -> type[SequencePolicy]:
    """
    The policy of an algorithm.

    :param algo: a key of `ALGORITHMS`
    """
    return cast(type[SequencePolicy], ALGORITHMS[algo].policy_aliases["MultiInputPolicy"])


def convert_params(algo: str, sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Constructor arguments from the parameters of a trial.

    RL-Zoo lets a trial's `policy_kwargs` replace the YAML's as a whole, so the search covers all that the packaged settings
    choose there.

    :param algo: unused name of the algorithm, as options of the policy have the same names for all
    :param sampled_params: parameters as Optuna stores them: flat, powers of two by their exponent
    """
    params = {
        name.removesuffix("_pow"): 2**value if name.endswith("_pow") else value for name, value in sampled_params.items()
    }
    return with_policy_options({"policy_kwargs": {}, **params})


def with_policy_options(settings: dict[str, Any]) -> dict[str, Any]:
    """
    Settings in which options of a policy, as `-params critic_steps:10` gives them, are entries of the `policy_kwargs`.

    :param settings: arguments of an algorithm, and what RL-Zoo knows beside them
    :raises ValueError: the `policy_kwargs` are no mapping
    """
    names = set.union(*(policy_of(algo).parameter_names() for algo in ALGORITHMS))
    options = {name: value for name, value in settings.items() if name in names}
    if not options:
        return settings
    policy_kwargs = settings.get("policy_kwargs") or {}
    if not isinstance(policy_kwargs, dict):
        raise ValueError(f"{', '.join(options)}: policy_kwargs is {policy_kwargs!r}, no mapping that could have them, too.")
    others = {name: value for name, value in settings.items() if name not in names}
    return {**others, "policy_kwargs": {**policy_kwargs, **options}}


def sample_params(
    algo: str, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Search space: the Transformer's, the same for all algorithms, and the head's own.

    :param algo: a key of `ALGORITHMS`
    :param trial: Optuna's trial, which draws
    :param n_actions: unused number of actions; RL-Zoo gives it and the next two to every search
    :param n_envs: unused number of environments
    :param additional_args: unused further arguments
    :return: constructor arguments
    """
    return convert_params(algo, {**_sample_transformer(trial), **policy_of(algo).head_class.search_space(trial)})


def _sample_transformer(trial: optuna.Trial) -> dict[str, Any]:
    """Draw what both algorithms share: optimiser, context and Transformer."""
    return {
        "learning_rate": trial.suggest_float("learning_rate", 3e-5, 3e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 8),
        "weight_decay": trial.suggest_float("weight_decay", 1e-5, 1e-1, log=True),
        "ema_decay": trial.suggest_categorical("ema_decay", [0.0, 0.99, 0.999]),
        "context_length": trial.suggest_categorical("context_length", [1, 5, 10, 20, 50]),
        "embed_dim_pow": trial.suggest_int("embed_dim_pow", 6, 8),
        "n_layers": trial.suggest_int("n_layers", 2, 10),
        "n_heads_pow": trial.suggest_int("n_heads_pow", 0, 2),
        "dropout": trial.suggest_float("dropout", 0.0, 0.3),
        "timestep_embedding": trial.suggest_categorical("timestep_embedding", [True, False]),
        "tokens_per_step": trial.suggest_categorical("tokens_per_step", [1, 3]),
        "chunk_size": trial.suggest_categorical("chunk_size", [1, 4, 8, 16]),
        "clip_return_to_go": trial.suggest_categorical("clip_return_to_go", [True, False]),
        "film_return_to_go": trial.suggest_categorical("film_return_to_go", [True, False]),
        "observation_scaling": trial.suggest_categorical("observation_scaling", ["std", "robust"]),
    }
