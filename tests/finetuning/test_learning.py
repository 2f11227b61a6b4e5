"""That noise-space RL learns which of two ways is rewarded, and residual RL what to add where actions fall short."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_dtfm import DTFM
from sb3_dtfm.data import Trajectory
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import FinetunedDTFM, NoiseActionVecEnv, ResidualActionVecEnv

N_STEPS = 2


class Sides(gym.Env):
    """In each of two steps an action is rewarded on the side that the observation's sign names."""

    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self._observe(), {}

    def step(self, action):
        reward = float(action[0] * self.side > 0.5) / N_STEPS
        self.n_steps += 1
        return self._observe(), reward, self.n_steps == N_STEPS, False, {}

    def _observe(self):
        self.side = self.np_random.choice([-1.0, 1.0])
        return np.array([self.side * self.np_random.uniform(0.2, 1.0)], np.float32)


def demonstrations():
    """Actions that go to either side, whatever is seen."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        observations, actions = rng.uniform(-1.0, 1.0, (N_STEPS, 1)), rng.choice([-1.0, 1.0], (N_STEPS, 1))
        yield Trajectory(observations, 0.8 * actions + rng.normal(0, 0.05, (N_STEPS, 1)), np.ones(N_STEPS), True)


def small_flow(data: list[Trajectory], n_steps: int = 400) -> DTFM:
    trunk = dict(embed_dim=16, n_layers=1, n_heads=1, dropout=0.0, tokens_per_step=1, clip_return_to_go=True)
    flow = dict(flow_hidden_dim=32, flow_n_layers=2, flow_steps=5, flow_prediction="action", one_step_policy=False)
    settings = dict(context_length=1, batch_size=64, learning_rate=3e-3, learning_rate_schedule="cosine", seed=0)
    return DTFM("MultiInputPolicy", None, data, device="cpu", policy_kwargs={**trunk, **flow}, **settings).learn(n_steps)


def small_flow_of_two_sides(n_steps: int = 400) -> tuple[DTFM, list[Trajectory]]:
    """A trained flow that goes to either side, and what it learned from."""
    data = list(demonstrations())
    return small_flow(data, n_steps), data


@pytest.mark.slow
def test_sac_finds_the_noise_whose_actions_are_rewarded():
    model, _ = small_flow_of_two_sides()
    make = dict(wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=1.0))
    venv, evaluated = (make_vec_env(Sides, 4, seed=seed, **make) for seed in (0, 1))
    offline, _ = evaluate_policy(model, evaluated, n_eval_episodes=100)
    assert 0.3 < offline < 0.7, "the flow goes to either side"
    learning = dict(learning_starts=200, gradient_steps=4, learning_rate=3e-3, batch_size=64, gamma=0.5, ent_coef=0.01)
    agent = SAC("MlpPolicy", NoiseActionVecEnv(venv, model), seed=0, policy_kwargs=dict(net_arch=[32, 32]), **learning)
    agent.learn(1200)
    finetuned, _ = evaluate_policy(FinetunedDTFM.of(model, agent), evaluated, n_eval_episodes=100)
    assert finetuned > 0.9


class Targets(Sides):
    """An action is rewarded by how near it comes to 0.8 times the observation."""

    def step(self, action):
        target = 0.8 * self.shown
        observation, _, terminated, truncated, info = super().step(action)
        return observation, 1.0 - abs(action[0] - target), terminated, truncated, info

    def _observe(self):
        observation = super()._observe()
        self.shown = observation[0]
        return observation


@pytest.mark.slow
def test_ppo_adds_what_the_demonstrations_fall_short_of():
    """They go half as far. Imitated, they lose 0.24 of each step's 1 (|x| of 0.6 on average), and no noise leads further."""
    rng = np.random.default_rng(0)
    seen = rng.uniform(-1.0, 1.0, (200, N_STEPS, 1))
    model = small_flow([Trajectory(x, 0.4 * x + rng.normal(0, 0.02, x.shape), np.ones(N_STEPS), True) for x in seen])
    make = dict(wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=1.0))
    venv, evaluated = (make_vec_env(Targets, 4, seed=seed, **make) for seed in (0, 1))
    offline, _ = evaluate_policy(model, evaluated, n_eval_episodes=100)
    assert offline == pytest.approx(2 * (1.0 - 0.24), abs=0.1)
    policy_kwargs = dict(log_std_init=-2.0, net_arch=[32, 32])
    learning = dict(n_steps=128, batch_size=128, learning_rate=3e-3, gamma=0.5, policy_kwargs=policy_kwargs)
    agent = PPO("MlpPolicy", ResidualActionVecEnv(venv, model), seed=0, device="cpu", **learning).learn(10_000)
    residual, _ = evaluate_policy(FinetunedDTFM.of(model, agent), evaluated, n_eval_episodes=100)
    assert residual > 2 * 0.93
