"""Pushing and pulling models, through a folder instead of the hub."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from huggingface_hub import ModelCard
from stable_baselines3 import PPO

from sb3_dtfm import DT
from sb3_dtfm.cli.main import main
from tests.cli.local_hub import running
from tests.recorded import DATASET_ID, tiny_training

MODEL = ["--algo", "dt", "--env", "HalfCheetah-v5", "-orga", "someone"]
QUICK = ["-n", "3", "--n-eval-episodes", "2"]


@pytest.fixture(scope="module")
def pushed(minari_folder, tmp_path_factory) -> Path:
    """A folder with a run, and the repository that was made of it."""
    place = tmp_path_factory.mktemp("pushed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.delenv("MUJOCO_GL", raising=False)
        patch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
        conf_file = place / "mine.yml"
        conf_file.write_text("default: {policy: MultiInputPolicy, n_timesteps: 2}")
        training = tiny_training("dt", "--dataset", DATASET_ID, "--conf-file", str(conf_file), "--eval-freq", "-1")
        assert main([*training, "--target-return", "50"]) == 0
        assert main(["push", *MODEL, *QUICK, "--repo-folder", "repository"]) == 0
    return place


@pytest.fixture
def repository(pushed, tmp_path, monkeypatch) -> Path:
    """A copy of it, beside nothing else."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(pushed / "repository", tmp_path / "repository"))


def test_a_repository_holds_the_model_its_settings_its_score_and_a_video(pushed, repository):
    names = {"README.md", "settings.json", "results.json", "replay.mp4", "dt-HalfCheetah-v5.zip"}
    assert {path.name for path in repository.iterdir()} == names
    settings = json.loads((repository / "settings.json").read_text())
    assert settings == {
        "algo": "dt",
        "env": "HalfCheetah-v5",
        "target_return": 50.0,
        "env_kwargs": {"max_episode_steps": 20},
    }
    model = pushed / "logs" / "dt" / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip"
    assert (repository / "dt-HalfCheetah-v5.zip").read_bytes() == model.read_bytes()
    assert json.loads((repository / "results.json").read_text())["n_episodes"] == 2


def test_the_card_is_read_by_the_hub_and_its_code_loads_the_model(repository, monkeypatch, capsys):
    card = ModelCard.load(repository / "README.md")
    result = json.loads((repository / "results.json").read_text())
    (score,) = card.data.eval_results
    assert score.metric_value == f"{result['mean_reward']:.2f} +/- {result['std_reward']:.2f}"
    assert card.data.library_name == "sb3-dtfm"
    code = card.text.split("```python\n")[1].split("```")[0]

    def hf_hub_download(repo_id: str, filename: str) -> str:
        assert repo_id == "someone/dt-HalfCheetah-v5"
        return str(repository / filename)

    monkeypatch.setattr("huggingface_hub.hf_hub_download", hf_hub_download)
    names: dict = {}
    exec(code, names)
    assert isinstance(names["model"], DT)
    assert names["env"].get_wrapper_attr("target_return") == 50.0
    assert capsys.readouterr().out.startswith("(")


def test_a_pulled_run_is_what_was_pushed_and_enjoy_takes_it(repository, pushed, capsys):
    for number in (1, 2):
        assert main(["pull", *MODEL, "--repo-folder", str(repository)]) == 0
        assert f"Run: logs/dt/HalfCheetah-v5_{number} (target return 50" in capsys.readouterr().out
    enjoy = ["enjoy", "--algo", "dt", "--env", "HalfCheetah-v5", "--no-render", "-n", "40"]
    assert main(enjoy) == 0
    ours = capsys.readouterr().out.split("Episode Reward")[1:]
    assert len(ours) == 2
    assert main([*enjoy, "-f", str(pushed / "logs")]) == 0
    assert capsys.readouterr().out.split("Episode Reward")[1:] == ours


@pytest.mark.slow
def test_through_a_hub_goes_what_goes_through_a_folder(pushed, repository, monkeypatch, capsys):
    """In a process of its own, as the client reads its settings when it is imported."""
    with running() as hub:
        variables = {"HF_ENDPOINT": hub.address, "HF_HOME": str(repository / "cache"), "HF_TOKEN": "hf_nobody"}
        environment = {**os.environ, **variables, "HF_HUB_DISABLE_XET": "1"}

        def command(name: str, *arguments: str) -> str:
            line = [sys.executable, "-m", "sb3_dtfm", name, *MODEL, *arguments]
            done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            return done.stdout

        monkeypatch.chdir(pushed)
        address = command("push", *QUICK, "--no-render").splitlines()[-1]
        assert address == f"Repository: {hub.address}/someone/dt-HalfCheetah-v5"
        (files,) = hub.repositories.values()
        assert set(files) - {".gitattributes"} == {path.name for path in repository.glob("*.*")} - {"replay.mp4"}
        for name in ("dt-HalfCheetah-v5.zip", "settings.json"):
            assert files[name] == (repository / name).read_bytes()
        assert "Run: pulled/dt/HalfCheetah-v5_1" in command("pull", "-f", "pulled")
    model = "dt/HalfCheetah-v5_1/HalfCheetah-v5.zip"
    assert Path("pulled", model).read_bytes() == Path("logs", model).read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algo": "sac"}, "expected algo, env, a finite target_return and env_kwargs"),
        ({"env": "Ant-v5"}, "holds a model of dt for Ant-v5 (--algo, --env)"),
        ({"target_return": float("nan")}, "a finite target_return"),
        ({"target_return": 10**400}, "a finite target_return"),
        ({"target_return": "5"}, "a finite target_return"),
        ({"env_kwargs": [1]}, "expected algo, env"),
        ({"env_wrapper": "os.system"}, "holds no settings"),
    ],
)
def test_settings_of_others_are_checked(change, message, repository, capsys):
    settings = json.loads((repository / "settings.json").read_text())
    (repository / "settings.json").write_text(json.dumps({**settings, **change}))
    assert main(["pull", *MODEL, "--repo-folder", str(repository)]) == 2
    assert message in capsys.readouterr().err
    assert not Path("logs").exists()


def test_a_model_that_holds_pickles_is_refused(repository, capsys):
    PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(repository / "dt-HalfCheetah-v5.zip")
    assert main(["pull", *MODEL, "--repo-folder", str(repository)]) == 2
    assert "saved by another algorithm" in capsys.readouterr().err
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pull", *MODEL, "--repo-folder", "nowhere"], "nowhere/settings.json does not exist; expected a repository"),
        (["pull", *MODEL, "--algo", "sac"], "--algo sac: accepted are dt and dtfm. RL-Zoo's load_from_hub downloads"),
        (["pull", *MODEL, "--algo", "DT"], "--algo DT (did you mean dt?)"),
        (["push", *MODEL, "--algo", "DT"], "--algo DT (did you mean dt?)"),
        (["push", *MODEL], "The logs/dt folder was not found"),
        (["pull", *MODEL, "--exp-id", "3"], "--exp-id 3: logs/dt/HalfCheetah-v5_3 exists already"),
    ],
)
def test_a_mistake_ends_in_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if "3" in arguments:
        Path("logs/dt/HalfCheetah-v5_3").mkdir(parents=True)
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_without_a_hub_nothing_is_lost_and_the_way_around_is_named(pushed, monkeypatch, capsys):
    monkeypatch.chdir(pushed)
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    assert main(["push", *MODEL, *QUICK, "--no-render"]) == 2
    error = capsys.readouterr().err
    assert "someone/dt-HalfCheetah-v5: ConnectError" in error
    assert "--repo-folder writes a folder" in error


def test_a_run_behind_a_wrapper_of_the_users_own_is_not_pushed(pushed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(pushed / "logs", "logs")
    config = Path("logs/dt/HalfCheetah-v5_1/HalfCheetah-v5/config.yml")
    config.write_text(
        config.read_text().replace("sb3_dtfm.envs.ReturnToGoWrapper", "sb3_dtfm.envs.return_to_go.ReturnToGoWrapper")
    )
    assert main(["push", *MODEL, *QUICK, "--repo-folder", "repository"]) == 2
    assert "acts behind sb3_dtfm.envs.ReturnToGoWrapper alone" in capsys.readouterr().err
    assert not any(Path("repository").iterdir())
