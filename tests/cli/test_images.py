"""A policy that sees images, from its recording to its export, as a user types it."""

from pathlib import Path

import pytest
from stable_baselines3 import PPO

from sb3_dtfm.cli.main import main
from sb3_dtfm.data import load_dataset
from tests.recorded import TINY

TASK = ["--algo", "dtfm", "--env", "Pendulum-v1"]
KWARGS = ["--env-kwargs", "render_mode:'rgb_array'", "max_episode_steps:6"]


def test_a_policy_of_images_is_trained_shown_swept_finetuned_and_exported(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pygame")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu", seed=0).save("agent")
    dataset, short = "local/pendulum/pixels-v0", KWARGS[:1] + KWARGS[2:]
    agent = ["--algo", "ppo", "--model", "agent.zip", "--env", "Pendulum-v1", "--dataset-id", dataset, "--stochastic"]
    assert main(["record", *agent, "--episodes", "3", "--camera", "render", "--camera-size", "24", *short]) == 0
    size = "{'sb3_dtfm.envs.RenderWrapper': {'size': 24}}"
    extractor = "features_extractor_kwargs:dict(channels=(8, 8), features_dim=8)"
    settings = ["-params", TINY["dtfm"], "batch_size:4", f"env_wrapper:[{size}]", extractor]
    evaluating = ["-n", "4", "--eval-freq", "4", "--eval-episodes", "1", "--verbose", "0"]
    assert main(["train", *TASK, "--dataset", dataset, *evaluating, *KWARGS, *settings]) == 0
    run = "logs/dtfm/Pendulum-v1_1"
    assert main(["enjoy", *TASK, "--no-render", "-n", "6"]) == 0
    assert "Mean episode length: 6.00" in capsys.readouterr().out
    assert main(["sweep", "--env", "Pendulum-v1", "--dataset", dataset, "--episodes", "1", "--points", "2", run]) == 0
    assert main(["export", run]) == 0
    assert all(Path(name).stat().st_size > 1000 for name in ("sweep.png", "policy.onnx"))
    own = ["batch_size:4", "n_episodes:1", "gradient_steps:1", "n_envs:1"]
    assert main(["finetune", *TASK, "--model", run, *evaluating, "-params", *own]) == 0
    assert main(["inspect", dataset, "--dataset-kwargs", "observation_keys:['pixels']"]) == 0
    assert "| images | pixels 24 x 24 x 3 |" in capsys.readouterr().out
    assert load_dataset(dataset).observation_space.shape == (3,)
