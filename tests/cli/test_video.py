"""Videos of trained models, drawn by whatever this machine draws with."""

import os
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from imageio_ffmpeg import count_frames_and_secs
from PIL import Image

from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.zoo import rendering
from sb3_dtfm.zoo.commands import FoundModel
from sb3_dtfm.zoo.video import with_env_kwargs
from tests.conftest import TINY_FLOW_POLICY
from tests.recorded import DATASET_ID, tiny_training

SMALL = ["-n", "3", "--env-kwargs", "width:96", "height:64"]
VIDEO = ["video", "--algo", "dtfm", "--env", "HalfCheetah-v5", *SMALL]


def test_gymnasiums_own_tasks_are_drawn_with_what_the_extra_brings():
    pytest.importorskip("pygame", reason="[classic-control] brings pygame")
    env = gym.make("Pendulum-v1", render_mode="rgb_array")
    env.reset(seed=0)
    assert np.ptp(env.render()) > 200
    env.close()


@pytest.fixture
def trained(workplace, monkeypatch) -> Path:
    """The folder of a run with a checkpoint, and a later one that has no model, as -optimize leaves it."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    settings = ["--dataset", DATASET_ID, "--eval-freq", "-1", "--save-freq", "3"]
    assert main(tiny_training("dtfm", *settings)) == 0
    (workplace / "logs" / "dtfm" / "HalfCheetah-v5_10").mkdir()
    return Path("logs", "dtfm", "HalfCheetah-v5_1")


def frames(path: Path) -> list[np.ndarray]:
    """Frames of a GIF."""
    with Image.open(path) as image:
        pictures = []
        for i in range(image.n_frames):
            image.seek(i)
            pictures.append(np.asarray(image.convert("RGB")))
    return pictures


def test_the_latest_model_is_filmed_without_a_screen_and_any_setting(trained, capsys):
    assert main([*VIDEO]) == 0
    video = trained / "videos" / "final-model-dtfm-HalfCheetah-v5-step-0-to-step-3.mp4"
    assert f"Video: {video}" in capsys.readouterr().out
    assert count_frames_and_secs(video)[0] == 4
    assert [path.name for path in video.parent.iterdir()] == [video.name]


def test_a_gif_of_a_training_shows_all_its_models_with_their_names(trained):
    assert main([*VIDEO, "--training", "-o", "all.gif"]) == 0
    pictures = frames(Path("all.gif"))
    assert len(pictures) >= 3
    assert pictures[0].shape == (64, 96, 3)
    title = [picture[:32] for picture in (pictures[0], pictures[-1])]
    assert all(part.max() > 200 for part in title), "white letters"
    assert not np.array_equal(*title)


def test_the_environment_is_that_of_the_runs_settings(tmp_path):
    (tmp_path / "Pendulum-v1").mkdir()
    for name, values in {"config.yml": {"env_kwargs": {"g": 5.0}}, "args.yml": {}}.items():
        (tmp_path / "Pendulum-v1" / name).write_text(yaml.dump(OrderedDict(values)))
    model = FoundModel("final-model", "model.zip", str(tmp_path))
    assert with_env_kwargs(model, ["-n", "3"]) == ["-n", "3", "--env-kwargs", "g:5.0"]
    assert with_env_kwargs(model._replace(run=str(tmp_path / "elsewhere")), ["-n", "3"]) == ["-n", "3"]
    assert with_env_kwargs(model, ["--env-kwargs", "g:1.0"]) == ["--env-kwargs", "g:5.0", "g:1.0"], "the last one counts"


def test_agents_of_rl_zoo_are_filmed_too(workplace):
    arguments = ["--algo", "sac", "--env", "HalfCheetah-v5"]
    assert main(["train", *arguments, "-n", "12", "--eval-freq", "-1", "-params", "learning_starts:10"]) == 0
    assert main(["video", *arguments, "-n", "2", "-g"]) == 0
    (video,) = Path("logs/sac/HalfCheetah-v5_1/videos").iterdir()
    assert video.name == "final-model-sac-HalfCheetah-v5-step-0-to-step-2.gif"
    assert frames(video)[0].std() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--load-best"], "No model found for dtfm on HalfCheetah-v5, path: logs/dtfm/HalfCheetah-v5_10/best_model.zip"),
        (["--algo", "DTFM"], "--algo DTFM (did you mean dtfm?)"),
        (["--exp-id", "7"], "The logs/dtfm/HalfCheetah-v5_7 folder was not found"),
        (["--gym-packages", "no_such_tasks"], "--gym-packages no_such_tasks"),
    ],
)
def test_a_mistake_ends_in_one_line(arguments, message, trained, capsys):
    assert main([*VIDEO, *arguments]) == 2
    assert message in capsys.readouterr().err.strip().splitlines()[-1]


def test_where_nothing_draws_the_error_says_what_to_install(trained, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")  # which OSMesa refuses
    assert main(VIDEO) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "MUJOCO_GL=osmesa does not work here" in error
    assert "libegl1 or libosmesa6" in error
    assert not (trained / "videos").exists()


@pytest.mark.slow
def test_an_arm_of_robosuite_is_filmed(workplace, monkeypatch):
    """In a process of its own, where MuJoCo has been imported before anything was chosen."""
    env = ReturnToGoWrapper(gym.make("robosuite/Lift-v0"), target_return=1.0)
    observation, _ = env.unwrapped.reset(seed=0)
    episode = Trajectory(np.stack([observation] * 3), np.zeros((3, 7)), np.zeros(3))
    buffer = TrajectoryBuffer.from_trajectories([episode], env.action_space)
    model = DTFM("MultiInputPolicy", env, buffer, device="cpu", policy_kwargs=TINY_FLOW_POLICY)
    run = workplace / "logs" / "dtfm" / "robosuite-Lift-v0_1"
    model.save(run / "robosuite-Lift-v0.zip")
    settings = run / "robosuite-Lift-v0"
    settings.mkdir()
    wrapper = {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}
    (settings / "config.yml").write_text(yaml.safe_dump({"env_wrapper": [wrapper]}))
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
    command = [sys.executable, "-m", "sb3_dtfm", "video", "--algo", "dtfm", "--env", "robosuite/Lift-v0", "-n", "2"]
    result = subprocess.run([*command, "-o", "lift.gif"], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert frames(Path("lift.gif"))[0].shape == (256, 256, 3)
    assert frames(Path("lift.gif"))[0].std() > 10


@pytest.mark.slow
def test_one_renderer_at_least_works_here_and_an_unknown_one_does_not(monkeypatch):
    assert any(map(rendering._works, rendering.RENDERERS))
    assert not rendering._works("etch-a-sketch")
