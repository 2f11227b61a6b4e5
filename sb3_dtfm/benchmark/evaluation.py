"""Evaluation on fixed initial states, during training and at its end."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

# First seeds of the two sets of initial states: apart from each other, and from those of recordings, which count from 0.
TRAINING_STATES = 1_000_000
FINAL_STATES = 2_000_000
PROGRESS_INTERVAL = 0.5  # seconds between two reports of progress


class Episodes(NamedTuple):
    """
    What n episodes came to, in the order of their seeds.

    :param returns: in environment reward units
    :param lengths: in environment steps
    :param successes: None where the task reports none
    """

    returns: list[float]
    lengths: list[int]
    successes: list[bool] | None


class SeededEpisodes(gym.Wrapper):
    """
    Each episode starts from the seed that was set for it.

    A vector environment resets by itself and without a seed; what an episode starts from would then depend on those before.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._seeds: list[int] = []

    def set_episode_seeds(self, seeds: Sequence[int]) -> None:
        """
        :param seeds: of the next episodes; those after them go on without one
        """
        self._seeds = list(seeds)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=self._seeds.pop(0) if self._seeds else seed, options=options)


def evaluate(
    model: BaseAlgorithm, vec_env: VecEnv, seeds: Sequence[int], after_step: Callable[[int], None] | None = None
) -> Episodes:
    """
    One episode from each seed, acting deterministically.

    Environment i plays the episodes i, i + n, i + 2n, ... to their ends: each counts once, however long it is.

    :param model: acts
    :param vec_env: environments in :class:`SeededEpisodes`
    :param seeds: one for each episode
    :param after_step: called with the number of finished episodes after each step
    """
    n_envs, n_episodes = vec_env.num_envs, len(seeds)
    playing = np.arange(n_envs)  # which episode each environment is in
    for i in range(n_envs):
        vec_env.env_method("set_episode_seeds", list(seeds[i::n_envs]), indices=i)
    observations, state, starts = vec_env.reset(), None, np.ones(n_envs, bool)
    returns, lengths = np.zeros(n_envs), np.zeros(n_envs, int)
    results: dict[int, tuple[float, int, Any]] = {}
    while len(results) < n_episodes:
        actions, state = model.predict(observations, state, starts, deterministic=True)  # type: ignore[arg-type]
        observations, rewards, starts, infos = vec_env.step(actions)
        returns, lengths = returns + rewards, lengths + 1
        for i in np.flatnonzero(starts):
            if playing[i] < n_episodes:
                # SB3's name of it, or that of gymnasium-robotics' mazes and hands
                success = infos[i].get("is_success", infos[i].get("success"))
                results[int(playing[i])] = (round(float(returns[i]), 4), int(lengths[i]), success)
            playing[i] += n_envs
        returns[starts], lengths[starts] = 0.0, 0
        if after_step is not None:
            after_step(len(results))
    ordered = [results[episode] for episode in range(n_episodes)]
    successes = [success for _, _, success in ordered]
    return Episodes(
        [each for each, _, _ in ordered],
        [length for _, length, _ in ordered],
        None if any(success is None for success in successes) else [bool(success) for success in successes],
    )


class EvaluationCallback(BaseCallback):
    """
    Evaluate every `eval_freq` gradient steps and, on other initial states, after the last one.

    :param vec_env: environments in :class:`SeededEpisodes`; closed at the end
    :param eval_freq: gradient steps between two evaluations
    :param n_episodes: episodes of each
    :param n_final_episodes: episodes of the evaluation at the end
    :param write: takes what a row says of one evaluation: step, final, wall_s, steps_per_s, solver and the episodes
    :param report_progress: takes gradient steps done and to do, and what is going on; called at most every half second
    """

    def __init__(
        self,
        vec_env: VecEnv,
        eval_freq: int,
        n_episodes: int,
        n_final_episodes: int,
        write: Callable[[dict[str, Any]], None],
        report_progress: Callable[[int, int, str], None],
    ) -> None:
        super().__init__()
        self.vec_env = vec_env
        self.eval_freq = eval_freq
        self.n_episodes = n_episodes
        self.n_final_episodes = n_final_episodes
        self.write = write
        self.report_progress = report_progress
        self._resumed, self._training_seconds, self._reported = 0.0, 0.0, 0.0

    def _on_training_start(self) -> None:
        self._resumed = time.perf_counter()

    def _on_step(self) -> bool:
        self._report("training")
        last = self.num_timesteps == self.model._total_timesteps
        if self.num_timesteps % self.eval_freq == 0:
            self._evaluate(TRAINING_STATES, self.n_episodes, final=False)
        if last:
            self._evaluate(FINAL_STATES, self.n_final_episodes, final=True)
        return True

    def _on_training_end(self) -> None:
        self.vec_env.close()

    def _evaluate(self, first_seed: int, n_episodes: int, final: bool) -> None:
        self._training_seconds += time.perf_counter() - self._resumed
        what = "final evaluation" if final else "evaluation"
        seeds = range(first_seed, first_seed + n_episodes)
        episodes = evaluate(self.model, self.vec_env, seeds, lambda n_done: self._report(f"{what} {n_done}/{n_episodes}"))
        self.write(
            dict(
                step=self.num_timesteps,
                final=final,
                **episodes._asdict(),
                solver=getattr(self.model.policy, "solver", None),
                n_solver_steps=getattr(self.model.policy, "n_solver_steps", None),
                wall_s=round(self._training_seconds, 3),
                steps_per_s=round(self.num_timesteps / self._training_seconds, 3),
            )
        )
        self._resumed = time.perf_counter()

    def _report(self, what: str) -> None:
        if time.monotonic() - self._reported >= PROGRESS_INTERVAL:
            self._reported = time.monotonic()
            self.report_progress(self.num_timesteps, self.model._total_timesteps, what)
