"""Training that diverges is stopped before it harms: no model, and no checkpoint, holds anything but numbers."""

import pytest
import torch as th
from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_dtfm import DT, DTFM
from sb3_dtfm.optimization import RunningMeans
from tests.algorithms.small import make_model
from tests.conftest import EPISODE_LENGTH

# Steps so long that the next loss, or its gradient, leaves the range of float32.
DIVERGING = dict(learning_rate=1e30, precision="float32", weight_decay=0.0)


def infinite_parts(model) -> list[str]:
    """Names of the weights and buffers that hold anything but finite numbers."""
    state = model.policy.state_dict()
    return [name for name, values in state.items() if values.is_floating_point() and not th.isfinite(values).all()]


@pytest.mark.parametrize("log_interval", [None, 1, 1000])
@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_divergence_is_an_error_and_leaves_finite_weights(algorithm, log_interval, cheetah_buffer, tmp_path):
    """
    Whether and how often training is logged does not matter, and callbacks never see a broken model: neither the weights
    that are trained nor their moving average.
    """
    model = make_model(algorithm, cheetah_buffer, ema_decay=0.9, **DIVERGING)
    with pytest.raises(FloatingPointError, match="learning_rate"):
        model.learn(20, callback=CheckpointCallback(1, str(tmp_path)), log_interval=log_interval)
    assert 0 < model.num_timesteps < 20
    assert infinite_parts(model) == []
    checkpoints = sorted(tmp_path.glob("*.zip"))
    assert len(checkpoints) > 0
    for path in checkpoints:
        assert infinite_parts(algorithm.load(path)) == [], path.name


def test_a_model_that_diverged_can_go_on_more_slowly(cheetah_buffer, tmp_path):
    """The last checkpoint before is of use: its optimiser's state is finite as well."""
    model = make_model(DT, cheetah_buffer).learn(2)
    model.save(tmp_path / "before")
    diverging = DT.load(tmp_path / "before", dataset=cheetah_buffer, **DIVERGING)
    with pytest.raises(FloatingPointError):
        diverging.learn(20, log_interval=None)
    states = diverging.policy.optimizer.state_dict()["state"].values()
    assert all(th.isfinite(values).all() for state in states for values in state.values())


def test_the_end_of_learning_looks_once_more(cheetah_buffer, monkeypatch):
    """A GPU's loss has not been checked before if nothing was logged."""
    monkeypatch.setattr(RunningMeans, "sums", lambda means: {"loss": float("nan"), "grad_norm": 1.0})
    with pytest.raises(FloatingPointError, match="loss became nan"):
        make_model(DT, cheetah_buffer).learn(1, log_interval=None)


def test_the_error_names_step_episodes_and_the_last_checkpoint(cheetah_buffer, tmp_path, monkeypatch):
    """And comes before the callbacks of its step: no checkpoint is of that step."""
    model = make_model(DT, cheetah_buffer, batch_size=1)
    compute_loss = model.compute_loss
    sick = cheetah_buffer.observations[3 * EPISODE_LENGTH : 4 * EPISODE_LENGTH]

    def spoiled(batch, *noise):
        loss, parts = compute_loss(batch, *noise)
        return loss * (float("nan") if (batch.observations[0, -1] == sick).all(dim=1).any() else 1.0), parts

    monkeypatch.setattr(model, "compute_loss", spoiled)
    with pytest.raises(FloatingPointError, match="loss became nan") as caught:
        model.learn(100, callback=CheckpointCallback(1, str(tmp_path)))
    n_good = model.num_timesteps
    assert 0 < n_good < 99
    assert f"at gradient step {n_good + 1} of this model, whose batch is from episodes 3 of its buffer" in str(caught.value)
    assert f"the last checkpoint is good: {tmp_path}/rl_model_{n_good}_steps.zip." in str(caught.value)
    assert len(list(tmp_path.glob("*.zip"))) == n_good


def test_a_model_that_was_not_saved_says_so_and_steps_that_were_looked_at_late_are_a_range(cheetah_buffer, monkeypatch):
    """As on a GPU, where the sums of several steps are looked at together."""
    model = make_model(DT, cheetah_buffer).learn(3)
    monkeypatch.setattr(RunningMeans, "sums", lambda means: {"loss": 1.0, "grad_norm": float("inf")})
    with pytest.raises(FloatingPointError, match=r"grad_norm became inf between gradient steps 4 and 8 .* good: none"):
        model.learn(5, log_interval=None)


def test_the_last_checkpoint_of_a_model_is_not_that_of_the_one_it_was_loaded_from(cheetah_buffer, tmp_path):
    make_model(DT, cheetah_buffer).save(tmp_path / "model")
    assert DT.load(tmp_path / "model")._last_saved is None
