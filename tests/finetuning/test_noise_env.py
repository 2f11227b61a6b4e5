"""The environment whose actions are a frozen policy's noise."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_dtfm import DT, DTFM
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import NoiseActionVecEnv
from tests.algorithms.small import make_model

CHUNKS = dict(chunk_size=4, n_action_steps=3)
# Beyond what a noise table holds: nothing is cut off.
UNBOUNDED = 100.0


class Ends(gym.Wrapper):
    """Episodes of so many steps, which end for good, or by a time limit."""

    def __init__(self, env: gym.Env, length: int, for_good: bool) -> None:
        super().__init__(env)
        self.length, self.for_good, self.n_steps = length, for_good, 0

    def reset(self, **kwargs):
        self.n_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        observation, reward, _, _, info = self.env.step(action)
        self.n_steps += 1
        ended = self.n_steps == self.length
        return observation, reward, ended and self.for_good, ended and not self.for_good, {**info, "is_success": ended}


def make_venv(lengths=(7, 10, 4), for_good=(False, True, False), vec_env_cls=DummyVecEnv):
    """HalfCheetahs whose episodes end at different steps, so that their rows are at different places."""

    def make(length, ends):
        def build():
            env = gym.wrappers.TransformReward(gym.make("HalfCheetah-v5"), float)
            return ReturnToGoWrapper(Ends(env, length, ends), target_return=5.0)

        return build

    venv = vec_env_cls([make(*each) for each in zip(lengths, for_good, strict=True)])
    venv.seed(3)
    return VecMonitor(venv)


@pytest.fixture(params=[{}, CHUNKS, {**CHUNKS, "kv_cache": True}], ids=["single", "chunks", "cached"])
def model(request, cheetah_buffer):
    policy_kwargs = {"return_scaling": "timestep", "observation_scaling": "robust", **request.param}
    return make_model(DTFM, cheetah_buffer, ema_decay=0.9, policy_kwargs=policy_kwargs).learn(5)


def table_noise(policy, context) -> np.ndarray:
    """Noise of `deterministic=True` at a context's newest step."""
    return policy._acting_noise(context.timesteps[:, -1] + context.episode_keys, True).numpy()


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.slow)])
def test_the_models_own_noise_plays_the_models_own_episodes(model, vec_env_cls):
    """Rows end at steps 7, 10 and 4, within a chunk of three and at its end, and go on with their next episodes."""
    expected = {row: [] for row in range(3)}
    plain, state, starts = make_venv(vec_env_cls=vec_env_cls), None, np.ones(3, bool)
    observations = plain.reset()
    for _ in range(40):
        actions, state = model.predict(observations, state, starts, deterministic=True)
        observations, _, starts, infos = plain.step(actions)
        for row, info in enumerate(infos):
            expected[row] += [info["episode"]] if starts[row] else []
    plain.close()

    env = NoiseActionVecEnv(make_venv(vec_env_cls=vec_env_cls), model, bound=UNBOUNDED)
    found, totals = {row: [] for row in range(3)}, np.zeros(3)
    env.reset()
    for _ in range(40):
        _, rewards, dones, infos = env.step(table_noise(model.policy, env._known[0]))
        totals += rewards
        for row in np.flatnonzero(dones):
            found[row].append((totals[row], infos[row]))
            totals[row] = 0.0
    env.close()
    lengths, ends_for_good = (7, 10, 4), (False, True, False)
    for row in range(3):
        assert len(found[row]) >= len(expected[row]) >= 3
        for episode, (total, info) in zip(expected[row], found[row], strict=False):
            assert total == pytest.approx(episode["r"], abs=1e-5)
            assert info["terminal_observation"][-1] == pytest.approx(lengths[row] / model.policy.normalization.max_timestep)
            assert info["TimeLimit.truncated"] is not ends_for_good[row]
            assert info["is_success"]
            assert "observations_between" not in info


def test_the_model_is_left_as_it_is(model):
    before = copy.deepcopy(model.policy.state_dict())
    model.policy.optimizer.zero_grad()
    own_env = make_venv((30,), (False,))
    observation = own_env.reset()
    model.predict(observation)
    env = NoiseActionVecEnv(make_venv(), model)
    env.reset()
    for _ in range(5):
        env.step(np.ones((3, env.action_space.shape[0])))
    assert model.predict(own_env.step(np.zeros((1, 6)))[0])[1][4][0].sum() == 2, "the own context has gone on"
    for name, value in model.policy.state_dict().items():
        th.testing.assert_close(value, before[name], rtol=0, atol=0)
    assert all(parameter.grad is None for parameter in model.policy.parameters())


def test_what_is_shown_is_in_the_units_of_the_data(model):
    plain = make_venv()
    env = NoiseActionVecEnv(make_venv(), model, hidden_state=True)
    shown, raw = env.reset(), plain.reset()
    normalization = model.policy.normalization
    expected = (raw["observation"] - normalization.observation_mean.numpy()) / normalization.observation_std.numpy()
    np.testing.assert_allclose(shown[:, :17], expected.clip(-10, 10), atol=1e-4)
    deviations = (raw["return_to_go"][:, 0] - normalization.return_mean[0].item()) / normalization.return_std[0].item()
    np.testing.assert_allclose(shown[:, 17], deviations.clip(-5, 5) / 4, atol=1e-5)
    np.testing.assert_allclose(shown[:, 18], 0.0)
    assert shown.shape == (3, 17 + 2 + 32)
    assert env.observation_space.contains(shown[0])
    _, hidden = model.policy.encode(raw)
    np.testing.assert_allclose(shown[:, 19:], hidden.numpy(), atol=1e-5)


def test_the_last_observation_of_an_episode_has_its_own_hidden_state(model):
    """A value function starts from it where a time limit ended the episode: as if the episode had gone on."""
    ended = NoiseActionVecEnv(make_venv((7, 10, 4)), model, UNBOUNDED, hidden_state=True)
    going_on = NoiseActionVecEnv(make_venv((70, 70, 70)), model, UNBOUNDED, hidden_state=True)
    noise = np.random.default_rng(0).normal(size=(3, *ended.action_space.shape))
    for env in (ended, going_on):
        env.reset()
    decisions = 7 if model.policy.options.n_action_steps == 1 else 3
    for _ in range(decisions - 1):
        ended.step(noise)
        going_on.step(noise)
    policy, context = model.policy, going_on._known[0]
    _, _, dones, infos = ended.step(noise)
    assert dones[0]
    going_on.step_async(noise)
    observations, _, _, steps = going_on.venv.step_wait()
    if model.policy.options.n_action_steps > 1:  # the seventh step is the first one of the third chunk
        observations = {key: value[:, 0] for key, value in _stacked(steps).items()}
    shown = going_on._show(*policy.encode(observations, going_on._acted))
    np.testing.assert_allclose(infos[0]["terminal_observation"], shown[0], atol=1e-4)
    assert context.timesteps[0, -1] == 6


def _stacked(infos):
    between = [info["observations_between"] for info in infos]
    return {key: np.stack([each[key] for each in between]) for key in between[0]}


def test_a_sample_is_standard_normal_within_the_bound():
    model_env = NoiseActionVecEnv(make_venv(), _tiny(), bound=1.5)
    model_env.action_space.seed(0)
    samples = np.array([model_env.action_space.sample() for _ in range(3000)])
    assert samples.dtype == np.float32
    assert np.abs(samples).max() == 1.5
    assert np.mean(np.abs(samples) < 1) == pytest.approx(0.683, abs=0.02)
    assert np.mean(np.abs(samples) == 1.5) == pytest.approx(0.134, abs=0.02)


def _tiny(algorithm=DTFM, **kwargs):
    episode = dict(observations=np.random.default_rng(0).normal(size=(9, 17)), actions=np.zeros((9, 6)), rewards=np.ones(9))
    return make_model(algorithm, [episode], **kwargs)


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    [
        (SAC, dict(learning_starts=6, batch_size=8)),
        (TD3, dict(learning_starts=6, batch_size=8)),
        (PPO, dict(n_steps=4, batch_size=4, n_epochs=1)),
        (A2C, dict(n_steps=4)),
    ],
)
def test_algorithms_of_stable_baselines3_learn_in_it_unchanged(algorithm, kwargs, model):
    env = NoiseActionVecEnv(make_venv(), model)
    agent = algorithm("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=dict(net_arch=[16]), **kwargs)
    agent.learn(24)
    assert agent.num_timesteps >= 24
    assert agent._n_updates > 0
    assert len(agent.ep_info_buffer) > 0
    returns, _ = evaluate_policy(agent, env, n_eval_episodes=3)
    assert np.isfinite(returns)


def test_an_algorithm_of_sb3_contrib_learns_in_it_unchanged(model):
    from sb3_contrib import TQC

    env = NoiseActionVecEnv(make_venv(), model, hidden_state=True)
    agent = TQC("MlpPolicy", env, device="cpu", learning_starts=6, batch_size=8, policy_kwargs=dict(net_arch=[16])).learn(24)
    assert agent._n_updates > 0


def test_environment_steps_are_counted():
    env = NoiseActionVecEnv(make_venv(), _tiny(policy_kwargs=CHUNKS))
    env.reset()
    for n_steps in (9, 9 + 3 + 3 + 1):  # then the third row's episode ends, at its fourth step
        env.step(np.zeros((3, 24)))
        assert env.n_environment_steps == n_steps


def test_what_has_no_noise_to_choose_is_refused():
    with pytest.raises(ValueError, match=r"DT of Box.* has no flow whose noise could be chosen; a DTFM is needed"):
        NoiseActionVecEnv(make_venv(), _tiny(DT))
    cart = dict(observations=np.zeros((9, 4)), actions=np.array([0, 1] * 4 + [0]), rewards=np.ones(9))
    env = make_vec_env("CartPole-v1", wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=9.0))
    discrete = make_model(DT, [cart], dataset_kwargs=dict(action_space=spaces.Discrete(2)))
    with pytest.raises(ValueError, match=r"DT of Discrete\(2\) has no flow"):
        NoiseActionVecEnv(env, discrete)
    with pytest.raises(ValueError, match=r"The environment has observations of .*, the model's are"):
        NoiseActionVecEnv(env, _tiny())
    with pytest.raises(ValueError, match=r"must be wrapped in sb3_dtfm.envs.ReturnToGoWrapper"):
        NoiseActionVecEnv(make_vec_env("HalfCheetah-v5"), _tiny())
    with pytest.raises(ValueError, match=r"'HalfCheetah-v5', no vectorised environment: write make_vec_env\(env_id"):
        NoiseActionVecEnv("HalfCheetah-v5", _tiny())
    with pytest.raises(ValueError, match="bound must be a number above 0, got -1"):
        NoiseActionVecEnv(make_venv(), _tiny(), bound=-1)
    mean_action = _tiny()
    mean_action.policy.set_acting(flow_steps=1)
    with pytest.raises(ValueError, match=r"flow_steps=1: the model takes its mean action.*set_acting\(flow_steps=3\)"):
        NoiseActionVecEnv(make_venv(), mean_action)
