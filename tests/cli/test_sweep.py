"""Target return against return reached: real models, real episodes."""

import json
import re
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure

from sb3_dtfm.cli.main import main
from sb3_dtfm.cli.sweep import Reached, chance, distinguished, draw, evenly, finding, table
from tests.recorded import DATASET_ID, tiny_training

SWEEP = ["--env", "HalfCheetah-v5", "--dataset", DATASET_ID, "--episodes", "2", "--env-kwargs", "max_episode_steps:20"]


def test_two_models_get_target_returns_over_the_range_of_their_data(workplace, capsys):
    for algo in ("dt", "dtfm"):
        assert main([*tiny_training(algo), "--dataset", DATASET_ID, "--eval-freq", "-1", "--target-return", "5"]) == 0
    capsys.readouterr()
    runs = ["logs/dt/HalfCheetah-v5_1", "logs/dtfm/HalfCheetah-v5_1/HalfCheetah-v5.zip"]
    assert main(["sweep", *runs, *SWEEP, "--points", "3", "-o", "figures/sweep.png"]) == 0
    text = capsys.readouterr().out
    header, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    assert header == "| target return | DT, HalfCheetah-v5_1 | DTFM, HalfCheetah-v5 |"
    assert len(rows) == 3
    assert all(re.fullmatch(r"\| -?[\d.]+ \|( -?[\d.]+ \[-?[\d.]+, -?[\d.]+\] \|){2}", row) for row in rows)
    found = [line for line in text.splitlines() if line.startswith("- ")]
    assert [line.split(": ")[0] for line in found] == ["- DT, HalfCheetah-v5_1", "- DTFM, HalfCheetah-v5"]
    assert all("It takes more episodes" in line for line in found), "two episodes tell nothing"
    assert (workplace / "figures" / "sweep.png").stat().st_size > 10_000
    numbers = json.loads((workplace / "figures" / "sweep.json").read_text())
    assert numbers["task"] == "HalfCheetah-v5"
    assert [list(numbers["models"]), numbers["commit"][:40].isalnum()] == [
        ["DT, HalfCheetah-v5_1", "DTFM, HalfCheetah-v5"],
        True,
    ]
    means = [f"{np.mean(each['returns']):,.6g}" for each in numbers["models"]["DTFM, HalfCheetah-v5"]]
    assert [row.split("|")[3].split()[0] for row in rows] == means
    shutil.copy(runs[1], "model.zip")
    twice = ["model.zip", "model.zip", "--algo", "dtfm"]
    assert main(["sweep", *twice, *SWEEP, "--returns", "1", "2", "-o", "figures/again.png"]) == 0
    header, _, *rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert header == "| target return | 1: model.zip | 2: model.zip |"
    assert [row.split("|")[1].strip() for row in rows] == ["1", "2"]
    assert all(first == second for _, _, first, second, _ in (row.split("|") for row in rows))
    assert json.loads((workplace / "figures" / "again.json").read_text())["acting"] == {}
    slower = [*twice, *SWEEP, "--returns", "1", "-o", "figures/slower.png", "--acting"]
    assert main(["sweep", *slower, "flow_steps:7"]) == 0
    (asked, _) = json.loads((workplace / "figures" / "slower.json").read_text())["models"].values()
    (as_saved, _) = json.loads((workplace / "figures" / "again.json").read_text())["models"].values()
    assert asked[0]["target"] == as_saved[0]["target"]
    assert asked[0]["returns"] != as_saved[0]["returns"]
    assert main(["sweep", *slower, "flow_steps:-1"]) == 2
    assert main(["sweep", *slower, "speed:7"]) == 2
    errors = capsys.readouterr().err
    assert "--acting: flow_steps" in errors
    accepted = "n_action_steps, n_action_samples, sample_noise_std, temperature, kv_cache, flow_steps, flow_solver"
    assert f"--acting: speed: no way of acting; accepted are {accepted}." in errors


def test_long_paths_are_named_by_what_tells_them_apart():
    """A table and a legend have to hold them."""
    runs = [f"logs/can_seed{seed}/attempt-{seed}/dtfm/Can-v0.zip" for seed in (0, 1)]
    assert distinguished(runs) == ["can_seed0/attempt-0", "can_seed1/attempt-1"]
    assert distinguished(["a/model.zip", "a/model.zip"]) == ["model.zip", "model.zip"]
    assert distinguished(["model.zip", "runs/model.zip"]) == ["model.zip", "runs/model.zip"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.zip", "--algo", "dt", *SWEEP], "nowhere.zip does not exist; expected a file that a Stable-Baselines3"),
        (["model.zip", *SWEEP], "model.zip: of which algorithm? Expected a folder dt or dtfm in its path, or --algo."),
        (["dt/model.zip", *SWEEP, "--dataset", "none.npz"], "none.npz does not exist"),
        (
            ["dt/model.zip", *SWEEP, "--env", "Walker2d-v5"],
            "was recorded in HalfCheetah-v5, and the environment is Walker2d-v5",
        ),
        (["dt/model.zip", *SWEEP, "--gym-packages", "no_tasks"], "--gym-packages no_tasks: No module named 'no_tasks'"),
    ],
)
def test_what_is_not_there_is_named(arguments, message, workplace, capsys):
    (workplace / "dt").mkdir()
    for model in ("model.zip", "dt/model.zip"):
        (workplace / model).touch()
    assert main(["sweep", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_returns_to_ask_for_are_those_that_differ():
    assert evenly(np.array([0.001, 0.013]), 3) == [0.001, 0.007, 0.013]
    assert evenly(np.array([1.0, 1.0]), 9) == [1.0]
    assert evenly(np.array([-12.345, 11938.2]), 2) == [-12.35, 11940.0]


def test_the_table_and_the_picture_say_what_was_reached(tmp_path, monkeypatch):
    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **kwargs: drawn.append(figure) or save(figure, *args, **kwargs)
    )
    curves = {
        "DT": [Reached(1.0, [1.0, 3.0]), Reached(5.0, [4.0, 4.0])],
        "DTFM": [Reached(1.0, [1.0, 1.0]), Reached(5.0, [5.0, 5.0], [True, False])],
    }
    assert table(curves)[2:] == ["| 1 | 2 [-10.7062, 14.7062] | 1 |", "| 5 | 4 | 5, 1 of 2 solved |"]
    draw(curves, np.array([0.0, 1.0, 5.0]), tmp_path / "sweep.png", "HalfCheetah-v5")
    asked, *models = drawn[0].axes[0].lines
    assert asked.get_ydata().tolist() == [1, 5]
    assert [line.get_ydata().tolist() for line in models] == [[2, 4], [1, 5]]
    assert [text.get_text() for text in drawn[0].axes[0].get_legend().get_texts()] == ["target return", "DT", "DTFM"]


def asked(effect: float, n_episodes: int = 10, seed: int = 0, successes=None) -> list[Reached]:
    """A model whose return is the episode's start, of a standard deviation of 100, and a share of its target return."""
    starts = 100.0 * np.random.default_rng(seed).normal(size=n_episodes)
    targets = [500.0, 1000.0, 2000.0, 3700.0]
    told = [None] * len(targets) if successes is None else successes
    return [Reached(target, (starts + effect * target).tolist(), each) for target, each in zip(targets, told, strict=True)]


def test_a_model_that_follows_its_target_return_is_told_the_best():
    assert re.fullmatch(r"The best target return is 3700: it returned [\d,.]+ on average\.", finding(asked(1.0)))
    assert "The best target return is 500" in finding(asked(-1.0))
    solved = [[True] * n + [False] * (10 - n) for n in (1, 9, 2, 3)]
    assert "The best target return is 1000" in finding(asked(1.0, successes=solved)), "a success counts more than a return"
    assert finding(asked(1.0, successes=solved)).endswith("and solved 9 of 10.")


@pytest.mark.parametrize("effect", [0.0, 0.002, -0.002])
def test_a_model_that_follows_by_less_than_episodes_differ_copies(effect):
    """Even where each episode changes a little in the same direction, as deterministic acting from the same start does."""
    assert finding(asked(effect)) == (
        "A target return of 500 to 3,700 changes the return by less than its spread between episodes: "
        "this model copies the data whatever its target return."
    )


def test_few_episodes_say_nothing():
    more = "It takes more episodes to tell whether a target return of 500 to 3,700 changes the return: --episodes 20."
    assert [finding(asked(0.0, n)) for n in (1, 5)] == [more, more]


def test_chance_is_found_as_often_as_it_is_said_to_be():
    rng = np.random.default_rng(0)
    found = np.array([chance(rng.exponential(size=(5, 8))) for _ in range(200)])
    assert 0.01 <= (found < 0.05).mean() <= 0.1
    assert chance(np.ones((3, 9))) == 1.0
