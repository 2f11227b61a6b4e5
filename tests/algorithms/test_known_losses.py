"""Training learns what it learned before heads, batches and acting were moved: losses computed by commit efe2ef2."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import Trajectory, TrajectoryBuffer

TRUNK = dict(
    embed_dim=128, n_layers=3, n_heads=2, dropout=0.0, tokens_per_step=3, timestep_embedding=False, return_scaling="max",
    clip_return_to_go=False, film_return_to_go=False, observation_scaling="std", return_conditioning=True,
)  # fmt: skip
HEADS = {
    DT: {},
    DTFM: dict(flow_hidden_dim=256, flow_prediction="action", flow_tau_exponent=2.0, flow_steps=1, regression_coef=0.0),
}
# Losses of every sixth of 30 gradient steps, and the acting policy's action_mse after them.
KNOWN = {
    DT: ([0.54332978, 0.36880848, 0.35068056, 0.34039873, 0.33506033], 0.32348481),
    DTFM: ([0.51563275, 0.40093032, 0.35162923, 0.32001892, 0.29018167], 0.32107106),
}


def make_buffer() -> TrajectoryBuffer:
    random = np.random.default_rng(0)
    episodes = [
        Trajectory(random.normal(size=(200, 17)), random.uniform(-1, 1, (200, 6)), random.normal(size=200)) for _ in range(8)
    ]
    return TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (6,)))


def noise_of_before(actions, generator):
    """A tau of its own for each step, squared."""
    return th.randn(actions.shape, generator=generator), th.rand(actions.shape[:2], generator=generator) ** 2.0


@pytest.mark.parametrize("algorithm", KNOWN)
def test_the_same_batches_and_noise_give_the_losses_of_before(algorithm):
    model = algorithm(
        "MultiInputPolicy", dataset=make_buffer(), context_length=5, batch_size=64, learning_rate=1e-3, ema_decay=0.999,
        policy_kwargs={**TRUNK, **HEADS[algorithm]}, seed=0, device="cpu",
    )  # fmt: skip
    policy, generator = model.policy, th.Generator().manual_seed(1)
    ends = th.randint(len(model.buffer), (30, 64), generator=generator)
    losses = []
    for batch in (model.buffer.windows(each, 5) for each in ends):
        policy.optimizer.zero_grad()
        loss, _ = model.compute_loss(batch, *noise_of_before(batch.actions, generator) if algorithm is DTFM else ())
        loss.backward()
        policy.optimizer.step()
        policy.update_ema(0.9)
        losses.append(loss.item())
    known_losses, known_mse = KNOWN[algorithm]
    assert losses[::6] == pytest.approx(known_losses, rel=1e-4)
    mse = policy.action_mse(model.buffer.windows(ends[0], 5), th.Generator().manual_seed(3))
    assert float(mse) == pytest.approx(known_mse, rel=1e-4)
