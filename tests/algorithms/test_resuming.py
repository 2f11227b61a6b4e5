"""A run that was interrupted goes on as if it had not been: to the bit, in a new process."""

import subprocess
import sys

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, load_cached
from tests.algorithms.small import make_model, record_curves
from tests.conftest import record_random_episodes

N_STEPS, N_BEFORE = 20, 7
# Dropout, an average, a warm-up and a decay: all that could start anew.
SETTINGS = dict(
    ema_decay=0.9, warmup_steps=3, learning_rate_schedule="cosine", learning_rate=1e-3,
    policy_kwargs=dict(dropout=0.2),
)  # fmt: skip


class Interrupt(BaseCallback):
    """Saves after some steps, in the middle of what a log entry covers, and goes no further."""

    def __init__(self, path):
        super().__init__()
        self.path = path

    def _on_step(self):
        if self.num_timesteps == N_BEFORE:
            self.model.save(self.path)
        return self.num_timesteps < N_BEFORE


def curves_of(model, n_steps, **kwargs):
    """All logged values, but for the time."""
    curves = record_curves(model)
    model.learn(n_steps, log_interval=5, **kwargs)
    return {name: points for name, points in curves.points.items() if not name.startswith("time/")}


def state_of(model):
    """All numbers that training changes, in one vector."""
    states = model.policy.optimizer.state_dict()["state"].values()
    tensors = [*model.policy.state_dict().values(), *(value for state in states for value in state.values())]
    return th.cat([tensor.flatten().double() for tensor in tensors])


@pytest.mark.parametrize("seed", [0, None])
@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_an_interrupted_run_ends_as_if_it_had_not_been(algorithm, seed, cheetah_buffer, tmp_path):
    """Weights, average, optimiser and curve. Without a seed the run's own is saved."""
    th.manual_seed(3)
    straight = make_model(algorithm, cheetah_buffer, seed=seed, **SETTINGS)
    straight._training_seed = 5 if seed is None else None
    straight.save(tmp_path / "start")
    expected = curves_of(straight, N_STEPS)
    first = algorithm.load(tmp_path / "start", dataset=cheetah_buffer)
    before = curves_of(first, N_STEPS, callback=Interrupt(tmp_path / "model"))
    th.manual_seed(11)  # whatever else the new process draws
    second = algorithm.load(tmp_path / "model", dataset=cheetah_buffer)
    after = curves_of(second, N_STEPS - N_BEFORE, reset_num_timesteps=False)
    assert {name: before.get(name, []) + after.get(name, []) for name in expected} == expected
    assert len(expected["train/loss"]) == 4
    assert th.equal(state_of(second), state_of(straight))


def test_a_new_process_that_reads_a_cache_goes_on_to_the_bit(cheetah_buffer, tmp_path):
    episodes = record_random_episodes(6)

    def read(storage):
        return TrajectoryBuffer.from_trajectories(episodes, cheetah_buffer.action_space, storage=storage)

    def make():
        return make_model(DTFM, load_cached(tmp_path / "cache", Fingerprint("c", "", "", ""), read), **SETTINGS)

    straight = make().learn(N_STEPS)
    make().learn(N_STEPS, callback=Interrupt(tmp_path / "model"))
    np.savez(
        tmp_path / "data.npz",
        **{name: np.concatenate([getattr(e, name) for e in episodes]) for name in ("observations", "actions", "rewards")},
        episode_lengths=[len(episode) for episode in episodes],
    )
    script = (
        "import torch; torch.set_num_threads(1)\n"
        "from sb3_dtfm import DTFM\nfrom sb3_dtfm.data import load_dataset\n"
        f"model = DTFM.load(r'{tmp_path / 'model'}')\n"
        f"model.set_dataset(load_dataset(r'{tmp_path / 'data.npz'}', cache_dir=r'{tmp_path / 'other'}'))\n"
        f"model.learn({N_STEPS - N_BEFORE}, reset_num_timesteps=False).save(r'{tmp_path / 'end'}')\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
    assert th.equal(state_of(DTFM.load(tmp_path / "end")), state_of(straight))


def test_evaluations_and_a_users_own_draws_change_no_step(cheetah_buffer):
    class Draw(BaseCallback):
        def _on_step(self):
            th.rand(3), np.random.rand(3)  # noqa: NPY002
            return True

    plain, disturbed = (make_model(DT, cheetah_buffer, **SETTINGS) for _ in range(2))
    plain.learn(5)
    disturbed.learn(5, callback=Draw())
    assert th.equal(state_of(plain), state_of(disturbed))
