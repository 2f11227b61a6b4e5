"""Training that diverges is stopped before it harms: no model, and no checkpoint, holds anything but numbers."""

import pytest
import torch as th
from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_dtfm import DT, DTFM
from sb3_dtfm.optimization import RunningMeans
from tests.algorithms.small import make_model

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
    """Where a GPU computes the loss, nobody has looked at it before if nothing was logged."""
    monkeypatch.setattr(RunningMeans, "sums", lambda means: {"loss": float("nan"), "grad_norm": 1.0})
    with pytest.raises(FloatingPointError, match="loss became nan"):
        make_model(DT, cheetah_buffer).learn(1, log_interval=None)
