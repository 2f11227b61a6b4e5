"""A trained agent: its zip file or its RL-Zoo run, what its environment was in training, and whether all of that fits."""

import contextlib
import functools
import importlib
import importlib.util
import inspect
import json
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.algorithms.model import SequenceModel
from sb3_dtfm.algorithms.saving import head_name
from sb3_dtfm.data import check_controller
from sb3_dtfm.envs import channels_first, image_spaces
from sb3_dtfm.files import holds_pickles, read_configuration, read_run
from sb3_dtfm.finetuning import FINETUNED, FinetunedDTFM
from sb3_dtfm.recording.onnx_agent import OnnxAgent

NOT_NORMALIZED = "none"
ONNX = "onnx"


@dataclass(frozen=True)
class AgentFiles:
    """
    Path of an agent, and its environment in training.

    :param model: the agent's zip file
    :param env_kwargs: arguments of ``gymnasium.make``
    :param wrapper: function that wraps an environment as it was wrapped in training; None if it was not
    :param vec_normalize: file of the statistics that its observations were normalised with, where there is one
    :param of_run: whether the agent's run tells if there is such a file
    """

    model: Path
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    wrapper: Callable[[gym.Env], gym.Env] | None = None
    vec_normalize: Path | None = None
    of_run: bool = False


def find_agent(model: str | Path, env_id: str) -> AgentFiles:
    """
    An agent's files, with the settings of its RL-Zoo run if it lies in one.

    A run's YAML files are read as data. Agents of other algorithms and VecNormalize's statistics are pickles, which can run
    code: name those that you trust.

    :param model: zip file, or folder of an RL-Zoo run (`logs/ppo/HalfCheetah-v5_1`), whose last model is taken
    :param env_id: Gymnasium id
    :raises FileNotFoundError: no agent there
    :raises ImportError: RL-Zoo is needed and not installed
    :raises ValueError: the agent was trained on stacked frames or behind a wrapper of vectorised environments
    """
    path, name = Path(model), env_id.rsplit(":", 1)[-1].replace("/", "-")  # RL-Zoo's spelling in files and folders
    if path.is_dir():
        path = path / f"{name}.zip"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; expected a file that a Stable-Baselines3 agent was saved to, or an RL-Zoo run's folder."
        )
    run = path.parent / name
    return _read_run(path, run) if (run / "config.yml").is_file() else AgentFiles(path)


def _read_run(model: Path, run: Path) -> AgentFiles:
    """
    :param run: the folder beside the model that holds config.yml and args.yml
    """
    hyperparams = read_run(run)
    from rl_zoo3.utils import get_wrapper_class  # an extra, which the line above has found

    for key in ("frame_stack", "vec_env_wrapper"):
        if hyperparams.get(key):
            raise ValueError(f"{run / 'config.yml'}: {key} is {hyperparams[key]!r}; agents trained so cannot be recorded.")
    statistics = run / "vecnormalize.pkl" if hyperparams["normalize"] and holds_pickles(model) else None
    return AgentFiles(model, dict(hyperparams["env_kwargs"]), get_wrapper_class(hyperparams), statistics, of_run=True)


def find_wrapper(name: str) -> Callable[[gym.Env], gym.Env]:
    """
    :param name: a class, with its module: `my_tasks.Scaled`
    :raises ValueError: there is none of that name
    """
    module, _, attribute = name.rpartition(".")
    try:
        wrapper: Callable[[gym.Env], gym.Env] = getattr(importlib.import_module(module), attribute)
    except (AttributeError, ImportError, ValueError) as error:
        raise ValueError(
            f"env_wrapper must be a class with its module, such as my_tasks.Scaled, got {name!r}: {error}."
        ) from error
    return wrapper


@functools.cache
def known_algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Ours, Stable-Baselines3's and sb3-contrib's, by the class name in lower case, which is nearly always RL-Zoo's."""
    known: dict[str, type[BaseAlgorithm]] = {**ALGORITHMS, FINETUNED: FinetunedDTFM}
    for module_name in ("stable_baselines3", "sb3_contrib"):
        with contextlib.suppress(ImportError):
            members = inspect.getmembers(importlib.import_module(module_name), inspect.isclass)
            known.update({name.lower(): cls for name, cls in members if issubclass(cls, BaseAlgorithm)})
    if "recurrentppo" in known:
        known["ppo_lstm"] = known["recurrentppo"]
    return known


def algorithm_of(model: str | Path) -> str:
    """
    Return which of our algorithms saved a model, by the folder of RL-Zoo's that it lies in.

    :param model: zip file or run folder, below a folder `dt` or `dtfm`
    :raises ValueError: there is none
    """
    for part in Path(model).parts:
        if part in ALGORITHMS:
            return part
    raise ValueError(f"{model}: of which algorithm? Expected a folder {' or '.join(ALGORITHMS)} in its path, or --algo.")


def load_agent(algo: str, model: str | Path, device: str) -> BaseAlgorithm:
    """
    Load an agent to act with.

    Schedules, which may have been pickled by another Python, and the replay buffer are not loaded: only training needs them.

    :param algo: class name in any case, or RL-Zoo's name for it
    :param model: zip file
    :param device: device of its network
    :raises ValueError: unknown algorithm, no agent, or one of another algorithm
    """
    if algo.lower() not in known_algorithms():
        known = ", ".join(sorted(known_algorithms()))
        more = "" if importlib.util.find_spec("sb3_contrib") else '; sb3-contrib\'s (tqc, ...): pip install "sb3-dtfm[zoo]"'
        raise ValueError(f"Unknown algorithm {algo!r}; known are {known}{more}.")
    algorithm = known_algorithms()[algo.lower()]
    check_saved_by(algorithm, Path(model))
    leave_out = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    kwargs: dict[str, Any] = {"buffer_size": 1} if issubclass(algorithm, OffPolicyAlgorithm) else {}
    return algorithm.load(model, device=device, custom_objects=leave_out, **kwargs)


def check_saved_by(asked: type[BaseAlgorithm], model: Path) -> None:
    """
    Refuse an agent of another algorithm.

    :param asked: class that the agent should have
    :param model: zip file
    :raises ValueError: it is none of this algorithm

    A file of Stable-Baselines3 does not name its class, but it holds the attributes by name, and the policy's module and
    docstring. They are nearest to those of the class that saved them, whichever version that was.
    """
    if not holds_pickles(model):
        configuration = read_configuration(model)
        saved_by = str(configuration.get("algorithm"))
        if not issubclass(asked, SequenceModel) or saved_by != head_name(asked.policy_aliases):
            attributes = configuration.get("attributes")
            finetuned = "Finetuned" if isinstance(attributes, dict) and attributes.get("online_actor") is not None else ""
            raise ValueError(f"{model} was saved by {finetuned}{saved_by}, not by {asked.__name__} (--algo).")
        return
    try:
        with zipfile.ZipFile(model) as file:
            data = json.loads(file.read("data"))
        saved = {*data, data["policy_class"]["__module__"], data["policy_class"].get("__doc__")}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{model} holds no Stable-Baselines3 agent: {error!r}") from error

    def distance(algorithm: type[BaseAlgorithm]) -> int:
        policy = next(iter(algorithm.policy_aliases))
        bare: Any = algorithm(policy, env=None, device="cpu", _init_setup_model=False)  # type: ignore[call-arg]
        return len(saved ^ {*vars(bare), bare.policy_class.__module__, bare.policy_class.__doc__})

    nearest = min(known_algorithms().values(), key=distance)
    if distance(nearest) < distance(asked):
        raise ValueError(f"{model} was saved by {nearest.__name__}, not by {asked.__name__} (--algo).")


def load_fitting_agent(
    algo: str, files: AgentFiles, env: gym.Env, vec_normalize_path: str | Path | None, device: str
) -> tuple[BaseAlgorithm | OnnxAgent, VecNormalize | None]:
    """
    Load an agent for an environment, and what normalises its observations.

    :param algo: class name in any case, or RL-Zoo's name for it, or "onnx"
    :param files: files of the agent
    :param env: environment as the agent sees it
    :param vec_normalize_path: statistics instead of those in `files`, or "none" to insist that there are none
    :param device: device of its network
    :raises FileNotFoundError: no such statistics
    :raises ValueError: agent, statistics and environment do not fit, or statistics are missing
    """
    model = OnnxAgent(files.model) if algo.lower() == ONNX else load_agent(algo, files.model, device)
    for kind in ("observation_space", "action_space"):
        agent_space, env_space = getattr(model, kind), getattr(env, kind)
        if _shapes(agent_space) != _shapes(env_space):
            env_id = env.spec.id if env.spec else env
            raise ValueError(f"{files.model.name} was trained with {kind} {agent_space}, but {env_id} has {env_space}.")
    if isinstance(model, SequenceModel):
        check_controller(model.controller, getattr(env.unwrapped, "env_args", None))
    if vec_normalize_path == NOT_NORMALIZED:
        return model, None
    if vec_normalize_path is None and files.vec_normalize is None:
        if isinstance(model, BaseAlgorithm) and not files.of_run:
            _check_not_normalized(model, files.model)
        return model, None
    return model, _load_vec_normalize(Path(vec_normalize_path or str(files.vec_normalize)), env)


def _shapes(space: spaces.Space) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _shapes(part) for key, part in space.spaces.items()}
    for image in image_spaces(space).values():  # SB3 has moved the channels to the front
        return channels_first(image).shape
    return (space.start, space.n) if isinstance(space, spaces.Discrete) else space.shape


def _load_vec_normalize(path: Path, env: gym.Env) -> VecNormalize:
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected a file that the agent's VecNormalize was saved to.")
    try:
        normalizer = VecNormalize.load(str(path), DummyVecEnv([lambda: env]))
    except Exception as error:  # a pickle can raise anything
        raise ValueError(f"{path}: no VecNormalize for {env.observation_space}: {error!r}") from error
    normalizer.training = False
    return normalizer


def _check_not_normalized(model: BaseAlgorithm, path: Path) -> None:
    """
    Refuse an agent that was trained with VecNormalize, whose statistics are missing.

    The agent's file holds its last observation, and the one before normalisation, which turns float64 into float32. If the
    environment's are float32 already, having the latter means VecNormalize, except for off-policy algorithms, which
    always have it: then this is unknown, and there is a warning.
    """
    seen, original = _dtypes(model._last_obs), _dtypes(model._last_original_obs)
    if not original or (seen == original and np.dtype(np.float32) not in seen):
        return
    how = f"name its statistics (--vec-normalize FILE) or its RL-Zoo run; --vec-normalize {NOT_NORMALIZED} insists on none."
    if seen in ([], original) and isinstance(model, OffPolicyAlgorithm):
        warnings.warn(f"{path.name} does not tell whether it was trained with VecNormalize: if so, {how}", stacklevel=2)
        return
    raise ValueError(f"{path.name} was trained with VecNormalize, and what it sees means nothing to it without: {how}")


def _dtypes(observation: Any) -> list[np.dtype]:
    """Return the type of an array, or of each in a dict; no type for None."""
    parts = observation.values() if isinstance(observation, dict) else [observation]
    return [part.dtype for part in parts if part is not None]
