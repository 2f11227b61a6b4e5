"""A run whose settings have no target return: the data decide it, and all who act with the model read it from the run."""

import signal

import gymnasium as gym
import pytest
import yaml

from sb3_dtfm import DT
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import load_dataset
from sb3_dtfm.data.inspection import suggested_target_return
from sb3_dtfm.files import read_run
from sb3_dtfm.recording.loading import find_agent
from sb3_dtfm.zoo.comparison import four_digits
from tests.recorded import DATASET_ID, tiny_training

RUN = "logs/dt/HalfCheetah-v5_1"
WRAPPER = "sb3_dtfm.envs.ReturnToGoWrapper"
SCALE = {"gymnasium.wrappers.RescaleAction": {"min_action": -1.0, "max_action": 1.0}}
ENJOY = ["enjoy", "--algo", "dt", "--env", "HalfCheetah-v5", "--no-render", "-n", "20"]


def train(settings: dict, *arguments: str) -> int:
    """Four gradient steps with a YAML file of its own."""
    with open("own.yml", "w") as file:
        own = {"policy": "MultiInputPolicy", "n_timesteps": 4, "return_conditioning": True, **settings}
        yaml.safe_dump({"default": own}, file)
    return main(tiny_training("dt", "--dataset", DATASET_ID, "--conf-file", "own.yml", *arguments))


@pytest.mark.parametrize(
    ("settings", "before"),
    [({}, []), ({"env_wrapper": [WRAPPER]}, []), ({"env_wrapper": [SCALE]}, [SCALE]), ({"env_wrapper": None}, [])],
)
def test_the_run_of_an_entry_without_a_target_return_has_one(settings, before, workplace, capsys):
    suggested = suggested_target_return(load_dataset(DATASET_ID, max_episode_steps=20))
    assert train(settings, "--eval-freq", "-1") == 0
    assert f"The environment has target_return={suggested:g}, as `sb3-dtfm inspect` suggests" in capsys.readouterr().out
    assert read_run(workplace / RUN / "HalfCheetah-v5")["env_wrapper"] == [*before, {WRAPPER: {"target_return": suggested}}]
    assert main(ENJOY) == 0
    assert f"target return {four_digits(suggested)}, reached" in capsys.readouterr().out
    assert main([*ENJOY, "--target-return", "-7"]) == 0
    assert "target return -7, reached" in capsys.readouterr().out
    wrapped = find_agent(RUN, "HalfCheetah-v5").wrapper(gym.make("HalfCheetah-v5"))
    assert wrapped.get_wrapper_attr("target_return") == suggested, "for sweep, push, video and record"


def test_a_target_return_that_is_given_stays(workplace):
    assert train({}, "--eval-freq", "-1", "--target-return", "5") == 0
    assert read_run(workplace / RUN / "HalfCheetah-v5")["env_wrapper"] == [{WRAPPER: {"target_return": 5.0}}]
    assert DT.load(f"{RUN}/HalfCheetah-v5").target_return == 5.0


def test_evaluations_and_searches_need_no_target_return(workplace, capsys):
    assert train({}, "--eval-freq", "2", "--eval-episodes", "1") == 0
    assert "target return" in capsys.readouterr().out.splitlines()[-1]
    search = ["--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots", "--seed", "30"]
    assert train({}, "--optimize-hyperparameters", *search) == 0
    assert "Best trial:" in capsys.readouterr().out


def test_a_resumed_run_keeps_the_target_return(workplace):
    interrupt = {"tests.zoo.test_resuming.SignalAt": {"step": 2, "number": int(signal.SIGINT)}}
    assert train({"callback": [interrupt]}, "--eval-freq", "-1") == 0
    before = read_run(workplace / RUN / "HalfCheetah-v5")
    assert DT.load(f"{RUN}/HalfCheetah-v5").num_timesteps < 4
    assert main(["train", "--resume", RUN]) == 0
    assert read_run(workplace / RUN / "HalfCheetah-v5") == before
    assert DT.load(f"{RUN}/HalfCheetah-v5").num_timesteps == 4
