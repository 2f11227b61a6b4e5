"""Evaluation counts each initial state once, whatever the number of environments and the lengths of episodes."""

import contextlib
import json
import time
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from rl_zoo3.utils import get_callback_list
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import (
    FINAL_STATES,
    TRAINING_STATES,
    EvaluationCallback,
    SeededEpisodes,
    action_ms,
    evaluate,
    make_seeded_envs,
)
from sb3_dtfm.benchmark.rows import RowError, RunKey, read_rows, write_row
from sb3_dtfm.benchmark.runner import CALLBACK
from sb3_dtfm.envs import ReturnToGoWrapper
from tests.benchmark.conftest import make_row
from tests.conftest import TINY_FLOW_POLICY


class Countdown(gym.Env):
    """An episode lasts as many steps as its seed says; reward 2 a step; every second seed succeeds."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, success_key: str | None = "is_success") -> None:
        self.success_key = success_key
        self.left = self.seed = self.n_steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed = self.left = 1 if seed is None else seed
        return np.array([self.left], np.float32), {}

    def step(self, action):
        self.left -= 1
        self.n_steps += 1
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


def test_environments_that_nobody_waits_for_are_not_stepped():
    """Five environments for three episodes, of which one is far longer than the others."""
    env = vec_env(5)
    assert evaluate(Idle(), env, [2, 90, 3]).lengths == [2, 90, 3]
    assert env.get_attr("n_steps") == [2, 90, 3, 0, 0]


def test_an_environment_that_was_told_no_seeds_is_as_any_other():
    env = vec_env(1)
    env.seed(4)
    env.reset()
    assert [bool(env.step(np.zeros((1, 1)))[2][0]) for _ in range(5)] == [False, False, False, True, True]


def test_evaluations_repeat_on_the_same_environments():
    env = vec_env(3)
    seeds = [4, 7, 2, 6]
    assert evaluate(Idle(), env, seeds) == evaluate(Idle(), env, seeds)


def test_a_task_without_success_has_none():
    assert evaluate(Idle(), vec_env(2, success_key=None), [3, 4]).successes is None


def test_success_goes_by_the_name_that_gymnasium_robotics_has_for_it_too():
    assert evaluate(Idle(), vec_env(2, success_key="success"), [3, 4]).successes == [False, True]


class Slow(Idle):
    """Takes 20 ms for every fourth action, as if it planned four."""

    def predict(self, observations, state=None, episode_start=None, deterministic=False):
        if len(self.starts) % 4 == 0:
            time.sleep(0.02)
        return super().predict(observations["observation"], state, episode_start, deterministic)


def test_an_action_is_timed_in_one_environment_and_on_the_average():
    model = Slow()
    envs = DummyVecEnv([lambda: SeededEpisodes(ReturnToGoWrapper(Countdown(), 0.0)) for _ in range(3)])
    assert 5.0 <= action_ms(model, envs, seed=30) < 10.0
    assert [len(starts) for starts in model.starts] == [1] * 128
    assert np.flatnonzero(np.concatenate(model.starts)).tolist()[:2] == [0, 30], "the first episode is that of the seed"


@pytest.fixture
def row() -> dict[str, Any]:
    """Fields that all rows of a run share: HalfCheetah in episodes of 5 steps."""
    wrapper = {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 5.0}}
    settings = {"env_wrapper": [wrapper], "env_kwargs": {"max_episode_steps": 5}}
    return {**RunKey("HalfCheetah-v5", 1.0, "dtfm", 3, "tiny")._asdict(), "settings": settings, "data": {}}


def make_model(buffer, learning_rate: float = 1e-3) -> DTFM:
    policy_kwargs = dict(TINY_FLOW_POLICY, flow_solver="heun")
    settings = dict(batch_size=4, context_length=3, seed=3, device="cpu", policy_kwargs=policy_kwargs)
    return DTFM("MultiInputPolicy", dataset=buffer, learning_rate=learning_rate, **settings)


def test_rows_come_before_during_and_after_training_and_at_the_end_on_other_states_too(
    tmp_path, row, cheetah_buffer, capsys
):
    file = tmp_path / "rows.jsonl"
    write_row(file, make_row(**{**row, "step": 5}))  # of an attempt that was killed before its first checkpoint
    model = make_model(cheetah_buffer)
    model.learn(7, EvaluationCallback(str(file), row, eval_freq=3, n_episodes=2, n_final_episodes=4, n_envs=2))
    rows = read_rows(file)
    steps = [(0, False, 2), (3, False, 2), (6, False, 2), (7, False, 2), (7, True, 4)]
    assert [(each["step"], each["final"], len(each["returns"])) for each in rows] == steps
    assert {each: rows[0][each] for each in row} == row
    assert {(each["flow_solver"], each["flow_steps"]) for each in rows} == {("heun", 4)}
    assert all(each["lengths"] == [5] * len(each["returns"]) and each["successes"] is None for each in rows)
    assert (rows[0]["steps_per_s"], rows[-1]["hardware"]["gpu"]) == (0.0, None)
    assert [each.get("action_ms", 0.0) > 0.0 for each in rows] == [False] * 4 + [True]
    walls = [each["wall_s"] for each in rows]
    assert walls == sorted(walls)
    assert [sorted(each["data"]) for each in rows] == [[]] * 4 + [["random_return"]]
    # The last two rows are of the same weights, on the states that their seeds give
    envs = make_seeded_envs(row["task"], row["settings"], 1)
    for each, first in ((rows[3], TRAINING_STATES), (rows[4], FINAL_STATES)):
        assert evaluate(model, envs, range(first, first + len(each["returns"]))).returns == each["returns"]
    assert not set(rows[3]["returns"]) & set(rows[4]["returns"])
    assert capsys.readouterr().out.startswith("step 0 of 7: evaluation 0/2\n")


def test_the_first_evaluation_is_of_the_untrained_weights(tmp_path, row, cheetah_buffer):
    untrained = make_model(cheetah_buffer)
    envs = make_seeded_envs(row["task"], row["settings"], 1)
    expected = evaluate(untrained, envs, [TRAINING_STATES])
    callback = EvaluationCallback(str(tmp_path / "rows.jsonl"), row, eval_freq=1, n_episodes=1, n_final_episodes=1)
    make_model(cheetah_buffer, learning_rate=0.1).learn(1, callback)
    rows = read_rows(tmp_path / "rows.jsonl")
    assert rows[0]["returns"] == expected.returns
    assert rows[1]["returns"] != expected.returns


def test_an_interrupted_evaluation_is_repeated(tmp_path, row, cheetah_buffer):
    """At the end of the steps, too, where nothing is left to be trained."""

    class EndedError(Exception):
        pass

    def run(model: DTFM, steps: int, end_at: int | None = None) -> list[tuple[int, bool]]:
        callback = EvaluationCallback(str(tmp_path / "rows.jsonl"), row, eval_freq=2, n_episodes=1, n_final_episodes=2)

        def after_step() -> None:
            if callback.num_timesteps == end_at:
                raise EndedError

        callback.on_evaluation_step = after_step
        with contextlib.suppress(EndedError):
            model.learn(steps, callback, reset_num_timesteps=model.num_timesteps == 0)
        return [(each["step"], each["final"]) for each in read_rows(tmp_path / "rows.jsonl")]

    model = make_model(cheetah_buffer)
    assert run(model, 6, end_at=4) == [(0, False), (2, False)]
    assert run(model, 2, end_at=6) == [(0, False), (2, False), (4, False)]
    assert run(model, 0) == [(0, False), (2, False), (4, False), (6, False), (6, True)]


@pytest.mark.parametrize("content", ["mine\n", "mine", json.dumps(make_row()) + "\n"], ids=["text", "a line", "other rows"])
def test_another_file_is_not_taken_for_rows(content, tmp_path, row, cheetah_buffer):
    other = tmp_path / "other.txt"
    other.write_text(content)
    callback = EvaluationCallback(str(other), row, eval_freq=2, n_episodes=1, n_final_episodes=1)
    with pytest.raises(RowError, match=r"other\.txt.*expected"):
        make_model(cheetah_buffer).learn(1, callback)
    assert other.read_text() == content


def test_evaluating_changes_no_training(tmp_path, row, cheetah_buffer):
    callback = EvaluationCallback(str(tmp_path / "rows.jsonl"), row, eval_freq=2, n_episodes=2, n_final_episodes=2)
    models = make_model(cheetah_buffer).learn(5, callback), make_model(cheetah_buffer).learn(5)
    for evaluated, alone in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(evaluated, alone)


def test_rl_zoo_makes_the_callback_from_plain_data(tmp_path, row):
    arguments = dict(rows=str(tmp_path / "rows.jsonl"), row=row, eval_freq=2, n_episodes=2, n_final_episodes=3)
    text = yaml.safe_dump({"callback": [{CALLBACK: arguments}]})
    (callback,) = get_callback_list(yaml.safe_load(text))
    assert isinstance(callback, EvaluationCallback)
    assert callback.row["settings"] == row["settings"]


class Unseeded(Countdown):
    """Draws its starts from a generator of its own, as Meta-World does."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=int(self.generator.integers(1, 1000)))

    generator = np.random.default_rng(0)


def test_an_environment_that_does_not_start_from_its_seed_is_warned_of_once():
    envs = [SeededEpisodes(Unseeded()) for _ in range(2)]
    for env in envs:
        env.set_episode_seeds([3, 4])
    with pytest.warns(UserWarning, match="start differently, so models are compared from different states"):
        envs[0].reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for env in envs:
            env.reset()
