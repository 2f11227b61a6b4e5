"""Recording a trained Stable-Baselines3 agent into a Minari dataset."""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize
from tqdm import tqdm

from sb3_dtfm.data.trajectories import check_action_space
from sb3_dtfm.envs import RenderWrapper, register_gymnasium_robotics, warn_of_reward
from sb3_dtfm.envs.cameras import STATE
from sb3_dtfm.envs.seeding import warn_of_seeds
from sb3_dtfm.recording.episodes import (
    ActFunction,
    EpisodeRecorder,
    RecordedEpisode,
    add_noise,
    check_recording,
    run_episodes,
)
from sb3_dtfm.recording.loading import find_agent, find_wrapper, load_fitting_agent
from sb3_dtfm.recording.minari import check_dataset_id, write_minari
from sb3_dtfm.recording.onnx_agent import OnnxAgent

N_RANDOM_EPISODES = 10


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
    env_wrapper: str | None = None,
    picture_size: int | None = None,
) -> minari.MinariDataset:
    """
    Run a trained agent and write its episodes as a Minari dataset.

    Each episode has a seed of its own, kept in the file: ``env.reset(seed=...)`` and the recorded actions replay it.
    Every episode that starts is recorded to its end, so that short ones are not over-represented. The dataset appears
    when it is complete. A run repeats with the same arguments; with another `n_envs` the initial states and the
    Gaussian noise stay the same, but the agent's own sampling and the rounding of its network do not.

    The agent sees what it was trained on: an RL-Zoo run brings its environment arguments, wrappers and VecNormalize
    statistics (see :func:`~sb3_dtfm.recording.loading.find_agent`). The recording holds the environment's own observations,
    actions and rewards, neither wrapped nor normalised.

    The metadata's `ref_min_score` is the mean return of random actions, `ref_max_score` that of the recorded episodes.

    :param algo: name of the agent's class as RL-Zoo spells it: sac, tqc, ppo, ppo_lstm, ..., or onnx, for a file with one
        input (N, O) and an output (N, A)
    :param model_path: the agent's zip or ONNX file, or the folder of its RL-Zoo run
    :param env_id: Gymnasium id
    :param n_episodes: episodes to record
    :param dataset_id: `namespace/name-vN`, in the folder that MINARI_DATASETS_PATH sets
    :param deterministic: take the agent's most likely action; otherwise sample from its policy
    :param noise: standard deviation of Gaussian noise on the actions, as a share of the action range (high - low);
        the sum is clipped into the action space, and what is recorded is what was executed. Discrete actions have none
    :param n_envs: environments stepped side by side, in this process
    :param seed: seed of initial states, sampled actions and noise
    :param overwrite: replace a dataset of the same id
    :param progress: show a progress bar with the mean return
    :param vec_normalize_path: the agent's VecNormalize statistics, a pickle file, which can run code; those of its run by
        default, and "none" insists that it has none
    :param env_kwargs: arguments of ``gymnasium.make``, beside those of the agent's run
    :param device: device of the agent's network
    :param env_wrapper: class, with its module, of the wrapper that the agent sees the environment through; that of its run
        by default
    :param picture_size: record what the environment renders, too, as :class:`~sb3_dtfm.envs.RenderWrapper` shows it in this
        height and width, pixels; the agent sees nothing of it
    :return: the dataset
    :raises DatasetError: the id is malformed or exists, or the environment's actions are neither a bounded Box nor
        Discrete
    :raises FileNotFoundError: no agent or normalisation file
    :raises ValueError: unknown algorithm, numbers out of range, an agent of another algorithm or that does not fit the
        environment, or one that needs VecNormalize without its statistics
    """
    check_recording(n_episodes, noise, seed)
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, got {n_envs}.")
    check_dataset_id(dataset_id, overwrite)
    register_gymnasium_robotics()
    files = find_agent(model_path, env_id)
    make_kwargs = {**files.env_kwargs, **(env_kwargs or {})}
    recorders = [EpisodeRecorder(_make(env_id, make_kwargs, picture_size)) for _ in range(min(n_envs, n_episodes))]
    wrapper = find_wrapper(env_wrapper) if env_wrapper else files.wrapper
    envs: list[gym.Env] = [each if picture_size is None else _without_picture(each) for each in recorders]
    envs = [wrapper(env) for env in envs] if wrapper else envs
    try:
        check_action_space(recorders[0].action_space, env_id)
        warn_of_reward(recorders[0])
        warn_of_seeds(recorders[0], "the recorded seeds do not replay its episodes")
        space = check_action_space(envs[0].action_space, f"{env_id}, as {files.model.name} sees it")
        model, normalizer = load_fitting_agent(algo, files, envs[0], vec_normalize_path, device)
        act = agent_actions(model, normalizer, deterministic)
        act = add_noise(act, space, noise, lambda episode: np.random.default_rng([seed, 2, episode]))
        random = run_episodes(recorders, random_actions(recorders[0], seed), episode_seeds(seed, N_RANDOM_EPISODES))
        random_returns = [np.sum(episode.rewards) for episode in random]
        how = f"{'deterministic' if deterministic else 'sampled'} actions"
        how += f", Gaussian noise {noise:g} of the action range" if isinstance(space, spaces.Box) else ""
        metadata = {
            "algorithm_name": type(model).__name__,
            "description": f"re-recorded from {files.model.name}: {n_episodes} episodes of {env_id}, {how}, seed {seed}.",
            "ref_min_score": float(np.mean(random_returns)),
            "num_episodes_average_score": n_episodes,
        }
        set_random_seed(seed)
        episodes = run_episodes(envs, act, episode_seeds(seed, n_episodes))
        with one_thread():
            return write_minari(dataset_id, show_progress(episodes, n_episodes, progress), recorders[0].env, metadata)
    finally:
        for env in envs:
            env.close()


def _make(env_id: str, kwargs: dict[str, Any], picture_size: int | None) -> gym.Env:
    if picture_size is None:
        return gym.make(env_id, **kwargs)
    return RenderWrapper(gym.make(env_id, **{"render_mode": "rgb_array", **kwargs}), picture_size)


def _without_picture(recorder: EpisodeRecorder) -> gym.Env:
    """Return what stands around a recorder, as if the environment inside were not rendered."""
    space = recorder.env.get_wrapper_attr("env").observation_space
    in_dict = isinstance(space, spaces.Dict)
    return TransformObservation(recorder, lambda seen: {key: seen[key] for key in space} if in_dict else seen[STATE], space)


def episode_seeds(seed: int, n_episodes: int) -> list[int]:
    """Seeds of the environments, (n_episodes,)."""
    return [int(number) for number in np.random.default_rng(seed).integers(2**31, size=n_episodes)]


def random_actions(env: gym.Env, seed: int) -> ActFunction:
    """Uniform actions over the action space, the same in an episode however many run beside it."""
    space = env.action_space
    generator = functools.cache(lambda episode: np.random.default_rng([seed, 1, episode]))

    def draw(number: int) -> np.ndarray:
        if isinstance(space, spaces.Discrete):
            return np.asarray(space.start + generator(number).integers(space.n))
        assert isinstance(space, spaces.Box)
        return generator(number).uniform(space.low, space.high)

    def act(observations: Any, starts: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
        return np.stack([draw(number) for number in numbers]).astype(space.dtype)

    return act


def agent_actions(model: BaseAlgorithm | OnnxAgent, normalizer: VecNormalize | None, deterministic: bool) -> ActFunction:
    """The agent's actions, with its memory if it has one."""
    state = None

    def act(observations: Any, starts: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
        nonlocal state
        if normalizer is not None:
            observations = normalizer.normalize_obs(observations)
        actions, state = model.predict(observations, state, starts, deterministic)
        return actions

    return act


def show_progress(episodes: Iterator[RecordedEpisode], n_episodes: int, progress: bool) -> Iterator[RecordedEpisode]:
    """Pass episodes on under a progress bar with their mean return, and the share of successes where that is told."""
    total_return, n_successes = 0.0, 0
    with tqdm(total=n_episodes, unit="episode", disable=not progress) as bar:
        for number, episode in enumerate(episodes, start=1):
            total_return += sum(episode.rewards)
            shown = {"mean_return": f"{total_return / number:.1f}"}
            if episode.success is not None:
                n_successes += episode.success
                shown["success"] = f"{n_successes / number:.0%}"
            bar.set_postfix(shown, refresh=False)
            bar.update()
            yield episode


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: for a small network and a few rows, several spend their time waiting for one another."""
    n_threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(n_threads)
