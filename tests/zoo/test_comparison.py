"""What `train` and `enjoy` say of a model beside what it learned from."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from huggingface_sb3 import EnvironmentName
from stable_baselines3.common.env_util import make_vec_env

from sb3_dtfm.algorithms import DT
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import ReturnReference
from sb3_dtfm.files import read_configuration
from sb3_dtfm.zoo.comparison import MeasureRandomActions, compare, four_digits
from tests.recorded import DATASET_ID, tiny_training

HOPPER = EnvironmentName("Hopper-v5")


@pytest.fixture
def run(tmp_path):
    """A run's folder that says which dataset was learned from."""
    (tmp_path / HOPPER).mkdir()
    (tmp_path / HOPPER / "config.yml").write_text(yaml.dump({"dataset": "local/hopper-v0"}))
    return tmp_path


def model(reference, **policy_kwargs) -> dict:
    return {"return_reference": reference, "policy_kwargs": policy_kwargs, "_total_timesteps": 2000}


def test_the_share_of_what_was_recorded_and_what_to_try(run):
    reference = ReturnReference(3727.0, 3734.0, 60, random=18.0)
    assert compare(model(list(reference)), [2000.0, 2356.0], [], run, HOPPER) == [
        "Recorded 3,727 (best tenth 3,734), random 18, reached 2,178: 58 % of what was recorded.",
        "Longer training may help: -n 4000 instead of 2000.",
        f"Which return is best to ask for: sb3-dtfm sweep {run} --env Hopper-v5 --dataset local/hopper-v0",
    ]
    assert len(compare(model(reference), [3500.0], [], run, HOPPER)) == 1, "94 % are enough"
    few = model(reference._replace(n_episodes=20), dropout=0.0)
    assert "20 episodes" in compare(few, [2178.0], [], run, HOPPER)[1]
    assert "-params dropout:0.1" in compare(few, [2178.0], [], run, HOPPER)[1]
    assert "-n 4000" in compare({**few, "policy_kwargs": {"dropout": 0.1}}, [2178.0], [], run, HOPPER)[1]


def test_success_decides_where_both_tell_of_it(run):
    reference = ReturnReference(1.0, 1.0, 200, success_rate=0.5, random=0.0)
    first, second = compare(model(reference), [0.0, 1.0], [False, True], run, HOPPER)
    assert first == "Recorded 1 (best tenth 1), random 0, reached 0.5: 50 % of what was recorded."
    assert second == "50 % of the recorded episodes succeeded, 50 % of these."
    assert len(compare(model(reference), [1.0] * 5, [True, *[False] * 4], run, HOPPER)) == 4


def test_nothing_is_said_that_is_not_known(run):
    assert compare({}, [1.0], [], run, HOPPER) == compare(model(None), [1.0], [], run, HOPPER) == []
    assert compare(model(ReturnReference(2.0, 3.0, 9)), [], [], run, HOPPER) == []
    assert compare(model(ReturnReference(2.0, 3.0, 9)), [1.0], [], run, HOPPER) == ["Recorded 2 (best tenth 3), reached 1."]
    assert len(compare(model(ReturnReference(2.0, 3.0, 9, random=5.0)), [1.0], [], run, HOPPER)) == 1


def test_numbers_have_four_digits():
    assert [four_digits(x) for x in (3727.12, 12345.6, -0.123456, 0.0)] == ["3,727", "12,350", "-0.1235", "0"]


class Paid(gym.Env):
    """Seven steps, each of which pays the action."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(0.5, 1.5, (1,))

    def reset(self, *, seed=None, options=None):
        self.n_steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        return np.zeros(1, np.float32), float(action[0]), self.n_steps == 7, False, {}


def test_random_actions_are_measured():
    learner = SimpleNamespace(return_reference=ReturnReference(10.0, 10.0, 3))
    callback = MeasureRandomActions([SimpleNamespace(eval_env=make_vec_env(Paid, 2))], seed=0)
    callback.model = learner
    callback._on_training_start()
    assert learner.return_reference.random == pytest.approx(7.0, abs=1.0)
    assert learner.return_reference.random != pytest.approx(7.0, abs=1e-6)


def test_train_and_enjoy_compare_with_the_data(workplace, capsys):
    training = [*tiny_training("dt"), "--dataset", DATASET_ID, "--target-return", "5", "--eval-episodes", "2"]
    assert main([*training, "--eval-freq", "2"]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Recorded ")]
    assert len(said) == 1
    run = "logs/dt/HalfCheetah-v5_1"
    for name in ("HalfCheetah-v5", "best_model"):
        reference = DT.load(f"{run}/{name}").return_reference
        assert isinstance(reference, ReturnReference)
        assert reference.n_episodes == 3
        assert f"Recorded {four_digits(reference.recorded)} " in said[0]
        assert f"random {four_digits(reference.random)}, " in said[0]
    assert read_configuration(f"{run}/HalfCheetah-v5.zip")["attributes"]["return_reference"] == list(reference)
    enjoy = ["enjoy", "--algo", "dt", "--env", "HalfCheetah-v5", "--no-render", "-n"]
    assert main([*enjoy, "40"]) == 0
    last = capsys.readouterr().out.split("Recorded ")[1]
    assert last.startswith(said[0].removeprefix("Recorded ").split("reached")[0])
    assert main([*enjoy, "5"]) == 0
    assert capsys.readouterr().out.endswith("HalfCheetah-v5.zip\n"), "no episode has ended"
    model = DT.load(f"{run}/HalfCheetah-v5")
    model.return_reference = None
    model.save(f"{run}/HalfCheetah-v5")
    assert main([*enjoy, "40"]) == 0
    assert "Recorded" not in capsys.readouterr().out, "a model of an earlier version"


def test_measuring_changes_no_evaluation(workplace, monkeypatch):
    training = [*tiny_training("dt"), "--dataset", DATASET_ID, "--target-return", "5", "--eval-freq", "2", "--seed", "3"]
    assert main(training) == 0
    monkeypatch.setattr(MeasureRandomActions, "_on_training_start", lambda self: None)
    assert main(training) == 0
    first, second = (np.load(f"logs/dt/HalfCheetah-v5_{n}/evaluations.npz")["results"] for n in (1, 2))
    np.testing.assert_array_equal(first, second)
