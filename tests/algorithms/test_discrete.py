"""Discrete actions: DT learns and chooses them, the others refuse them."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import DatasetError, TrajectoryBuffer
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.heads.categorical import CategoricalHead
from tests.algorithms.small import learn_losses, make_model, record_curves
from tests.choices import START, N, Signs, make_env, record


def make_buffer(**kwargs: Any) -> TrajectoryBuffer:
    return TrajectoryBuffer.from_trajectories(record(**kwargs), Signs().action_space, source="signs")


@pytest.fixture(scope="module")
def model() -> DT:
    """Has learned it, from choices of which a tenth is wrong."""
    return make_model(DT, make_buffer(n_episodes=60, error=0.15), env=make_env(), learning_rate=3e-3).learn(150)


@pytest.mark.parametrize(
    "settings", [{}, {"tokens_per_step": 1}, {"kv_cache": True}, {"tokens_per_step": 1, "kv_cache": True}]
)
def test_choices_are_learned_and_made(settings):
    model = make_model(DT, make_buffer(), env=make_env(), learning_rate=3e-3, policy_kwargs=settings)
    losses = learn_losses(model, 60)
    assert losses[0] == pytest.approx(np.log(N), rel=0.5), "of one choice among three"
    assert losses[-1] < 0.2
    mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=2)
    assert mean >= 9.0


def test_what_predict_gives(model):
    env = make_env()
    observation, _ = env.reset(seed=0)
    action, state = model.predict(observation, deterministic=True)
    assert (action.shape, action.dtype) == ((), np.int64)
    assert env.action_space.contains(action)
    assert int(action) == int(observation["observation"][0]) + START + 1
    assert set(np.unique(state[1])) <= {-1.0, 0.0, 1.0}, "vectors in the context"
    rows = {key: np.stack([value] * 4) for key, value in observation.items()}
    actions, _ = model.predict(rows, deterministic=True)
    assert (actions.shape, actions.dtype, np.unique(actions).tolist()) == ((4,), np.int64, [int(action)])
    chosen, *_ = model.policy(model.policy.obs_to_tensor(rows)[0], deterministic=True).tolist()
    assert chosen == int(action)


def test_a_choice_has_the_environments_type():
    space = spaces.Discrete(N, start=START, dtype=np.uint8)
    env = ReturnToGoWrapper(Signs(space), 10.0)
    model = make_model(DT, make_buffer(), env=env)
    assert model.predict(env.reset(seed=0)[0])[0].dtype == np.uint8


def test_choices_are_sampled_as_often_as_they_were_learned(model):
    """And as the seed says."""
    observation = {"observation": [[1.0]] * 2000, "return_to_go": [[8.0]] * 2000, "timestep": [[0]] * 2000}
    rows = {key: np.array(value) for key, value in observation.items()}
    start = np.ones(2000, bool)
    model.set_random_seed(7)
    first, _ = model.predict(rows, episode_start=start)
    again, _ = model.predict(rows, episode_start=start)
    model.set_random_seed(7)
    repeated, _ = model.predict(rows, episode_start=start)
    assert first.tolist() == repeated.tolist() != again.tolist()
    wrong = np.mean(first != START + 2)
    assert 0.03 < wrong < 0.4, "of 0.15 that were"
    best, _ = model.predict(rows, episode_start=start, deterministic=True)
    assert np.unique(best).tolist() == [START + 2]


def test_a_saved_model_chooses_and_learns_as_before(model, tmp_path):
    model.save(tmp_path / "model")
    loaded = DT.load(tmp_path / "model", env=make_env(), dataset=make_buffer())
    assert loaded.action_space == model.action_space
    assert isinstance(loaded.policy.network.head, CategoricalHead)
    observation = DummyVecEnv([make_env] * 3).reset()
    for deterministic in (True, False):
        for each in (model, loaded):
            each.set_random_seed(3)
            each.policy.reset()
        found, expected = (each.predict(observation, deterministic=deterministic)[0] for each in (loaded, model))
        assert found.tolist() == expected.tolist()
    loaded.learn(2, reset_num_timesteps=False)
    assert loaded.num_timesteps == model.num_timesteps + 2


def test_what_is_logged(tmp_path):
    model = make_model(DT, make_buffer(), env=make_env(), ema_decay=0.5)
    curves = record_curves(model)
    model.learn(2, EvalCallback(Monitor(make_env()), eval_freq=2, n_eval_episodes=1, verbose=0), log_interval=1)
    assert {"train/loss", "train/cross_entropy", "train/action_mse", "eval/mean_reward"} <= set(curves.points)
    assert curves.points["train/loss"] == curves.points["train/cross_entropy"]


@pytest.mark.parametrize("with_env", [True, False])
def test_dtfm_refuses_them_and_says_what_learns_them(with_env):
    message = r"DTFM learns vectors of numbers and not Discrete\(3, start=5\); use DT for Discrete actions\."
    with pytest.raises(ValueError, match=message):
        make_model(DTFM, make_buffer(), env=make_env() if with_env else None)


def test_dtfm_refuses_them_before_it_reads_the_data():
    with pytest.raises(ValueError, match="use DT for Discrete actions"):
        make_model(DTFM, "none.npz", env=make_env())


def test_chunks_of_them_are_refused():
    with pytest.raises(ValueError, match=r"chunk_size must be 1 for Discrete\(3, start=5\), whose actions .* got 4"):
        make_model(DT, make_buffer(), policy_kwargs={"chunk_size": 4})


@pytest.mark.parametrize("space", [spaces.Discrete(4, start=START), spaces.Discrete(N), spaces.Box(-1.0, 1.0, (N,))])
def test_data_of_other_choices_than_the_environments_are_refused(space):
    with pytest.raises(DatasetError, match=r"signs holds actions of Discrete\(3, start=5\), the environment's are"):
        make_model(DT, make_buffer(), env=ReturnToGoWrapper(Signs(space), 10.0))


@pytest.mark.parametrize("space", [spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3), spaces.Discrete(1)])
def test_other_spaces_of_choices_are_refused(space):
    message = r"the environment: the action space is .*; only a bounded Box of floats .*or a Discrete of 2 to 65,536 actions"
    with pytest.raises(DatasetError, match=message):
        make_model(DT, make_buffer(), env=ReturnToGoWrapper(Signs(space), 10.0))


def balance(state: np.ndarray) -> int:
    """Keeps CartPole's pole up: against the side that it leans and falls to."""
    return int(3.0 * state[2] + state[3] + 0.1 * state[1] > 0.0)


def cartpole_episodes(n_episodes: int) -> list[dict]:
    """Half of them balanced, half of them not."""
    env, generator, episodes = gym.make("CartPole-v1"), np.random.default_rng(0), []
    for seed in range(n_episodes):
        state, _ = env.reset(seed=seed)
        states, actions, over = [], [], False
        while not over:
            actions.append(balance(state) if seed % 2 else int(generator.integers(2)))
            states.append(state)
            state, _, terminated, truncated, _ = env.step(actions[-1])
            over = terminated or truncated
        ends = {"terminated": terminated, "truncated": truncated}
        episodes.append({"observations": states, "actions": actions, "rewards": [1.0] * len(actions), **ends})
    return episodes


def test_cartpole_is_balanced():
    """As the data's better half does it; the worse one falls after 20 steps."""
    env = DummyVecEnv([lambda: ReturnToGoWrapper(gym.make("CartPole-v1"), target_return=500.0)] * 3)
    model = make_model(
        DT, cartpole_episodes(20), env=env, batch_size=64, context_length=2, learning_rate=3e-3, return_weighting=5.0,
        policy_kwargs={"tokens_per_step": 1, "n_layers": 1, "timestep_embedding": False},
    ).learn(200)  # fmt: skip
    mean, _ = evaluate_policy(model, env, n_eval_episodes=3, warn=False)
    assert mean >= 400.0
