"""One recorded dataset for the packages that work through the command line, and a small training on it."""

import json
from pathlib import Path

import pytest
from stable_baselines3 import PPO

from sb3_dtfm.cli.main import main
from sb3_dtfm.zoo.resuming import CHECKPOINT, START

DATASET_ID = "tests/halfcheetah/random-v0"
TINY = {
    "dt": "policy_kwargs:dict(embed_dim=16,n_layers=1,n_heads=1)",
    "dtfm": "policy_kwargs:dict(embed_dim=16,n_layers=1,n_heads=1,flow_hidden_dim=16,flow_n_layers=1,flow_steps=2)",
}


def tiny_training(algo: str, *arguments: str) -> list[str]:
    """Four gradient steps on HalfCheetah, episodes of 20 steps."""
    tail = ["-params", TINY[algo], "batch_size:4", *arguments]
    return ["train", "--algo", algo, "--env", "HalfCheetah-v5", "-n", "4", "--env-kwargs", "max_episode_steps:20", *tail]


def undo_checkpoints(run: Path) -> None:
    """Leave a run as if it had been killed before its first checkpoint."""
    (run / CHECKPOINT).unlink(missing_ok=True)
    (run / START).write_text(json.dumps({**json.loads((run / START).read_text()), "has_checkpoint": False}))


@pytest.fixture(scope="session")
def minari_folder(tmp_path_factory) -> Path:
    """Minari's folder with DATASET_ID in it, recorded through the command line."""
    folder = tmp_path_factory.mktemp("minari")
    model = folder / "agent.zip"
    PPO("MlpPolicy", "HalfCheetah-v5", n_steps=8, batch_size=8, device="cpu", seed=0).save(model)
    record = ["record", "--algo", "ppo", "--model", str(model), "--env", "HalfCheetah-v5", "--dataset-id", DATASET_ID]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        assert main([*record, "--episodes", "3", "--noise", "0.1", "--n-envs", "3", "--seed", "1"]) == 0
    return folder


@pytest.fixture
def workplace(tmp_path, monkeypatch, minari_folder) -> Path:
    """An empty current folder, from which DATASET_ID is found."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
    return tmp_path
