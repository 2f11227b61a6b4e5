"""A model from its file, and the checks that what is in there passes before it is one."""

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch as th
from gymnasium import spaces
from minari.serialization import deserialize_space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule, get_device

from sb3_dtfm.algorithms.saving import ENCODED, OPTIMIZER, POLICY, SPACES, UnsavedSchedule, head_name, optimizers
from sb3_dtfm.arguments import BOOLEAN, COUNT, NOT_NEGATIVE, Number, Rule, check_arguments
from sb3_dtfm.data import ReturnReference, check_action_space
from sb3_dtfm.envs import OBSERVATION, RETURN_TO_GO, TIMESTEP
from sb3_dtfm.files import ModelFileError, file_name, read_model
from sb3_dtfm.optimization import RunningMeans
from sb3_dtfm.policies import SequencePolicy

if TYPE_CHECKING:
    from sb3_dtfm.algorithms.base import OfflineAlgorithm

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineAlgorithm")

WHOLE = Number(low=0, whole=True)
# What the file says of a model beside its arguments, which are checked as when they are given.
COUNTERS: dict[str, Rule] = {
    "num_timesteps": WHOLE,
    "_total_timesteps": WHOLE,
    "_num_timesteps_at_start": WHOLE,
    "_n_updates": WHOLE,
    "n_envs": COUNT,
    "max_timestep": COUNT,
    "time_limit": COUNT._replace(optional=True),
    "_n_left": WHOLE,
    "verbose": WHOLE,
}
# Values of a ReturnReference, in its order.
RETURN_REFERENCE: tuple[Rule, ...] = (
    *(Number(), Number(), Number(), COUNT, BOOLEAN),
    *(Number(low=0, high=1, optional=True), Number(optional=True)),
)
# Of the policy's tensors.
POSITIVE_BUFFERS = {
    "normalization.observation_std",
    "normalization.observation_gain",
    "normalization.return_scale",
    "normalization.return_std",
    "critic.reward_scale",
    "critic.advantage_std",
}
# The optimiser's state of a weight: its own shape, or a number.
MOMENTS = {"step": False, "exp_avg": True, "exp_avg_sq": True}


@contextlib.contextmanager
def wrap_file_errors(source: str) -> Iterator[None]:
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


def from_file(
    algorithm: type[SelfAlgorithm],
    path: str | Path | io.BufferedIOBase,
    device: th.device | str,
    custom_objects: dict[str, Any],
    print_system_info: bool,
    changed: dict[str, Any],
) -> SelfAlgorithm:
    """
    A model of what a file says.

    :param algorithm: the class that is loaded
    :param path: the file
    :param device: of the model
    :param custom_objects: attributes in place of those in the file
    :param print_system_info: print what the file was saved with
    :param changed: attributes that are others from now on
    :raises ModelFileError: the file is damaged, pickled, of another algorithm, or holds what no model can have
    :raises ValueError: a changed attribute out of range
    """
    source = file_name(path)
    configuration, tensors = read_model(path, {POLICY, OPTIMIZER}, get_device(device), print_system_info)
    attributes = from_configuration(algorithm, configuration, custom_objects, source)
    if changed.get("policy_kwargs", attributes.get("policy_kwargs")) != attributes.get("policy_kwargs"):
        raise ValueError(
            f"policy_kwargs are what the weights of {source} were made with, {attributes.get('policy_kwargs')}, and "
            f"cannot be changed: got {changed['policy_kwargs']}."
        )
    model = algorithm(attributes["policy_class"], device=device, _init_setup_model=False)
    if attributes.get("online_actor") is not None and not hasattr(model, "online_actor"):
        raise ModelFileError(
            f"{source} is a fine-tuned DTFM: sb3_dtfm.finetuning.FinetunedDTFM loads it. To go on learning, `sb3-dtfm "
            "finetune -i` takes the agent.zip beside it, and --model the DTFM that it began with."
        )
    vars(model).update(attributes)
    with wrap_file_errors(source):
        check_sizes(model, tensors[POLICY], source)
    vars(model).update(changed)
    model._setup_model()
    with wrap_file_errors(source):
        model.set_parameters(parameters(model.policy, tensors, source), device=device)
    return model


def check_sizes(model: "OfflineAlgorithm", tensors: dict[str, th.Tensor], source: str) -> None:
    """
    See :func:`check_policy`.

    :param model: with the attributes of the file
    :param tensors: the policy's
    :param source: the file, for messages
    :raises ModelFileError: more layers than there are tensors, or others than these settings make
    """
    model._check_arguments(learning_rate=NOT_NEGATIVE)
    for name, value in (model.policy_kwargs or {}).items():
        if name.endswith("n_layers") and isinstance(value, int) and value > len(tensors):
            raise ModelFileError(f"{source}: policy_kwargs say {name}={value}, and there are {len(tensors)} tensors.")
    model._setup_lr_schedule()
    with th.device("meta"):
        check_policy(model._make_policy(ema=False), tensors, source)


def parameters(policy: SequencePolicy, tensors: dict[str, dict[str, th.Tensor]], source: str) -> dict[str, Any]:
    """
    What :meth:`OfflineAlgorithm.set_parameters` takes, from the tensors of a file.

    :raises ModelFileError: see :func:`optimizer_state`
    """
    loaded: dict[str, Any] = {POLICY: tensors[POLICY]}
    states = dict(tensors[OPTIMIZER])
    for name, (optimizer, prefix) in reversed(optimizers(policy).items()):  # all that are not the critic's: the policy's
        own = {key[len(prefix) :]: states.pop(key) for key in list(states) if key.startswith(prefix)}
        loaded[name] = optimizer_state(optimizer, own, source)
    return loaded


def from_configuration(
    algorithm: type[BaseAlgorithm], configuration: Mapping[str, Any], custom_objects: Mapping[str, Any], source: str
) -> dict[str, Any]:
    """
    The attributes of a model from JSON.

    :param algorithm: the class that is loaded
    :param configuration: of :func:`~sb3_dtfm.algorithms.saving.to_configuration`
    :param custom_objects: attributes in place of those in the file
    :param source: the file, for messages
    :raises ModelFileError: something is missing, or not what that writes
    """

    def taken(name: str, kinds: type | tuple[type, ...]) -> Any:
        if not isinstance(configuration.get(name), kinds):
            raise ModelFileError(f"{source}: {name} is {configuration.get(name)!r}, which no model was saved with.")
        return configuration[name]

    saved_by, asked = taken("algorithm", str), head_name(algorithm)
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
    returns: Any = attributes.get("return_reference")
    known = isinstance(returns, list) and len(returns) == len(RETURN_REFERENCE)
    accepted = known and all(rule.accepts(value) for rule, value in zip(RETURN_REFERENCE, returns, strict=True))
    if returns is not None and not accepted:
        raise ModelFileError(f"{source}: return_reference is {returns}, expected {', '.join(ReturnReference._fields)}.")
    with wrap_file_errors(source):
        check_arguments({**dict.fromkeys(COUNTERS, 1), **attributes}, COUNTERS)  # one may have been left out
    observation, action = attributes["observation_space"], attributes["action_space"]
    parts = observation.spaces if isinstance(observation, spaces.Dict) else {}
    is_vector = {name: isinstance(part, spaces.Box) and len(part.shape) == 1 for name, part in parts.items()}
    if is_vector != dict.fromkeys((OBSERVATION, RETURN_TO_GO, TIMESTEP), True):
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


def optimizer_state(optimizer: th.optim.Optimizer, tensors: Mapping[str, th.Tensor], source: str) -> dict[str, Any]:
    """
    What `load_state_dict` takes. What applies to all weights, as their decay, is the optimiser's own.

    :param optimizer: of the model that is loaded
    :param tensors: its own of the file
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
