"""Evaluation counts each initial state once, whatever the number of environments and the lengths of episodes."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm.benchmark.evaluation import EvaluationCallback, SeededEpisodes, evaluate


class Countdown(gym.Env):
    """An episode lasts as many steps as its seed says; reward 2 a step; every second seed succeeds."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, success_key: str | None = "is_success") -> None:
        self.success_key = success_key
        self.left = self.seed = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed = self.left = 1 if seed is None else seed
        return np.array([self.left], np.float32), {}

    def step(self, action):
        self.left -= 1
        info = {self.success_key: self.seed % 2 == 0} if self.success_key else {}
        return np.array([self.left], np.float32), 2.0, self.left == 0, False, info


class Idle:
    """Acts with zeros, and keeps what it was told of starts."""

    def __init__(self) -> None:
        self.starts: list[np.ndarray] = []
        self.deterministic = True

    def predict(self, observations, state=None, episode_start=None, deterministic=False):
        self.starts.append(episode_start.copy())
        self.deterministic &= deterministic
        return np.zeros((len(observations), 1), np.float32), state


def vec_env(n_envs: int, success_key: str | None = "is_success") -> DummyVecEnv:
    return DummyVecEnv([lambda: SeededEpisodes(Countdown(success_key)) for _ in range(n_envs)])


@pytest.mark.parametrize("n_envs", [1, 2, 3, 5, 8])
def test_each_initial_state_counts_once_in_order(n_envs):
    seeds = [5, 1, 9, 2, 1]
    model = Idle()
    episodes = evaluate(model, vec_env(n_envs), seeds)
    assert episodes.lengths == seeds
    assert episodes.returns == [2.0 * seed for seed in seeds]
    assert episodes.successes == [False, False, False, True, False]
    assert model.deterministic
    assert model.starts[0].all()


def test_evaluations_repeat_on_the_same_environments():
    env = vec_env(3)
    seeds = [4, 7, 2, 6]
    assert evaluate(Idle(), env, seeds) == evaluate(Idle(), env, seeds)


def test_a_task_without_success_has_none():
    assert evaluate(Idle(), vec_env(2, success_key=None), [3, 4]).successes is None


def test_success_goes_by_the_name_that_gymnasium_robotics_has_for_it_too():
    assert evaluate(Idle(), vec_env(2, success_key="success"), [3, 4]).successes == [False, True]


def test_evaluations_come_at_a_fixed_interval_and_at_the_end_on_other_states(monkeypatch):
    rows, progress = [], []
    callback = EvaluationCallback(vec_env(2), 3, 2, 4, rows.append, lambda *told: progress.append(told))
    model = Idle()
    model.policy = SimpleNamespace(solver="heun", n_solver_steps=5)
    model._total_timesteps = 7
    callback.model = model
    seen = []

    def short_episodes(model, env, seeds, after_step):
        seen.append(list(seeds))
        return evaluate(model, env, [1] * len(seeds))

    monkeypatch.setattr("sb3_dtfm.benchmark.evaluation.evaluate", short_episodes)
    callback._on_training_start()
    for callback.num_timesteps in range(1, 8):
        assert callback._on_step()
    assert [(row["step"], row["final"], len(row["returns"])) for row in rows] == [(3, False, 2), (6, False, 2), (7, True, 4)]
    assert seen[0] == seen[1]
    assert not set(seen[0]) & set(seen[2])
    assert {(row["solver"], row["n_solver_steps"]) for row in rows} == {("heun", 5)}
    walls = [row["wall_s"] for row in rows]
    assert walls == sorted(walls)
    assert progress[0] == (1, 7, "training")
