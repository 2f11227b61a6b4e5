"""The saved parts of a model, as JSON and tensors."""

import json
import math
import warnings
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
import torch as th
from minari.serialization import serialize_space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_dtfm.algorithms.saved_options import (
    DATASET_OPTIONS,
    STRUCTURED,
    check_structured,
    check_text,
)
from sb3_dtfm.files import printable
from sb3_dtfm.optimization import RunningMeans
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.images import extractor_name

POLICY, OPTIMIZER, CRITIC_OPTIMIZER = "policy", "policy.optimizer", "policy.critic.optimizer"
CRITIC_PREFIX = "critic."  # begins the names of the critic's tensors among the optimiser's
SPACES = ("observation_space", "action_space")
# Attributes that have a form of their own in the file.
ENCODED = {*SPACES, "policy_class", "learning_rate", "_means"}


# `weights` among `features_extractor_kwargs` is a file that only the first training needs.
EXTRACTOR, EXTRACTOR_KWARGS, WEIGHTS = "features_extractor_class", "features_extractor_kwargs", "weights"


class UnsavedSchedule:
    """
    Placeholder for a learning rate that is a function, which a file cannot hold: the model acts, and does not learn.

    :param name: name of the function
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, progress_remaining: float) -> float:
        return 0.0

    def check(self) -> None:
        """
        :raises ValueError: always; it asks for the function
        """
        raise ValueError(
            f"learning_rate was the function {printable(self.name)} when this model was saved, and files hold no functions: "
            "give it again, load(path, learning_rate=...)."
        )


def to_configuration(
    model: BaseAlgorithm, known: Collection[str], left_out: Iterable[str], wanted: Iterable[str]
) -> dict[str, Any]:
    """
    The attributes of a model as JSON.

    :param model: model to save
    :param known: attributes that loading accepts
    :param left_out: attributes not to save
    :param wanted: attributes that the caller asked for by name
    :raises ValueError: one that is wanted cannot be saved
    """
    for name in sorted(set(wanted) - vars(model).keys()):
        raise ValueError(f"{name} is no part of a saved model: this one has no such attribute.")
    attributes = {name: value for name, value in vars(model).items() if name not in {*left_out, *ENCODED}}
    if attributes.get("dataset_kwargs"):
        attributes["dataset_kwargs"] = _saved_dataset_kwargs(attributes["dataset_kwargs"])
    if "policy_kwargs" in attributes:
        attributes["policy_kwargs"] = _without_weights(attributes["policy_kwargs"])
    saved: dict[str, Any] = {}
    for name, value in attributes.items():
        try:
            if name not in known:
                raise ValueError("files hold a model's settings and progress, and a subclass's constructor arguments")
            plain = _json(value)
            if name in STRUCTURED:
                check_structured(name, plain)
            saved[name] = plain
        except (TypeError, ValueError) as error:
            problem = f"{name} is no part of a saved model: {error}"
            if name in wanted:
                raise ValueError(problem) from error
            warnings.warn(problem, stacklevel=3)
    return {
        "algorithm": head_name(model.policy_aliases),
        "policy_class": _policy_name(model),
        "learning_rate": _learning_rate(model.learning_rate),
        "means": _means(model._means),  # type: ignore[attr-defined]
        **{name: serialize_space(getattr(model, name)) for name in SPACES},
        "attributes": saved,
    }


def _saved_dataset_kwargs(dataset_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Keep the arguments that a file may hold; a warning names the others, but for a cache's folder on this machine."""
    kept = {name: value for name, value in dataset_kwargs.items() if name in DATASET_OPTIONS}
    if unsaved := sorted(dataset_kwargs.keys() - kept.keys() - {"cache_dir"}):
        warnings.warn(
            f"dataset_kwargs: {', '.join(unsaved)}: not saved; give dataset_kwargs again to learn further.", stacklevel=4
        )
    return kept


def saved_policy_kwargs(policy_kwargs: Any) -> Any:
    """
    Arguments of the policy that a file can hold: a class for images becomes its name, which is entered in `EXTRACTORS`.

    :param policy_kwargs: arguments of the policy as they were given
    :raises ValueError: arguments of such a class that are no plain values or no plain text, so that no file could be loaded
    """
    if not isinstance(policy_kwargs, dict):
        return policy_kwargs
    if EXTRACTOR in policy_kwargs:
        policy_kwargs = {**policy_kwargs, EXTRACTOR: extractor_name(policy_kwargs[EXTRACTOR])}
    try:
        check_text(_json(_without_weights(policy_kwargs).get(EXTRACTOR_KWARGS)), "it")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{EXTRACTOR_KWARGS}: {error}; a model's file holds numbers, text, lists and dictionaries."
        ) from error
    return policy_kwargs


def _without_weights(policy_kwargs: Any) -> Any:
    """Arguments of the policy without the file of weights that an extractor began with."""
    if not isinstance(policy_kwargs, dict) or not isinstance(policy_kwargs.get(EXTRACTOR_KWARGS), Mapping):
        return policy_kwargs
    kept = {name: value for name, value in policy_kwargs[EXTRACTOR_KWARGS].items() if name != WEIGHTS}
    return {**policy_kwargs, EXTRACTOR_KWARGS: kept}


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value, allow_nan=False, default=_plain))


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays, as Python's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"it holds a {type(value).__name__}, not plain values")


def head_name(policies: Mapping[str, type[BasePolicy]]) -> str:
    """Name of an algorithm in a file: that of its policies' head, whatever its own class is called."""
    policy = policies["MultiInputPolicy"]
    assert issubclass(policy, SequencePolicy)
    return policy.head_class.algorithm


def _policy_name(model: BaseAlgorithm) -> str:
    """The policy's alias, or the name of a user's own class, which `load` cannot find by itself."""
    names = [name for name, policy in model.policy_aliases.items() if policy is model.policy_class]
    return names[0] if names else model.policy_class.__name__


def _learning_rate(learning_rate: Any) -> Any:
    schedule = learning_rate.value_schedule if isinstance(learning_rate, FloatSchedule) else learning_rate
    if isinstance(schedule, ConstantSchedule):
        return float(schedule.val)
    if isinstance(schedule, LinearSchedule):
        return {name: float(value) for name, value in vars(schedule).items()}
    if isinstance(schedule, UnsavedSchedule):
        return schedule.name
    return getattr(schedule, "__name__", repr(schedule)) if callable(schedule) else float(schedule)


def _means(means: RunningMeans) -> dict[str, Any]:
    sums = means.sums()
    if not all(map(math.isfinite, sums.values())):  # what is to be logged next is an error
        return {"n_values": 0, "sums": {}}
    return {"n_values": means.n_values, "sums": sums}


def optimizers(policy: SequencePolicy) -> dict[str, tuple[th.optim.Optimizer, str]]:
    """Return the optimisers by SB3's names, each with the prefix of its tensors' names in a file."""
    own: dict[str, tuple[th.optim.Optimizer, str]] = {OPTIMIZER: (policy.optimizer, "")}
    return own if policy.critic is None else {**own, CRITIC_OPTIMIZER: (policy.critic.optimizer, CRITIC_PREFIX)}


def optimizer_tensors(policy: SequencePolicy) -> dict[str, th.Tensor]:
    """The states of a policy's optimisers, by the number of the weight and the name of the moment."""
    tensors: dict[str, th.Tensor] = {}
    for optimizer, prefix in optimizers(policy).values():
        states = optimizer.state_dict()["state"]
        tensors |= {f"{prefix}{number}.{name}": value for number, state in states.items() for name, value in state.items()}
    return tensors
