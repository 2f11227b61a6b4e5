"""Training that goes on: after `load`, and in a second `learn`."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import ScoreReference, Trajectory, TrajectoryBuffer
from tests.algorithms.small import learn_losses, make_model, record_curves
from tests.conftest import make_env, record_random_episodes

# So slow that the weights stay as they are: what the loss then shows is the batch and the noise.
STANDSTILL = dict(learning_rate=1e-12, weight_decay=0.0, precision="float32", policy_kwargs=dict(dropout=0.0))
SCALE = ScoreReference(-100.0, 100.0, "two returns for a test")


@pytest.fixture(scope="module")
def scored_buffer(cheetah_buffer):
    return TrajectoryBuffer.from_trajectories(
        record_random_episodes(2), cheetah_buffer.action_space, score_reference=SCALE, source="scored cheetah"
    )


@pytest.fixture(scope="module")
def one_step_buffer(cheetah_buffer):
    """A single recorded step: every batch is the same."""
    episode = record_random_episodes(1)[0]
    step = Trajectory(episode.observations[:1], episode.actions[:1], episode.rewards[:1])
    return TrajectoryBuffer.from_trajectories([step], cheetah_buffer.action_space)


@pytest.mark.parametrize("verbose", [0, 1])
@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_a_loaded_model_learns_with_evaluation_on_scored_data(algorithm, verbose, scored_buffer, tmp_path):
    """Verbose, the callback also says what the scale is."""
    make_model(algorithm, scored_buffer).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", dataset=scored_buffer, verbose=verbose)
    assert loaded.score_reference == SCALE
    curves = record_curves(loaded)
    loaded.learn(2, callback=EvalCallback(Monitor(make_env()), eval_freq=2, n_eval_episodes=1, verbose=0))
    ((_, mean_reward),) = curves.points["eval/mean_reward"]
    assert curves.points["eval/normalized_score"] == [(2, pytest.approx((mean_reward + 100.0) / 200.0))]


@pytest.mark.parametrize("algorithm", [DT, DTFM])
@pytest.mark.parametrize("reset_num_timesteps", [True, False])
def test_a_second_learn_draws_new_batches(algorithm, reset_num_timesteps, cheetah_buffer, tmp_path):
    model = make_model(algorithm, cheetah_buffer, **STANDSTILL)
    first = learn_losses(model, 5)
    model.save(tmp_path / "model")
    second = learn_losses(model, 5, reset_num_timesteps=reset_num_timesteps)
    loaded = algorithm.load(tmp_path / "model", dataset=cheetah_buffer)
    assert not np.isclose(first, second, rtol=1e-5).any()
    assert np.array_equal(second, learn_losses(loaded, 5, reset_num_timesteps=reset_num_timesteps))
    third = learn_losses(loaded, 5, reset_num_timesteps=reset_num_timesteps)
    assert not np.isclose(third, first, rtol=1e-5).any()
    assert not np.isclose(third, second, rtol=1e-5).any()
    assert np.array_equal(first, learn_losses(make_model(algorithm, cheetah_buffer, **STANDSTILL), 5))


def test_a_second_learn_draws_new_noise(one_step_buffer, tmp_path):
    assert np.ptp(learn_losses(make_model(DT, one_step_buffer, **STANDSTILL), 5)) < 1e-6
    model = make_model(DTFM, one_step_buffer, **STANDSTILL)
    first = learn_losses(model, 5)
    model.save(tmp_path / "model")
    second = learn_losses(model, 5)
    assert not np.isclose(first, second, rtol=1e-5).any()
    assert np.array_equal(second, learn_losses(DTFM.load(tmp_path / "model", dataset=one_step_buffer), 5))
    assert np.array_equal(first, learn_losses(make_model(DTFM, one_step_buffer, **STANDSTILL), 5))


def test_a_weight_decay_given_to_load_decays(cheetah_buffer, tmp_path):
    """Not the one that the optimiser's state in the file has."""
    make_model(DT, cheetah_buffer, **{**STANDSTILL, "learning_rate": 0.1}).learn(1).save(tmp_path / "model")

    def weights(decay: float, n_steps: int) -> th.Tensor:
        model = DT.load(tmp_path / "model", dataset=cheetah_buffer, weight_decay=decay).learn(n_steps)
        return th.cat([weight.detach().flatten() for weight in model.policy.optimizer.param_groups[0]["params"]])

    assert th.allclose(weights(0.0, 1) - weights(5.0, 1), 0.1 * 5.0 * weights(0.0, 0), atol=1e-5)


@pytest.mark.parametrize(("saved_decay", "decay"), [(0.0, 0.9), (0.9, 0.0)])
def test_a_moving_average_can_begin_and_end_at_load(saved_decay, decay, cheetah_buffer, tmp_path):
    """It begins from the weights; without it the weights act."""
    model = make_model(DT, cheetah_buffer, ema_decay=saved_decay, learning_rate=0.1).learn(2)
    model.save(tmp_path / "model")
    loaded = DT.load(tmp_path / "model", dataset=cheetah_buffer, ema_decay=decay)
    acting = loaded.policy.acting_network
    assert (acting is loaded.policy.network) == (decay == 0.0)
    for name, weight in model.policy.network.state_dict().items():
        assert th.equal(acting.state_dict()[name], weight), name
    assert loaded.learn(1).num_timesteps == 1
