"""Residual RL: actions that are added to a frozen policy's."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC

from sb3_dtfm import DT, DTFM
from sb3_dtfm.finetuning import FinetunedDTFM, NoiseActionVecEnv, ResidualActionVecEnv
from sb3_dtfm.policies.exported import ExportedPolicy
from tests.algorithms.small import make_model
from tests.finetuning.test_noise_env import CHUNKS, make_venv

OFF_POLICY = dict(learning_starts=6, batch_size=8)
ON_POLICY = dict(n_steps=4)
QUICK = {SAC: OFF_POLICY, PPO: dict(**ON_POLICY, batch_size=4, n_epochs=1), A2C: ON_POLICY}


SCALING = {"return_scaling": "timestep", "observation_scaling": "robust"}
CASES = {"single": SCALING, "plans": {**CHUNKS, "n_action_steps": 1}, "cached": {"kv_cache": True}}


@pytest.fixture(scope="module", params=list(CASES.values()), ids=list(CASES))
def model(request, cheetah_buffer):
    return make_model(DTFM, cheetah_buffer, ema_decay=0.9, policy_kwargs=request.param).learn(5)


def make_agent(model, algorithm=PPO, hidden_state=False):
    env = ResidualActionVecEnv(make_venv(), model, bound=0.3, hidden_state=hidden_state)
    return algorithm("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=dict(net_arch=[16, 8]), **QUICK[algorithm])


def play(model, n_steps=40):
    """Returns of the episodes that a model plays, by row."""
    venv, state, starts = make_venv(), None, np.ones(3, bool)
    observations, returns = venv.reset(), [[], [], []]
    for _ in range(n_steps):
        actions, state = model.predict(observations, state, starts, deterministic=True)
        observations, _, starts, infos = venv.step(actions)
        for row in np.flatnonzero(starts):
            returns[row].append(infos[row]["episode"]["r"])
    return returns


def play_residual(env, choose, n_steps=40):
    """The same in the wrapper, whose rewards are in units of its own."""
    shown, totals, returns = env.reset(), np.zeros(3), [[], [], []]
    for _ in range(n_steps):
        shown, rewards, dones, infos = env.step(choose(shown))
        totals += rewards * env.reward_unit
        for row in np.flatnonzero(dones):
            assert totals[row] == pytest.approx(infos[row]["episode"]["r"], abs=1e-5)
            returns[row].append(totals[row])
            totals[row] = 0.0
    return returns


def test_no_residual_plays_the_models_own_episodes(model):
    expected = play(model)
    found = play_residual(ResidualActionVecEnv(make_venv(), model), lambda shown: np.zeros((3, 6), np.float32))
    for ours, theirs in zip(found, expected, strict=True):
        assert len(ours) >= 3
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_a_residual_is_added_to_the_action_that_is_shown(model):
    """Within the actions' range, and the context is told what was carried out."""
    env = ResidualActionVecEnv(make_venv(), model, bound=0.8, hidden_state=True)
    shown, raw = env.reset(), make_venv().reset()
    own, _ = model.predict(raw, episode_start=np.ones(3, bool), deterministic=True)
    assert shown.shape == (3, *env.observation_space.shape) == (3, 17 + 2 + 32 + 6)
    np.testing.assert_allclose(shown[:, -6:], own, atol=1e-5)
    residual = np.full((3, 6), 0.8, np.float32)
    env.step(residual)
    carried_out = env._known[0].actions[:, -2]
    np.testing.assert_allclose(carried_out, np.clip(own + 0.8, -1.0, 1.0), atol=1e-5)
    assert (carried_out == 1.0).any()


def test_the_last_observation_of_an_episode_has_an_action_of_its_own(model):
    """A value function starts from it where a time limit ended the episode."""
    ended, going_on = (ResidualActionVecEnv(make_venv(lengths), model) for lengths in ((7, 10, 4), (70, 70, 70)))
    residual = 0.1 * np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    for env in (ended, going_on):
        env.reset()
    for _ in range(7):
        _, _, dones, infos = ended.step(residual)
        shown, *_ = going_on.step(residual)
    assert dones.tolist() == [True, False, False]
    np.testing.assert_allclose(infos[0]["terminal_observation"], shown[0], atol=1e-4)


def test_a_reward_is_told_in_what_ten_steps_of_the_largest_return_bring():
    """In absolute numbers; the longest episode has nine steps."""
    episodes = [
        dict(observations=np.random.default_rng(0).normal(size=(9, 17)), actions=np.zeros((9, 6)), rewards=np.full(9, each))
        for each in (1.0, -100.0)
    ]
    env, plain = ResidualActionVecEnv(make_venv(), make_model(DTFM, episodes)), make_venv()
    assert env.reward_unit == pytest.approx(1000.0)
    env.reset()
    plain.reset()
    _, rewards, _, _ = env.step(np.zeros((3, 6)))
    _, expected, _, _ = plain.step(env._known[0].actions[:, -2])
    np.testing.assert_allclose(1000.0 * rewards, expected, rtol=1e-4)


@pytest.mark.parametrize(("algorithm", "hidden_state"), [(PPO, False), (PPO, True), (A2C, False), (SAC, True)])
def test_a_residual_model_plays_what_the_actors_mean_plays_in_the_wrapper(model, algorithm, hidden_state):
    agent = make_agent(model, algorithm, hidden_state).learn(30)
    if algorithm is not SAC:
        agent.policy.action_net.bias.data[:2] = th.tensor([1.0, -1.0])  # beyond the bound
    residual = FinetunedDTFM.of(model, agent)
    env = ResidualActionVecEnv(make_venv(), model, bound=0.3, hidden_state=hidden_state)
    found = play_residual(env, lambda shown: agent.predict(shown, deterministic=True)[0])
    for ours, theirs in zip(found, play(residual), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert play(residual) != play(model)


def test_a_file_holds_both(model, tmp_path):
    residual = FinetunedDTFM.of(model, make_agent(model).learn(30))
    residual.save(tmp_path / "residual")
    loaded = FinetunedDTFM.load(tmp_path / "residual")
    assert loaded.online_actor["residual"]
    assert play(loaded, 10) == play(residual, 10)


@pytest.mark.slow
def test_an_exported_file_acts_as_the_residual_model_does(model, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    from sb3_dtfm.cli.main import main

    residual = FinetunedDTFM.of(model, make_agent(model).learn(30))
    residual.save(tmp_path / "residual")
    assert main(["export", str(tmp_path / "residual.zip"), "-o", str(tmp_path / "residual.onnx")]) == 0
    exported = ExportedPolicy(residual.policy)
    inputs = exported.example(3)
    session = onnxruntime.InferenceSession(tmp_path / "residual.onnx")
    found = session.run(["chunk"], {name: each.numpy() for name, each in inputs.items()})[0]
    expected, plain = exported(**inputs)[0], ExportedPolicy(model.policy)(**inputs)[0]
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-4)
    assert (expected[:, 0] - plain[:, 0]).abs().max() > 1e-4
    th.testing.assert_close(expected[:, 1:], plain[:, 1:])


def test_what_cannot_have_residuals_is_refused(cheetah_buffer):
    with pytest.raises(ValueError, match=r"DT of Box.* has no flow"):
        ResidualActionVecEnv(make_venv(), make_model(DT, cheetah_buffer))
    chunks = make_model(DTFM, cheetah_buffer, policy_kwargs=CHUNKS)
    with pytest.raises(
        ValueError, match=r"n_action_steps=3: residual actions are added to single actions;.*n_action_steps=1\)"
    ):
        ResidualActionVecEnv(make_venv(), chunks)
    with pytest.raises(ValueError, match="bound must be a number above 0, got 0"):
        ResidualActionVecEnv(make_venv(), chunks, bound=0)
    critic = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=1, n_action_samples=4))
    with pytest.raises(
        ValueError, match=r"n_action_samples=4: residual actions are added to one sample;.*n_action_samples=1\)"
    ):
        ResidualActionVecEnv(make_venv(), critic)
    one_each = FinetunedDTFM.of(chunks)
    one_each.policy.set_acting(n_action_steps=1)
    agent = make_agent(one_each)
    with pytest.raises(ValueError, match="residual actions are added to single actions"):
        FinetunedDTFM.of(chunks, agent)
    residual = FinetunedDTFM.of(one_each, agent)
    for wrapper in (ResidualActionVecEnv, NoiseActionVecEnv):
        with pytest.raises(ValueError, match="This FinetunedDTFM has an online actor already"):
            wrapper(make_venv(), residual)
    env = agent.get_env()
    env.reset()
    with pytest.raises(ValueError, match=r"A residual action must be finite numbers, got \[nan"):
        env.step(np.full((3, 6), np.nan))
    with pytest.raises(ValueError, match="residual actions are added to single actions"):
        residual.policy.set_acting(n_action_steps=2)
