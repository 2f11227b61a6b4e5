"""Recording a trained Stable-Baselines3 agent into a Minari dataset."""

import contextlib
import importlib
import inspect
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.dataset.minari_dataset import parse_dataset_id
from minari.dataset.minari_storage import MinariStorage
from minari.namespace import create_namespace, list_local_namespaces
from minari.storage import get_dataset_path
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_dtfm.envs  # noqa: F401  (registers the tasks)
from sb3_dtfm.data.trajectories import DatasetError, check_action_space
from sb3_dtfm.recording.episodes import ActFunction, RecordedEpisode, check_recording, run_episodes, show_progress

N_RANDOM_EPISODES = 10
# Names RL-Zoo gives to algorithms that differ from their class names.
CLASS_NAMES = {"ppo_lstm": "recurrentppo"}


def record_agent(
    algo: str,
    model_path: str | Path,
    env_id: str,
    n_episodes: int,
    dataset_id: str,
    deterministic: bool = True,
    noise: float = 0.0,
    n_envs: int = 8,
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
    vec_normalize_path: str | Path | None = None,
    env_kwargs: dict[str, Any] | None = None,
    device: str = "cpu",
) -> minari.MinariDataset:
    """
    Run a trained agent and write its episodes as a Minari dataset.

    Each episode has a seed of its own, kept in the file: ``env.reset(seed=...)`` and the recorded actions replay it.
    Every episode that starts is recorded to its end, so that short ones are not over-represented. The dataset appears
    when it is complete. A run repeats with the same arguments; with another `n_envs` the initial states and the
    Gaussian noise stay the same, but the agent's own sampling and the rounding of its network do not.

    The metadata's `ref_min_score` is the mean return of random actions, `ref_max_score` that of the recorded episodes.

    :param algo: name of the agent's class as RL-Zoo spells it: sac, tqc, ppo, ppo_lstm, ...
    :param model_path: the agent's zip file
    :param env_id: Gymnasium id
    :param n_episodes: episodes to record
    :param dataset_id: `namespace/name-vN`, in the folder that MINARI_DATASETS_PATH sets
    :param deterministic: take the agent's most likely action; otherwise sample from its policy
    :param noise: standard deviation of Gaussian noise on the actions, as a share of the action range (high - low);
        the sum is clipped into the action space, and what is recorded is what was executed
    :param n_envs: environments stepped side by side, in this process
    :param seed: seed of initial states, sampled actions and noise
    :param overwrite: replace a dataset of the same id
    :param progress: show a progress bar with the mean return
    :param vec_normalize_path: the agent's VecNormalize statistics; observations are recorded as the environment gives them
    :param env_kwargs: arguments of ``gymnasium.make``
    :param device: where the agent's network runs
    :return: the dataset
    :raises DatasetError: the id is malformed or exists, or the environment's actions are no bounded Box
    :raises FileNotFoundError: no agent or normalisation file
    :raises ValueError: unknown algorithm, numbers out of range, or an agent that does not fit the environment
    """
    check_recording(n_episodes, noise)
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, got {n_envs}.")
    check_dataset_id(dataset_id, overwrite)
    for path in (model_path, vec_normalize_path):
        if path is not None and not Path(path).is_file():
            raise FileNotFoundError(f"{path} does not exist; expected a file that a Stable-Baselines3 agent was saved to.")
    env = gym.make(env_id, **(env_kwargs or {}))
    check_action_space(env.action_space, env_id)
    model = load_agent(algo, model_path, device)
    check_agent_fits(model, env, model_path, env_id)
    envs = [env, *(gym.make(env_id, **(env_kwargs or {})) for _ in range(min(n_envs, n_episodes) - 1))]
    try:
        random_returns = [
            episode.rewards.sum() for episode in run_episodes(envs, random_actions(env, seed), N_RANDOM_EPISODES, seed)
        ]
        set_random_seed(seed)
        act = agent_actions(model, env, deterministic, noise, seed, vec_normalize_path)
        how = "deterministic" if deterministic else "sampled"
        metadata = {
            "algorithm_name": type(model).__name__,
            "description": f"re-recorded from {Path(model_path).name}: {n_episodes} episodes of {env_id}, {how} actions, "
            f"Gaussian noise {noise:g} of the action range, seed {seed}.",
            "ref_min_score": float(np.mean(random_returns)),
            "num_episodes_average_score": n_episodes,
        }
        episodes = show_progress(run_episodes(envs, act, n_episodes, seed), n_episodes, progress)
        with one_thread():
            return write_dataset(dataset_id, episodes, env, metadata)
    finally:
        for each in envs:
            each.close()


def check_dataset_id(dataset_id: str, overwrite: bool) -> None:
    """
    Refuse an id that cannot be written.

    :raises DatasetError: malformed, or there is such a dataset and `overwrite` is not set
    """
    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{dataset_id!r} is no Minari id; expected namespace/name-vN.") from error
    path = get_dataset_path(dataset_id)
    if path.exists() and not overwrite:
        raise DatasetError(f"Minari dataset {dataset_id} exists at {path}; choose another id or allow to overwrite it.")


def find_algorithm(algo: str) -> type[BaseAlgorithm]:
    """
    The class of an agent by its name.

    :param algo: class name in any case, or RL-Zoo's name for it
    :raises ValueError: unknown; names those that are known
    """
    known: dict[str, type[BaseAlgorithm]] = {}
    for module_name in ("stable_baselines3", "sb3_contrib"):
        try:
            module = importlib.import_module(module_name)
        except ImportError:
            continue
        classes = inspect.getmembers(module, lambda member: inspect.isclass(member) and issubclass(member, BaseAlgorithm))
        known.update({name.lower(): cls for name, cls in classes})
    name = CLASS_NAMES.get(algo.lower(), algo.lower())
    if name not in known:
        with contextlib.suppress(ImportError):
            known.update(importlib.import_module("rl_zoo3").ALGOS)
    if name not in known:
        raise ValueError(f"Unknown algorithm {algo!r}; known are {', '.join(sorted(known))}.")
    return known[name]


def load_agent(algo: str, model_path: str | Path, device: str) -> BaseAlgorithm:
    """
    Load an agent to act with.

    What only training needs is left behind: schedules, which may have been pickled by another Python, and the replay buffer.
    """
    algorithm = find_algorithm(algo)
    leave_out = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    kwargs: dict[str, Any] = {"buffer_size": 1} if issubclass(algorithm, OffPolicyAlgorithm) else {}
    return algorithm.load(model_path, device=device, custom_objects=leave_out, **kwargs)


def check_agent_fits(model: BaseAlgorithm, env: gym.Env, model_path: str | Path, env_id: str) -> None:
    """
    Refuse an agent that was trained on another task.

    :raises ValueError: names the spaces of both
    """
    for kind in ("observation_space", "action_space"):
        agent_space, env_space = getattr(model, kind), getattr(env, kind)
        if _shapes(agent_space) != _shapes(env_space):
            raise ValueError(f"{Path(model_path).name} was trained with {kind} {agent_space}, but {env_id} has {env_space}.")


def _shapes(space: spaces.Space) -> Any:
    return {key: part.shape for key, part in space.spaces.items()} if isinstance(space, spaces.Dict) else space.shape


def random_actions(env: gym.Env, seed: int) -> ActFunction:
    """Uniform actions over the action space, the same in an episode however many run beside it."""
    space = env.action_space
    assert isinstance(space, spaces.Box)
    generators: dict[int, np.random.Generator] = {}

    def act(observations: Any, episode_starts: np.ndarray, episodes: list[int]) -> np.ndarray:
        nonlocal generators
        generators = episode_generators(generators, episodes, [seed, 1])
        return np.stack([generators[episode].uniform(space.low, space.high) for episode in episodes]).astype(space.dtype)

    return act


def agent_actions(
    model: BaseAlgorithm,
    env: gym.Env,
    deterministic: bool,
    noise: float,
    seed: int,
    vec_normalize_path: str | Path | None,
) -> ActFunction:
    """The agent's actions with noise, clipped into the action space."""
    space = env.action_space
    assert isinstance(space, spaces.Box)
    normalizer = None
    if vec_normalize_path is not None:
        normalizer = VecNormalize.load(str(vec_normalize_path), DummyVecEnv([lambda: env]))
        normalizer.training = False
    scale = noise * (space.high - space.low)
    generators: dict[int, np.random.Generator] = {}
    state = None

    def act(observations: Any, episode_starts: np.ndarray, episodes: list[int]) -> np.ndarray:
        nonlocal state, generators
        if normalizer is not None:
            observations = normalizer.normalize_obs(observations)
        actions, state = model.predict(observations, state, episode_starts, deterministic)
        if noise > 0.0:
            generators = episode_generators(generators, episodes, [seed, 2])
            actions = actions + scale * np.stack([generators[episode].standard_normal(space.shape) for episode in episodes])
        return np.clip(actions, space.low, space.high).astype(space.dtype)

    return act


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: for a small network and a few rows, several spend their time waiting for one another."""
    n_threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(n_threads)


def episode_generators(
    generators: dict[int, np.random.Generator], episodes: list[int], seed: list[int]
) -> dict[int, np.random.Generator]:
    """The generators of the running episodes: those there are, new ones for new episodes, none for finished ones."""
    return {episode: generators.get(episode) or np.random.default_rng([*seed, episode]) for episode in episodes}


def storable_spec(env: gym.Env) -> EnvSpec | None:
    """The environment's spec if it can be written to a file; the dataset can do without it."""
    if env.spec is None:
        return None
    try:
        env.spec.to_json()
    except (TypeError, ValueError) as error:
        warnings.warn(f"The environment cannot be recovered from the dataset: {error}", stacklevel=2)
        return None
    return env.spec


def write_dataset(
    dataset_id: str, episodes: Iterator[RecordedEpisode], env: gym.Env, metadata: dict[str, Any]
) -> minari.MinariDataset:
    """
    Write episodes as they come into a hidden folder, which takes the dataset's place when it is complete.

    :param dataset_id: `namespace/name-vN`; a dataset that is there is replaced
    :param episodes: at least one
    :param env: gives the spaces and the spec
    :param metadata: entries of the dataset's metadata; `ref_max_score` is added
    """
    target = get_dataset_path(dataset_id)
    namespace = parse_dataset_id(dataset_id)[0]
    staging = Path(tempfile.mkdtemp(prefix=".recording-", dir=get_dataset_path()))
    try:
        (staging / "new").mkdir()
        storage = MinariStorage.new(staging / "new" / "data", env.observation_space, env.action_space, storable_spec(env))
        storage.update_metadata({"dataset_id": dataset_id, "minari_version": minari.__version__})
        returns = []
        for episode in episodes:
            storage.update_episodes([episode.to_buffer()])
            returns.append(episode.rewards.sum())
        storage.update_metadata({**metadata, "ref_max_score": float(np.mean(returns))})
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
        if target.exists():
            target.rename(staging / "old")
        (staging / "new").rename(target)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return minari.MinariDataset(target / "data")
