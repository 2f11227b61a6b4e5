"""SB3's contract: learn, callbacks, logger, save, load, and refusal of what would go wrong."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.nn import functional as F

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import DatasetError, ScoreReference, TrajectoryBuffer, expected
from sb3_dtfm.data.cache import Fingerprint, load_cached
from tests.conftest import PLAIN, TINY_FLOW_POLICY, TINY_POLICY, make_env, record_random_episodes

ALGORITHMS = [(DT, TINY_POLICY), (DTFM, TINY_FLOW_POLICY)]
IDS = ["dt", "dtfm"]


def make_model(algorithm, buffer, **kwargs):
    policy_kwargs = kwargs.pop("policy_kwargs", dict(ALGORITHMS)[algorithm])
    arguments = dict(PLAIN, batch_size=16, context_length=5, seed=0, policy_kwargs=policy_kwargs)
    return algorithm("MultiInputPolicy", dataset=buffer, **{**arguments, **kwargs})


def weights(model):
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


@pytest.mark.parametrize(("algorithm", "policy_kwargs"), ALGORITHMS, ids=IDS)
def test_one_episode_is_learned_by_heart(algorithm, policy_kwargs):
    """Replaying the episode's observations gives back its actions within 0.05."""
    episode = record_random_episodes(1, seed=5)[0]
    env = make_env()
    buffer = TrajectoryBuffer.from_trajectories([episode], env.unwrapped.action_space)
    overfit = dict(embed_dim=64, n_layers=2, n_heads=2, dropout=0.0)
    if algorithm is DTFM:
        overfit.update(flow_hidden_dim=128, flow_steps=20)
    model = make_model(
        algorithm, buffer, policy_kwargs=overfit, learning_rate=2e-3, learning_rate_schedule="cosine", warmup_steps=50,
        weight_decay=0.0, batch_size=32, context_length=5, precision="float32", max_grad_norm=1.0,
    ).learn(400)  # fmt: skip
    returns_to_go, state = buffer.returns_to_go.numpy(), None
    for t in range(len(episode)):
        observation = {
            "observation": episode.observations[t].astype(np.float32),
            "return_to_go": returns_to_go[t : t + 1],
            "timestep": np.array([t]),
        }
        action, state = model.predict(observation, state=state, deterministic=True)
        assert np.abs(action - episode.actions[t]).max() < 0.05, f"step {t}"
        actions = state[1].copy()
        actions[:, -1] = episode.actions[t]  # the past as it was recorded
        state = (state[0], actions, *state[2:])


@pytest.mark.parametrize("algorithm", [DT, DTFM], ids=IDS)
def test_save_and_load_without_dataset_and_env_gives_the_same_actions_in_a_new_process(algorithm, cheetah_buffer, tmp_path):
    model = make_model(algorithm, cheetah_buffer, ema_decay=0.9).learn(10)
    model.save(tmp_path / "model.zip")
    observation, _ = make_env().reset(seed=4)
    np.savez(tmp_path / "observation.npz", **observation)
    script = (
        f"import numpy as np\nfrom sb3_dtfm import {algorithm.__name__}\n"
        f"model = {algorithm.__name__}.load(r'{tmp_path / 'model.zip'}')\n"
        f"observation = dict(np.load(r'{tmp_path / 'observation.npz'}'))\n"
        f"np.save(r'{tmp_path / 'action.npy'}', model.predict(observation, deterministic=True)[0])\n"
    )
    subprocess.run([sys.executable, "-c", "import torch; torch.set_num_threads(1)\n" + script], check=True)
    expected, _ = model.predict(observation, deterministic=True)
    assert np.array_equal(np.load(tmp_path / "action.npy"), expected)


@pytest.mark.parametrize("algorithm", [DT, DTFM], ids=IDS)
def test_training_continues_after_load_with_the_optimisers_state(algorithm, cheetah_buffer, tmp_path):
    """Without dropout, ten steps, a save and ten steps more are twenty steps."""
    policy_kwargs = dict(dict(ALGORITHMS)[algorithm], dropout=0.0)
    straight = make_model(algorithm, cheetah_buffer, policy_kwargs=policy_kwargs).learn(10)
    straight.save(tmp_path / "model")
    straight.learn(10, reset_num_timesteps=False)
    loaded = algorithm.load(tmp_path / "model", dataset=cheetah_buffer)
    assert isinstance(loaded, BaseAlgorithm)
    assert loaded.num_timesteps == 10
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.num_timesteps == 20
    assert th.equal(weights(loaded), weights(straight))


def test_the_saved_file_holds_no_data(cheetah_buffer, tmp_path):
    model = make_model(DT, cheetah_buffer)
    model.save(tmp_path / "model")
    loaded = DT.load(tmp_path / "model")
    assert loaded.buffer is None
    assert loaded.dataset is None
    with pytest.raises(ValueError, match=r"no dataset to learn from.*DT\.load\(path, dataset="):
        loaded.learn(1)
    loaded.set_dataset(cheetah_buffer)
    loaded.learn(1)


@pytest.mark.parametrize("algorithm", [DT, DTFM], ids=IDS)
def test_evaluation_does_not_change_training(algorithm, cheetah_buffer):
    plain = make_model(algorithm, cheetah_buffer).learn(12)
    evaluation = EvalCallback(Monitor(make_env()), eval_freq=4, n_eval_episodes=1, verbose=0, deterministic=False)
    evaluated = make_model(algorithm, cheetah_buffer).learn(12, callback=evaluation, log_interval=5)
    assert th.equal(weights(plain), weights(evaluated))


def test_the_seed_decides_everything(cheetah_buffer):
    first, second = (make_model(DTFM, cheetah_buffer, seed=3).learn(5) for _ in range(2))
    assert th.equal(weights(first), weights(second))
    assert not th.equal(weights(first), weights(make_model(DTFM, cheetah_buffer, seed=4).learn(5)))


def test_both_algorithms_start_from_the_same_transformer_and_learn_from_the_same_half(cheetah_buffer):
    dt, dtfm = (make_model(algorithm, cheetah_buffer, dataset_kwargs=dict(fraction=0.5), seed=1) for algorithm in (DT, DTFM))
    for ours, theirs in zip(dt.policy.network.trunk.parameters(), dtfm.policy.network.trunk.parameters(), strict=True):
        assert th.equal(ours, theirs)
    assert dt.buffer.n_episodes == dtfm.buffer.n_episodes == 3
    assert th.equal(dt.buffer.observations, dtfm.buffer.observations)


def test_a_cache_trains_the_same_model_as_memory(cheetah_buffer, tmp_path):
    """Also from a random half of the episodes, and reading a batch ahead."""
    episodes = record_random_episodes(6)

    def read(storage):
        return TrajectoryBuffer.from_trajectories(episodes, cheetah_buffer.action_space, storage=storage)

    cached = load_cached(tmp_path, Fingerprint("cheetah", "", "", ""), read)
    models = [
        make_model(DTFM, buffer, dataset_kwargs=dict(fraction=0.5)).learn(5, log_interval=2)
        for buffer in (cheetah_buffer, cached)
    ]
    assert models[1].buffer.memory_mapped
    assert th.equal(*map(weights, models))


class CountSteps(BaseCallback):
    """Remembers the number of gradient steps at every call, and whether the network was training."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        self.seen.append((self.num_timesteps, self.model.num_timesteps, self.model.policy.training))
        return len(self.seen) < 7


def test_callbacks_run_once_per_gradient_step_and_can_stop(cheetah_buffer):
    callback = CountSteps()
    model = make_model(DT, cheetah_buffer).learn(100, callback=callback, log_interval=None)
    assert callback.seen == [(n, n, True) for n in range(1, 8)]
    assert model.num_timesteps == 7


def test_eval_and_checkpoint_callbacks_work_unchanged_without_an_env(cheetah_buffer, tmp_path):
    evaluation = EvalCallback(
        DummyVecEnv([lambda: Monitor(make_env())] * 2), eval_freq=5, n_eval_episodes=2, verbose=0,
        log_path=str(tmp_path), best_model_save_path=str(tmp_path),
    )  # fmt: skip
    make_model(DTFM, cheetah_buffer).learn(10, callback=[evaluation, CheckpointCallback(5, str(tmp_path), "step")])
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [5, 10]
    for name in ("best_model.zip", "step_5_steps.zip", "step_10_steps.zip"):
        DTFM.load(tmp_path / name)


def test_a_training_env_is_optional_and_must_fit(cheetah_buffer):
    model = make_model(DT, cheetah_buffer, env=make_env())
    assert model.get_env().num_envs == 1
    without = make_model(DT, cheetah_buffer)
    assert without.observation_space == model.observation_space
    assert without.action_space == model.action_space
    assert np.isfinite(evaluate_policy(without, Monitor(make_env()), 1)[0])


def test_tensorboard_holds_the_promised_curves(cheetah_buffer, tmp_path):
    cheetah_buffer.score_reference = ScoreReference(-100.0, 100.0, "test scale")
    try:
        for algorithm, loss in ((DT, "regression_loss"), (DTFM, "flow_loss")):
            model = make_model(algorithm, cheetah_buffer, tensorboard_log=str(tmp_path))
            model.learn(10, callback=EvalCallback(Monitor(make_env()), eval_freq=5, verbose=0), log_interval=5)
            events = EventAccumulator(str(tmp_path / f"{algorithm.__name__}_1")).Reload()
            expected = {f"train/{name}" for name in ("loss", loss, "action_mse", "grad_norm", "learning_rate")}
            expected |= {"time/steps_per_second", "eval/mean_reward", "eval/mean_ep_length", "eval/normalized_score"}
            assert expected <= set(events.Tags()["scalars"])
            assert [event.step for event in events.Scalars("train/loss")] == [5, 10]
            scores, rewards = events.Scalars("eval/normalized_score"), events.Scalars("eval/mean_reward")
            assert scores[0].value == pytest.approx((rewards[0].value + 100) / 200, rel=1e-5)
    finally:
        cheetah_buffer.score_reference = None


def logged_learning_rates(model, n_steps):
    rates = []
    model.learn(n_steps, callback=lambda *_: rates.append(model.policy.optimizer.param_groups[0]["lr"]) is None)
    return rates


def test_action_prediction_and_tau_near_the_noise_train_and_are_saved(cheetah_buffer, tmp_path):
    policy_kwargs = {**TINY_FLOW_POLICY, "flow_prediction": "action", "flow_tau_exponent": 2.0}
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, context_length=3, policy_kwargs=policy_kwargs, seed=0)
    batch = model.buffer.sample(4, 3, th.Generator().manual_seed(0))
    noise, tau = model.policy.network.draw_noise(batch, th.Generator().manual_seed(0))
    assert (noise.shape, tau.shape) == ((4, 3, 6), (4, 3))
    head = model.policy.network.head
    head.options = head.options.changed(flow_tau_exponent=1.0)
    _, uniform = model.policy.network.draw_noise(batch, th.Generator().manual_seed(0))
    th.testing.assert_close(tau, uniform.square())
    head.options = head.options.changed(flow_tau_exponent=2.0)
    model.learn(3).save(tmp_path / "model")
    head = DTFM.load(tmp_path / "model").policy.network.head
    assert head.regression is not None
    assert head.options.flow_tau_exponent == 2.0


@pytest.mark.parametrize(("algorithm", "policy_kwargs"), ALGORITHMS, ids=IDS)
def test_without_time_steps_and_with_better_episodes_more_often(algorithm, policy_kwargs, cheetah_buffer, tmp_path):
    policy_kwargs = {**policy_kwargs, "timestep_embedding": False}
    model = make_model(algorithm, cheetah_buffer, policy_kwargs=policy_kwargs, return_weighting=5.0)
    model.learn(5, log_interval=None).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    assert loaded.return_weighting == 5.0
    assert loaded.policy.network.trunk.embed_timestep is None


def test_expected_returns_are_what_is_learned_from_and_asked_for(cheetah_buffer, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(expected, "N_TIMESTEPS", 20)
    policy_kwargs = dict(clip_return_to_go=True, expected_return_steps=10)
    model = make_model(DTFM, cheetah_buffer, policy_kwargs=policy_kwargs, verbose=1)
    assert "Learning which returns may be expected (expected_return_steps=10)" in capsys.readouterr().out
    wanted = cheetah_buffer.with_expected_returns(10, seed=0)
    assert th.equal(model.buffer.returns_to_go, wanted.returns_to_go)
    assert th.equal(model.policy.normalization.return_to_go_range, wanted.return_to_go_range())
    assert model.score_reference == cheetah_buffer.score_reference
    model.learn(2).save(tmp_path / "model")
    loaded = DTFM.load(tmp_path / "model", dataset=cheetah_buffer)
    assert loaded.policy.options.expected_return_steps == 10
    loaded.learn(1)
    assert th.equal(loaded.buffer.returns_to_go, wanted.returns_to_go)


@pytest.mark.parametrize(("algorithm", "policy_kwargs"), ALGORITHMS, ids=IDS)
def test_one_token_a_step_trains_and_is_saved(algorithm, policy_kwargs, cheetah_buffer, tmp_path):
    model = make_model(algorithm, cheetah_buffer, policy_kwargs={**policy_kwargs, "tokens_per_step": 1}).learn(3)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", dataset=cheetah_buffer)
    assert loaded.policy.network.trunk.tokens_per_step == 1
    observation, _ = make_env().reset(seed=0)
    assert np.array_equal(*(each.predict(observation, deterministic=True)[0] for each in (model, loaded)))
    assert loaded.learn(1).num_timesteps == 1


def test_learning_rate_warms_up_and_decays(cheetah_buffer):
    rates = logged_learning_rates(
        make_model(DT, cheetah_buffer, learning_rate=1.0e-3, warmup_steps=4, learning_rate_schedule="linear"), 10
    )
    factors = [min(1, (n + 1) / 4) * (1 - n / 10) for n in range(10)]
    assert rates == pytest.approx([1e-3 * factor for factor in factors])
    cosine = logged_learning_rates(make_model(DT, cheetah_buffer, learning_rate_schedule="cosine"), 10)
    assert cosine == pytest.approx([0.5e-4 * (1 + np.cos(np.pi * n / 10)) for n in range(10)])
    callable_rate = logged_learning_rates(make_model(DT, cheetah_buffer, learning_rate=lambda progress: progress), 4)
    assert callable_rate == pytest.approx([1, 0.75, 0.5, 0.25])


def test_the_moving_average_acts_and_follows_the_weights(cheetah_buffer):
    model = make_model(DT, cheetah_buffer, ema_decay=0.999).learn(1)
    trained, averaged = (next(net.parameters()) for net in (model.policy.network, model.policy.acting_network))
    assert trained is not averaged
    assert not averaged.requires_grad
    before, target = averaged.clone(), trained.detach().clone()
    model.policy.update_ema(0.75)
    assert th.allclose(averaged, 0.75 * before + 0.25 * target)
    assert make_model(DT, cheetah_buffer).policy.acting_network is not None


def test_gradients_are_clipped_to_their_norm(cheetah_buffer):
    model = make_model(DT, cheetah_buffer, max_grad_norm=1e-3).learn(1)
    norm = th.cat([p.grad.flatten() for p in model.policy.network.parameters()]).norm()
    assert norm == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("algorithm", [DT, DTFM], ids=IDS)
def test_every_parameter_gets_a_gradient(algorithm, cheetah_buffer):
    extra = {"policy_kwargs": {**TINY_FLOW_POLICY, "regression_coef": 0.5}} if algorithm is DTFM else {}
    model = make_model(algorithm, cheetah_buffer, **extra).learn(1)
    assert [name for name, p in model.policy.network.named_parameters() if p.grad is None] == []


def test_bfloat16_learns_what_float32_learns(cheetah_buffer):
    def final_loss(precision):
        policy_kwargs = dict(TINY_FLOW_POLICY, dropout=0.0)
        model = make_model(DTFM, cheetah_buffer, precision=precision, policy_kwargs=policy_kwargs, learning_rate=1e-3)
        model.set_logger(configure(None, []))
        losses = []
        model.logger.dump = lambda step: losses.append(model.logger.name_to_value["train/loss"])
        model.learn(40, log_interval=40)
        return losses[-1]

    assert final_loss("bfloat16") == pytest.approx(final_loss("float32"), rel=0.02)


def test_a_loss_that_is_no_longer_finite_stops_training_with_advice(cheetah_buffer):
    model = make_model(DT, cheetah_buffer)
    with th.no_grad():
        model.policy.network.trunk.final_norm.weight.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match=r"loss became nan.*learning_rate"):
        model.learn(3)


def test_observation_normalisation_and_frame_stacking_are_refused(cheetah_buffer):
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=True\)"):
        make_model(DT, cheetah_buffer, env=VecNormalize(DummyVecEnv([make_env])))
    with pytest.raises(ValueError, match=r"VecFrameStack.*context_length"):
        make_model(DT, cheetah_buffer, env=VecFrameStack(DummyVecEnv([make_env]), 2))
    make_model(DT, cheetah_buffer, env=VecNormalize(DummyVecEnv([make_env]), norm_obs=False))


def test_a_dataset_that_does_not_fit_the_env_names_both(cheetah_buffer):
    from sb3_dtfm.envs import ReturnToGoWrapper

    hopper = ReturnToGoWrapper(gym.make("Hopper-v5"), 100.0)
    with pytest.raises(DatasetError, match=r"random cheetah.*\(17,\).*environment's are.*\(11,\)"):
        make_model(DT, cheetah_buffer, env=hopper)
    wider = TrajectoryBuffer.from_trajectories(record_random_episodes(1), spaces.Box(-2, 2, (6,)), source="wide actions")
    with pytest.raises(DatasetError, match=r"wide actions.*Box\(-2.0, 2.0.*environment's are Box\(-1.0, 1.0"):
        make_model(DT, wider, env=make_env())


@pytest.mark.parametrize("env", [None, "wrapped"])
def test_a_new_model_needs_a_dataset(env):
    with pytest.raises(ValueError, match="DT has no dataset to learn from: give one to the constructor"):
        DT("MultiInputPolicy", env=make_env() if env else None)


class LossCurve(BaseCallback):
    """The loss of every gradient step."""

    def __init__(self):
        super().__init__()
        self.losses = []

    def _on_step(self):
        self.losses.append(float(self.model._means._sums["loss"]))
        return True


def loss_curve(buffer, n_steps=500, trunk=(), **kwargs):
    """Means of 50 losses each."""
    curve = LossCurve()
    policy_kwargs = dict(TINY_FLOW_POLICY, dropout=0.1, n_layers=1, **dict(trunk))
    make_model(DTFM, buffer, policy_kwargs=policy_kwargs, learning_rate=1e-3, **kwargs).learn(n_steps, curve, None)
    return np.diff(curve.losses, prepend=0.0).reshape(-1, 50).mean(axis=1)


def test_fast_paths_learn_as_plain_float32_does(cheetah_buffer, monkeypatch):
    """Same batches, other dropout masks: the loss curves differ no more than two streams of plain dropout do (2.4 %)."""
    fast = [loss_curve(cheetah_buffer, precision=precision) for precision in ("float32", "bfloat16")]
    monkeypatch.setattr("sb3_dtfm.networks.layers._draws_masks_here", lambda x: False)
    monkeypatch.setattr("sb3_dtfm.networks.trunk.attention", plain_attention)
    plain = loss_curve(cheetah_buffer, precision="float32")
    assert plain[-1] < 0.5 * plain[0]
    for curve in fast:
        assert np.abs(curve / plain - 1.0).max() < 0.04
        assert abs(np.mean(curve / plain) - 1.0) < 0.015


def plain_attention(query, key, value, bias, dropout_p):
    return F.scaled_dot_product_attention(query, key, value, attn_mask=bias, dropout_p=dropout_p)


@pytest.mark.slow
@pytest.mark.parametrize(
    "trunk",
    [{}, {"tokens_per_step": 1}, {"tokens_per_step": 1, "chunk_size": 4, "film_return_to_go": True}],
    ids=["three tokens", "one token", "chunks and FiLM"],
)
def test_a_compiled_loss_learns_as_the_plain_one_does(trunk, cheetah_buffer):
    compiled, plain = (loss_curve(cheetah_buffer, 100, trunk, compile=each) for each in (True, False))
    assert np.abs(compiled / plain - 1.0).max() < 0.1
