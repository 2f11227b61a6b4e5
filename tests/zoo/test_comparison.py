"""Comparison of a model with its data, as `train` and `enjoy` print it."""

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


def model(reference, target_return=None, **policy_kwargs) -> dict:
    attributes = {"return_reference": reference, "target_return": target_return}
    return {**attributes, "policy_kwargs": policy_kwargs, "_total_timesteps": 2000}


def test_the_share_of_the_target_return_and_what_to_try(run):
    """Agents of mixed quality: a model with the best one's target return missed it, although it is above the mean."""
    reference = ReturnReference(1800.0, 3734.0, 3790.0, 60, random=18.0)
    assert compare(model(list(reference), 3734.0), [2000.0, 2356.0], [], run, HOPPER) == [
        "Recorded 1,800 (best tenth 3,734), random 18, target return 3,734, reached 2,178: 58 % of the target return.",
        "Longer training may help: -n 4000 instead of 2000.",
        f"A sweep shows the best target return: sb3-dtfm sweep {run} --env Hopper-v5 --dataset local/hopper-v0",
    ]
    assert len(compare(model(reference, 3734.0), [3500.0], [], run, HOPPER)) == 1, "94 % are enough"


def test_a_target_beyond_the_data_is_compared_with_the_best_tenth(run):
    reference = ReturnReference(11490.0, 11700.0, 11750.0, 99, random=-280.0)
    (said,) = compare(model(reference, 20000.0), [11400.0], [], run, HOPPER)
    assert said.endswith("random -280, target return 20,000, reached 11,400: 97 % of the best tenth.")


def test_a_model_that_looks_at_no_target_return_is_compared_with_the_mean(run):
    copies = model(ReturnReference(92.0, 94.0, 94.5, 60, random=-8.0), 50.0, return_conditioning=False)
    (said,) = compare(copies, [92.0], [], run, HOPPER)
    assert said == "Recorded 92 (best tenth 94), random -8, reached 92: 100 % of the recorded mean."
    _, to_try = compare(copies, [42.0], [], run, HOPPER)
    assert to_try.startswith("Longer training"), "a sweep would show nothing"


def test_success_is_said_beside_the_share_of_the_target_return(run):
    """Half of the demonstrations fail; the target return is success."""
    reference = ReturnReference(0.5, 1.0, 1.0, 200, success_rate=0.5, random=0.0)
    first, second, *to_try = compare(model(reference, 1.0), [0.0, 1.0], [False, True], run, HOPPER)
    assert first.endswith("target return 1, reached 0.5: 50 % of the target return.")
    assert second == "50 % of the recorded episodes succeeded, 50 % of these."
    assert len(to_try) == 2
    assert len(compare(model(reference, 1.0), [1.0], [True], run, HOPPER)) == 2


def test_nothing_is_said_that_is_not_known(run):
    reference = ReturnReference(2.0, 3.0, 3.5, 9)
    assert compare({}, [1.0], [], run, HOPPER) == compare(model(None), [1.0], [], run, HOPPER) == []
    assert compare(model(reference), [], [], run, HOPPER) == []
    assert compare(model(reference), [1.0], [], run, HOPPER) == ["Recorded 2 (best tenth 3), reached 1."]
    assert len(compare(model(reference._replace(random=5.0), 3.0), [1.0], [], run, HOPPER)) == 1


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
    learner = SimpleNamespace(return_reference=ReturnReference(10.0, 10.0, 10.0, 3))
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
