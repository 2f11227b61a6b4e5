"""Options of RL-Zoo's `train`, as docs/compatibility.md lists them; what other tests do not show."""

from pathlib import Path

import numpy as np
import pytest
from rl_zoo3.utils import get_trained_models

from sb3_dtfm import DT
from sb3_dtfm.cli.main import main
from tests.recorded import DATASET_ID, tiny_training

RUN = Path("logs/dt/HalfCheetah-v5_1")
SETTINGS = ["--dataset", DATASET_ID, "--verbose", "0"]


def test_what_changes_nothing_in_a_run_without_episodes_is_accepted(workplace):
    options = [
        "--save-replay-buffer",
        "--vec-env",
        "subproc",
        "--n-eval-envs",
        "2",
        "--eval-freq",
        "2",
        "--eval-episodes",
        "2",
    ]
    wrapper = "vec_env_wrapper:'stable_baselines3.common.vec_env.VecMonitor'"
    assert main(tiny_training("dt", wrapper, "normalize:{'norm_obs':False,'norm_reward':True}", *SETTINGS, *options)) == 0
    assert DT.load(RUN / "HalfCheetah-v5.zip").num_timesteps == 4
    assert not (RUN / "replay_buffer.pkl").exists()
    assert main(["enjoy", "--algo", "dt", "--env", "HalfCheetah-v5", "--no-render", "-n", "20"]) == 0


@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_time_limit_outside_the_monitor_ends_evaluations(vec_env, workplace, capsys):
    """RL-Zoo's Monitor never sees such an end, and an evaluation waits for one."""
    limit = {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 7}}
    wrappers = f"env_wrapper:{[limit, 'sb3_dtfm.envs.ReturnToGoWrapper']}"
    evaluations = ["--eval-freq", "4", "--eval-episodes", "2", "--vec-env", vec_env]
    assert main(tiny_training("dt", wrappers, *SETTINGS, *evaluations)) == 0
    assert np.load(RUN / "evaluations.npz")["ep_lengths"].tolist() == [[7, 7]] * 2
    assert main(["enjoy", "--algo", "dt", "--env", "HalfCheetah-v5", "--no-render", "-n", "20"]) == 0
    assert "Episode Length 7" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("setting", "message"), [("normalize:True", "VecNormalize(norm_obs=True)"), ("frame_stack:2", "VecFrameStack")]
)
def test_what_would_change_observations_is_refused_in_one_line(setting, message, workplace, capsys):
    assert main(tiny_training("dt", setting, *SETTINGS)) == 2
    assert message in capsys.readouterr().err.strip().splitlines()[-1]
    assert not RUN.exists()


def test_rl_zoo_finds_our_runs(workplace):
    assert main(tiny_training("dt", *SETTINGS, "--eval-freq", "-1")) == 0
    assert get_trained_models("logs") == {"dt-HalfCheetah-v5": ("dt", "HalfCheetah-v5")}


def test_track_logs_to_wandb(workplace, monkeypatch):
    """Skipped where wandb, which no extra brings, is not installed. It needs no network."""
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    try:
        assert main(tiny_training("dt", *SETTINGS, "--eval-freq", "2", "--eval-episodes", "1", "--track")) == 0
        config = dict(wandb.run.config)
    finally:
        wandb.finish()
        wandb.teardown()  # waits for the process that writes
    assert config["algo"] == "dt"
    (log,) = Path("wandb").glob("offline-run-*/run-*.wandb")
    for curve in (b"train/loss", b"eval/mean_reward"):
        assert curve in log.read_bytes()
