"""What of a model is saved, as JSON and tensors; and the checks that it passes on its way back."""

import contextlib
import json
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from minari.serialization import deserialize_space, serialize_space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_dtfm.arguments import COUNT, Number, Rule, check_arguments
from sb3_dtfm.data import check_action_space
from sb3_dtfm.envs import OBSERVATION, RETURN_TO_GO, TIMESTEP
from sb3_dtfm.files import ModelFileError
from sb3_dtfm.optimization import RunningMeans
from sb3_dtfm.policies import SequencePolicy

POLICY, OPTIMIZER, CRITIC_OPTIMIZER = "policy", "policy.optimizer", "policy.critic.optimizer"
CRITIC_PREFIX = "critic."  # of the names of the critic's tensors among the optimiser's
SPACES = ("observation_space", "action_space")
# Attributes that have a form of their own in the file.
ENCODED = (*SPACES, "policy_class", "learning_rate", "_means")
WHOLE = Number(low=0, whole=True)
# What the file says of a model beside its arguments, which are checked as when they are given.
COUNTERS: dict[str, Rule] = {
    "num_timesteps": WHOLE,
    "_total_timesteps": WHOLE,
    "_num_timesteps_at_start": WHOLE,
    "_n_updates": WHOLE,
    "n_envs": COUNT,
    "max_timestep": COUNT,
    "verbose": WHOLE,
}
# Of the policy's tensors.
POSITIVE_BUFFERS = {
    "normalization.observation_std",
    "normalization.observation_gain",
    "normalization.return_scale",
    "critic.reward_scale",
    "critic.spread",
}
# The optimiser's state of a weight: its own shape, or a number.
MOMENTS = {"step": False, "exp_avg": True, "exp_avg_sq": True}


@contextlib.contextmanager
def naming_the_file(source: str) -> Iterator[None]:
    """
    Have whatever does not fit be a fault of the file.

    :raises ModelFileError: names it
    """
    try:
        yield
    except ModelFileError:
        raise
    except (TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise ModelFileError(f"{source}: {error}") from error


class UnsavedSchedule:
    """
    Stands for a learning rate that is a function, which a file cannot hold: the model acts, and does not learn.

    :param name: of the function
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, progress_remaining: float) -> float:
        return 0.0

    def check(self) -> None:
        """
        :raises ValueError: asks for the function
        """
        raise ValueError(
            f"learning_rate was the function {self.name} when this model was saved, and a file holds no functions: give it "
            "again, load(path, learning_rate=...)."
        )


def to_configuration(model: BaseAlgorithm, left_out: Iterable[str], wanted: Iterable[str]) -> dict[str, Any]:
    """
    The attributes of a model as JSON.

    :param model: to save
    :param left_out: attributes not to save
    :param wanted: attributes that the caller asked for by name
    :raises ValueError: one that is wanted cannot be saved
    """
    attributes = {name: value for name, value in vars(model).items() if name not in {*left_out, *ENCODED}}
    saved: dict[str, Any] = {}
    for name, value in attributes.items():
        try:
            saved[name] = json.loads(json.dumps(value, allow_nan=False, default=_plain))
        except (TypeError, ValueError) as error:
            problem = f"{name} is no part of a saved model: it is a {type(value).__name__}, not plain values ({error})."
            if name in wanted:
                raise ValueError(problem) from error
            warnings.warn(problem, stacklevel=3)
    return {
        "algorithm": _head_name(type(model)),
        "policy_class": _policy_name(model),
        "learning_rate": _learning_rate(model.learning_rate),
        "means": _means(model._means),  # type: ignore[attr-defined]
        **{name: serialize_space(getattr(model, name)) for name in SPACES},
        "attributes": saved,
    }


def _plain(value: Any) -> Any:
    """NumPy's numbers, as Python's."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON")


def _head_name(algorithm: type[BaseAlgorithm]) -> str:
    policy = algorithm.policy_aliases["MultiInputPolicy"]
    assert issubclass(policy, SequencePolicy)
    return policy.head_class.algorithm


def _policy_name(model: BaseAlgorithm) -> str:
    """The policy's alias; of a user's own class its name, which `load` cannot find by itself."""
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


def from_configuration(
    algorithm: type[BaseAlgorithm], configuration: Mapping[str, Any], custom_objects: Mapping[str, Any], source: str
) -> dict[str, Any]:
    """
    The attributes of a model from JSON.

    :param algorithm: the class that is loaded
    :param configuration: of :func:`to_configuration`
    :param custom_objects: attributes in place of those in the file
    :param source: the file, for messages
    :raises ModelFileError: something is missing, or not what :func:`to_configuration` writes
    """

    def taken(name: str, kinds: type | tuple[type, ...]) -> Any:
        if not isinstance(configuration.get(name), kinds):
            raise ModelFileError(f"{source}: {name} is {configuration.get(name)!r}, which no model was saved with.")
        return configuration[name]

    saved_by, asked = taken("algorithm", str), _head_name(algorithm)
    if saved_by != asked:
        raise ModelFileError(f"{source} was saved by {saved_by}, not by {asked}.")
    attributes = dict(taken("attributes", dict))
    for name in attributes:
        if hasattr(algorithm, name) or name in (*ENCODED, "policy", "device", "env"):
            raise ModelFileError(f"{source}: {name} is no attribute that a model is saved with.")
    attributes.update({name: _space(taken(name, str), f"{source}: {name}") for name in SPACES})
    attributes["_means"] = _to_means(taken("means", dict), source)
    attributes["learning_rate"] = _to_learning_rate(taken("learning_rate", (int, float, str, dict)), source)
    if "policy_class" not in custom_objects:
        attributes["policy_class"] = _policy_class(algorithm, taken("policy_class", str), source)
    attributes.update({name: each for name, each in custom_objects.items() if name in {*attributes, *ENCODED}})
    _check_attributes(attributes, source)
    return attributes


def _policy_class(algorithm: type[BaseAlgorithm], name: str, source: str) -> type[BasePolicy]:
    if name not in algorithm.policy_aliases:
        raise ModelFileError(
            f"{source}: its policy is a {name}, a class that a file does not hold; "
            f"give it, load(path, custom_objects={{'policy_class': {name}}})."
        )
    return algorithm.policy_aliases[name]


def _check_attributes(attributes: Mapping[str, Any], source: str) -> None:
    """What is not checked as arguments are."""
    if not isinstance(attributes.get("policy_kwargs", {}), dict):
        raise ModelFileError(f"{source}: policy_kwargs are {attributes['policy_kwargs']!r}, expected arguments by name.")
    reference = attributes.get("score_reference")
    kinds = [type(each) for each in reference] if isinstance(reference, list) else reference
    if kinds not in (None, [float, float, str]) or (reference and not reference[0] < reference[1]):
        raise ModelFileError(f"{source}: score_reference is {reference}, expected two returns and where they come from.")
    with naming_the_file(source):
        check_arguments({**dict.fromkeys(COUNTERS, 1), **attributes}, COUNTERS)  # one may have been left out
    observation, action = attributes["observation_space"], attributes["action_space"]
    parts = observation.spaces if isinstance(observation, spaces.Dict) else {}
    is_vector = {name: isinstance(part, spaces.Box) and len(part.shape) == 1 for name, part in parts.items()}
    if is_vector != dict.fromkeys((OBSERVATION, RETURN_TO_GO, TIMESTEP), True):
        raise ModelFileError(f"{source}: observation_space is {observation}, not what a ReturnToGoWrapper observes.")
    with naming_the_file(source):
        check_action_space(action, "action_space")


def _space(described: str, what: str) -> spaces.Space:
    try:
        return deserialize_space(described)
    except Exception as error:  # whatever Gymnasium raises for numbers that make no space
        raise ModelFileError(f"{what} is no space: {error!r}.") from error


def _to_learning_rate(saved: Any, source: str) -> Any:
    if isinstance(saved, str):
        return UnsavedSchedule(saved)
    if not isinstance(saved, dict):
        return float(saved)
    try:
        return LinearSchedule(**{name: float(value) for name, value in saved.items()})
    except (TypeError, ValueError) as error:
        raise ModelFileError(f"{source}: learning_rate is {saved}, expected start, end and end_fraction.") from error


def _to_means(saved: dict[str, Any], source: str) -> RunningMeans:
    n_values, sums = saved.get("n_values", -1), saved.get("sums")
    numbers = sums.values() if isinstance(sums, dict) else [None]
    if not WHOLE.accepts(n_values) or not all(map(Number().accepts, numbers)) or bool(n_values) != bool(sums):
        raise ModelFileError(f"{source}: means are {saved}, expected sums of a number of values.")
    return RunningMeans(sums, n_values)


def optimizer_tensors(optimizer: th.optim.Optimizer) -> dict[str, th.Tensor]:
    """The state of an optimiser, by the number of the weight and the name of the moment."""
    states = optimizer.state_dict()["state"]
    return {f"{number}.{name}": value for number, state in states.items() for name, value in state.items()}


def optimizer_state(optimizer: th.optim.Optimizer, tensors: Mapping[str, th.Tensor], source: str) -> dict[str, Any]:
    """
    What `load_state_dict` takes. What applies to all weights, as their decay, is the optimiser's own.

    :param optimizer: of the model that is loaded
    :param tensors: of :func:`optimizer_tensors`
    :param source: the file, for messages
    :raises ModelFileError: the state of another optimiser, or numbers that no optimiser arrives at
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    numbers = {name.partition(".")[0] for name in tensors}
    expected = {f"{i}.{name}" for i in range(len(weights)) for name in MOMENTS} if tensors else set()
    if expected != tensors.keys():
        raise ModelFileError(f"{source}: {OPTIMIZER} has states of {len(numbers)} weights, expected {len(weights)}.")
    states: dict[int, dict[str, th.Tensor]] = {}
    for i, weight in enumerate(weights if tensors else ()):
        states[i] = {name: tensors[f"{i}.{name}"] for name in MOMENTS}
        for name, has_shape in MOMENTS.items():
            _check_shape(states[i][name], weight.shape if has_shape else th.Size(), f"{source}: {OPTIMIZER} {i}.{name}")
    _check_finite(tensors, f"{source}: {OPTIMIZER}")
    if any(bool((tensor < 0).any()) for name, tensor in tensors.items() if not name.endswith("exp_avg")):
        raise ModelFileError(f"{source}: {OPTIMIZER} holds negative squares or steps.")
    return {"state": states, "param_groups": optimizer.state_dict()["param_groups"]}


def _check_shape(tensor: th.Tensor, shape: th.Size, what: str) -> None:
    if tensor.shape != shape or tensor.dtype != th.float32:
        raise ModelFileError(f"{what} is {tensor.dtype} of shape {tuple(tensor.shape)}, expected float32 of {tuple(shape)}.")


def _check_finite(tensors: Mapping[str, th.Tensor], what: str) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not th.isfinite(tensor).all():
            raise ModelFileError(f"{what} {name} holds numbers that are not finite.")


def check_policy(policy: SequencePolicy, tensors: Mapping[str, th.Tensor], source: str) -> None:
    """
    Refuse weights and statistics that such a policy cannot have, before any memory is taken for them.

    :param policy: without a moving average, on the device "meta", where tensors are shapes only
    :param tensors: of the file
    :param source: the file, for messages
    :raises ModelFileError: names the tensor
    """
    expected = policy.state_dict()
    if any(name.startswith("ema_") for name in tensors):
        expected |= {f"ema_{name}": value for name, value in expected.items() if name.startswith("network.")}
    for name in expected.keys() ^ tensors.keys():
        problem = "is missing" if name in expected else "belongs to no policy of these settings"
        raise ModelFileError(f"{source}: {POLICY} {name} {problem}.")
    settings = next((name for name in expected if name.endswith("_extra_state")), "")
    for name, tensor in expected.items():
        if name != settings:
            _check_shape(tensors[name], tensor.shape, f"{source}: {POLICY} {name}")
    unlimited = "normalization.return_to_go_range"
    _check_finite({name: tensor for name, tensor in tensors.items() if name != unlimited}, f"{source}: {POLICY}")
    for name in POSITIVE_BUFFERS & tensors.keys():
        if not bool((tensors[name] > 0).all()):
            raise ModelFileError(f"{source}: {POLICY} {name} must be positive.")
    if unlimited in tensors and not bool((tensors[unlimited][0] <= tensors[unlimited][1]).all()):
        raise ModelFileError(f"{source}: {POLICY} {unlimited}: the smallest must not be above the largest.")
