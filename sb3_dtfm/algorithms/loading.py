"""Content of a model's file, as plain data, each checked before it is used."""

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch as th
from gymnasium import spaces
from minari.serialization import deserialize_space
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule

from sb3_dtfm.algorithms.saved_options import STRUCTURED, check_structured
from sb3_dtfm.algorithms.saving import (
    ENCODED,
    EXTRACTOR_KWARGS,
    OPTIMIZER,
    POLICY,
    SPACES,
    WEIGHTS,
    UnsavedSchedule,
    head_name,
    optimizers,
)
from sb3_dtfm.arguments import BOOLEAN, COUNT, NOT_NEGATIVE, Choice, Number, Rule, check_arguments
from sb3_dtfm.data import ReturnReference, check_action_space
from sb3_dtfm.envs import OBSERVATION, RETURN_TO_GO, TIMESTEP, image_spaces
from sb3_dtfm.files import ModelFileError, file_name, read_model
from sb3_dtfm.optimization import RunningMeans
from sb3_dtfm.policies import SequencePolicy

WHOLE = Number(low=0, high=2**63, whole=True)
# Attributes of a model beside its arguments, which are checked as when they are given.
SAVED: dict[str, Rule] = {
    "num_timesteps": WHOLE,
    "_total_timesteps": WHOLE,
    "_num_timesteps_at_start": WHOLE,
    "_n_updates": WHOLE,
    "_episode_num": WHOLE,
    "_n_left": WHOLE,
    "n_episodes": Number(low=1, high=2**31, whole=True),
    "gradient_steps": Number(low=1, high=2**31, whole=True),
    "start_time": NOT_NEGATIVE,
    "n_envs": Number(low=1, high=2**16, whole=True),
    "max_timestep": COUNT,
    "time_limit": COUNT._replace(optional=True),
    "verbose": Choice((0, 1, 2)),
    "use_sde": Choice((False,)),
    "sde_sample_freq": Choice((-1,)),
    "_stats_window_size": Number(low=1, high=2**20, whole=True),
    "_current_progress_remaining": Number(low=0, high=1),
    "_current_learning_rate": NOT_NEGATIVE,
    "_training_seed": Number(low=0, high=2**64, below_high=True, whole=True, optional=True),
}
# Values of a ReturnReference, in its order.
RETURN_REFERENCE: tuple[Rule, ...] = (
    *(Number(), Number(), Number(), COUNT, BOOLEAN),
    *(Number(low=0, high=1, optional=True), Number(optional=True)),
)
# Scales and deviations among the policy's tensors.
POSITIVE_BUFFERS = {
    "normalization.observation_std",
    "normalization.return_scale",
    "normalization.return_std",
    "critic.reward_scale",
    "critic.advantage_std",
}
# State that the optimiser keeps of a weight, and whether it has the weight's shape or is a number.
MOMENTS = {"step": False, "exp_avg": True, "exp_avg_sq": True}


class SavedModel(NamedTuple):
    """
    :param attributes: attributes of the model, by name
    :param tensors: tensors of policy and optimiser, by name
    :param source: the file, for messages
    """

    attributes: dict[str, Any]
    tensors: dict[str, dict[str, th.Tensor]]
    source: str


@contextlib.contextmanager
def wrap_file_errors(source: str) -> Iterator[None]:
    """
    Turn errors about values that do not fit into errors of the file.

    :raises ModelFileError: such an error, with the name of the file
    """
    try:
        yield
    except ModelFileError:
        raise
    except (TypeError, ValueError, AttributeError, RuntimeError, OverflowError) as error:
        raise ModelFileError(f"{source}: {error}") from error


def parameters(policy: SequencePolicy, tensors: dict[str, dict[str, th.Tensor]], source: str) -> dict[str, Any]:
    """
    Return the tensors of a file in the form that an algorithm's `set_parameters` takes.

    :raises ModelFileError: see :func:`optimizer_state`
    """
    loaded: dict[str, Any] = {POLICY: tensors[POLICY]}
    states = dict(tensors[OPTIMIZER])
    for name, (optimizer, prefix) in reversed(optimizers(policy).items()):  # all that are not the critic's: the policy's
        own = {key[len(prefix) :]: states.pop(key) for key in list(states) if key.startswith(prefix)}
        loaded[name] = optimizer_state(optimizer, own, source)
    return loaded


def read_saved(
    path: str | Path | io.BufferedIOBase,
    policies: Mapping[str, type[BasePolicy]],
    custom_objects: Mapping[str, Any],
    device: th.device,
    print_system_info: bool,
) -> SavedModel:
    """
    A file's description of a model: plain data, each checked by its own rule.

    :param path: file to read
    :param policies: policy classes of the algorithm, by alias
    :param custom_objects: attributes in place of those in the file
    :param device: device of the tensors
    :param print_system_info: whether to print the system info that the file holds, as in SB3
    :raises ModelFileError: something is missing, of another algorithm, or not what a model was saved with
    """
    source = file_name(path)
    configuration, tensors = read_model(path, {POLICY, OPTIMIZER}, device, print_system_info)

    def taken(name: str, kinds: type | tuple[type, ...]) -> Any:
        if not isinstance(configuration.get(name), kinds):
            raise ModelFileError(f"{source}: {name} is {configuration.get(name)!r}, which no model was saved with.")
        return configuration[name]

    saved_by, asked = taken("algorithm", str), head_name(policies)
    if saved_by != asked:
        raise ModelFileError(f"{source} was saved by {saved_by!r}, not by {asked}.")
    attributes = dict(taken("attributes", dict))
    for name in ENCODED & attributes.keys():
        raise ModelFileError(f"{source}: {name} is no attribute that a model is saved with.")
    attributes.update({name: _space(taken(name, str), f"{source}: {name}") for name in SPACES})
    attributes["_means"] = _to_means(taken("means", dict), source)
    attributes["learning_rate"] = _to_learning_rate(taken("learning_rate", (int, float, str, dict)), source)
    if "policy_class" not in custom_objects:
        attributes["policy_class"] = _policy_class(policies, taken("policy_class", str), source)
    with wrap_file_errors(source):
        for name in STRUCTURED:
            check_structured(name, attributes.get(name))
    attributes.update({name: each for name, each in custom_objects.items() if name in {*attributes, *ENCODED}})
    _check_attributes(attributes, source)
    return SavedModel(attributes, tensors, source)


def _policy_class(policies: Mapping[str, type[BasePolicy]], name: str, source: str) -> type[BasePolicy]:
    if name not in policies:
        raise ModelFileError(
            f"{source}: its policy is a {name}, a class that a file does not hold; "
            f"give it, load(path, custom_objects={{'policy_class': {name}}})."
        )
    return policies[name]


def _check_attributes(attributes: Mapping[str, Any], source: str) -> None:
    """Check the attributes that are not arguments."""
    if not isinstance(attributes.get("policy_kwargs", {}), dict):
        raise ModelFileError(f"{source}: policy_kwargs are {attributes['policy_kwargs']!r}, expected arguments by name.")
    extractor = attributes.get("policy_kwargs", {}).get(EXTRACTOR_KWARGS)
    if isinstance(extractor, dict) and WEIGHTS in extractor:
        raise ModelFileError(f"{source}: {EXTRACTOR_KWARGS} name a file of {WEIGHTS}, which no saved model needs.")
    reference: Any = attributes.get("score_reference")
    kinds = [type(each) for each in reference] if isinstance(reference, list) else reference
    if kinds not in (None, [float, float, str]) or (reference and not reference[0] < reference[1]):
        raise ModelFileError(f"{source}: score_reference is {reference}, expected two returns and where they come from.")
    returns: Any = attributes.get("return_reference")
    known = isinstance(returns, list) and len(returns) == len(RETURN_REFERENCE)
    accepted = known and all(rule.accepts(value) for rule, value in zip(RETURN_REFERENCE, returns, strict=True))
    if returns is not None and not accepted:
        raise ModelFileError(f"{source}: return_reference is {returns}, expected {', '.join(ReturnReference._fields)}.")
    if not isinstance(actor := attributes.get("online_actor"), dict | None):
        raise ModelFileError(f"{source}: online_actor is {actor!r:.40}, expected its settings, or None.")
    with wrap_file_errors(source):
        check_arguments(attributes, {name: rule for name, rule in SAVED.items() if name in attributes})
    observation, action = attributes["observation_space"], attributes["action_space"]
    parts = observation.spaces if isinstance(observation, spaces.Dict) else {}
    shapes = {name: part.shape for name, part in parts.items() if isinstance(part, spaces.Box)}
    vectors = {name for name in shapes if len(shapes[name]) == 1}
    if vectors != {OBSERVATION, RETURN_TO_GO, TIMESTEP} or len(parts) != len(vectors) + len(image_spaces(observation)):
        raise ModelFileError(f"{source}: observation_space is {observation}, not what a ReturnToGoWrapper observes.")
    with wrap_file_errors(source):
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
        if not NOT_NEGATIVE.accepts(saved):
            raise ModelFileError(f"{source}: learning_rate must be {NOT_NEGATIVE}, got {saved!r:.40}.")
        return float(saved)
    accepted = {"start": NOT_NEGATIVE, "end": NOT_NEGATIVE, "end_fraction": Number(low=0, high=1, above_low=True)}
    if saved.keys() != accepted.keys() or not all(rule.accepts(saved[name]) for name, rule in accepted.items()):
        raise ModelFileError(f"{source}: learning_rate is {saved}, expected start, end and end_fraction.")
    return LinearSchedule(**{name: float(value) for name, value in saved.items()})


def _to_means(saved: dict[str, Any], source: str) -> RunningMeans:
    n_values, sums = saved.get("n_values", -1), saved.get("sums")
    named = isinstance(sums, dict) and all(map(str.isidentifier, sums))
    numbers = sums.values() if isinstance(sums, dict) and named else [None]
    if not WHOLE.accepts(n_values) or not all(map(Number().accepts, numbers)) or bool(n_values) != bool(sums):
        raise ModelFileError(f"{source}: means are {saved}, expected sums of a number of values, by their names.")
    return RunningMeans(sums, n_values)


def optimizer_state(optimizer: th.optim.Optimizer, tensors: Mapping[str, th.Tensor], source: str) -> dict[str, Any]:
    """
    Return the state that `load_state_dict` takes. Settings of all weights, such as their decay, are the optimiser's own.

    :param optimizer: optimiser of the model that is loaded
    :param tensors: the optimiser's tensors in the file
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

    :param policy: policy without a moving average, on the device "meta", where tensors are shapes only
    :param tensors: the policy's tensors in the file
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
    if bool((tensors["normalization.observation_gain"] < 0).any()):
        raise ModelFileError(f"{source}: {POLICY} normalization.observation_gain must not be negative.")
    if unlimited in tensors and not bool((tensors[unlimited][0] <= tensors[unlimited][1]).all()):
        raise ModelFileError(f"{source}: {POLICY} {unlimited}: the smallest must not be above the largest.")
