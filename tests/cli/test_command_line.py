"""Train, enjoy, record and plot through the command line, as a user types them."""

import numpy as np
import pytest
import yaml

from sb3_dtfm import DT, DTFM
from sb3_dtfm.cli.main import main
from tests.zoo.conftest import DATASET_ID, TINY, tiny_training

ALGORITHMS = {"dt": DT, "dtfm": DTFM}
ENJOY = ["--env", "HalfCheetah-v5", "--no-render", "-n", "40"]


def train(algo: str, *arguments: str) -> int:
    return main(tiny_training(algo, "--dataset", DATASET_ID, *arguments))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_train_writes_what_enjoy_reads(algo, workplace, capsys):
    assert (
        train(algo, "--conf-file", "small", "--eval-freq", "2", "--eval-episodes", "1", "--save-freq", "3", "-tb", "tb") == 0
    )
    run = workplace / "logs" / algo / "HalfCheetah-v5_1"
    names = {"HalfCheetah-v5.zip", "best_model.zip", "evaluations.npz", "rl_model_3_steps.zip"}
    assert names <= {path.name for path in run.iterdir()}
    assert {path.name for path in (run / "HalfCheetah-v5").iterdir()} == {"config.yml", "args.yml", "command.txt"}
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [2, 4]
    assert ALGORITHMS[algo].load(run / "HalfCheetah-v5.zip").num_timesteps == 4

    for choice in ([], ["--load-best", "--exp-id", "1"], ["--load-checkpoint", "3", "-f", str(workplace / "logs")]):
        capsys.readouterr()
        assert main(["enjoy", "--algo", algo, *ENJOY, *choice]) == 0
        assert "2 Episodes\n" in capsys.readouterr().out

    assert main(["plot", str(run), "--tensorboard", str(next((workplace / "tb").glob("*/*_1")))]) == 0
    assert (run / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_trained_agent_goes_on_training(workplace, capsys):
    assert train("dtfm", "--eval-freq", "-1", "--conf-file", "small") == 0
    first = workplace / "logs" / "dtfm" / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip"
    assert train("dtfm", "--eval-freq", "-1", "--conf-file", "small", "--trained-agent", str(first)) == 0
    assert "Loading pretrained agent" in capsys.readouterr().out
    second = workplace / "logs" / "dtfm" / "HalfCheetah-v5_2" / "HalfCheetah-v5.zip"
    before, after = DTFM.load(first), DTFM.load(second)
    assert (before._n_updates, after._n_updates) == (4, 8)
    steps = [int(next(iter(model.policy.optimizer.state.values()))["step"]) for model in (before, after)]
    assert steps == [4, 8]


def test_a_configuration_file_of_the_users_own_and_an_environment_it_does_not_list(workplace):
    settings = {"default": {"policy": "MultiInputPolicy", "n_timesteps": 2, "context_length": 3}}
    (workplace / "mine.yml").write_text(yaml.safe_dump(settings))
    assert train("dt", "--conf-file", "mine.yml", "--target-return", "50", "--eval-freq", "-1") == 0
    model = DT.load(workplace / "logs" / "dt" / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip")
    assert (model.context_length, model.batch_size) == (3, 4)


def test_rl_zoos_own_algorithms_still_train(workplace):
    arguments = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "20", "--eval-freq", "-1", "-params", "learning_starts:10"]
    assert main(["train", *arguments]) == 0
    assert (workplace / "logs" / "sac" / "Pendulum-v1_1" / "Pendulum-v1.zip").is_file()


def test_hyperparameters_can_be_searched(workplace, capsys):
    small_model = ["--seed", "1"]
    search = [
        "--optimize-hyperparameters",
        "--n-trials",
        "1",
        "--n-evaluations",
        "1",
        "--eval-episodes",
        "1",
        "--no-optim-plots",
    ]
    assert train("dtfm", *search, *small_model) == 0
    assert "Best trial:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (tiny_training("dtfm", "--dataset", "no/such/file.hdf5"), "no/such/file.hdf5"),
        (
            tiny_training("dtfm", "--dataset", DATASET_ID, "--dataset-fraction", "2"),
            "dataset_fraction must lie in (0, 1], got 2",
        ),
        (tiny_training("dtfm", "--dataset", DATASET_ID, "--conf-file", "absent.yml"), "absent.yml: No such file"),
        (["train", "--algo", "dtfm", "--env", "HalfCheeta-v5"], "HalfCheetah-v5"),
        (
            ["train", "--algo", "dtfm", "--env", "Hopper-v5", "--dataset", DATASET_ID],
            "--target-return: needed for Hopper-v5",
        ),
        (tiny_training("dt", "env_wrapper:None", "--dataset", DATASET_ID), "ReturnToGoWrapper"),
        (["enjoy", "--algo", "dtfm", *ENJOY], "logs/dtfm"),
        (["plot", "nowhere"], "nowhere/evaluations.npz does not exist"),
    ],
)
def test_a_mistake_ends_in_one_clear_line(arguments, message, workplace, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"sb3-dtfm {arguments[0]}: error: ")
    assert message in error
    assert not list(workplace.glob("logs/*/*")), "no folder where `enjoy` would look for a run"


def test_debug_shows_the_traceback(workplace):
    with pytest.raises(FileNotFoundError):
        main(["--debug", "plot", "nowhere"])


def test_an_error_in_the_midst_of_training_keeps_its_traceback(workplace, monkeypatch):
    def fail(*_):
        raise ValueError("halfway")

    monkeypatch.setattr(DTFM, "_gradient_step", fail)
    with pytest.raises(ValueError, match="halfway"):
        train("dtfm", "--conf-file", "small", "--eval-freq", "-1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo", "sac"], "--model, --env, --dataset-id: required without --demonstrator"),
        (["--demonstrator", "lift"], "--output: required with --demonstrator lift"),
        (
            ["--demonstrator", "lift", "--output", "x", "--stochastic", "--n-envs", "1"],
            "--stochastic, --n-envs: not used with",
        ),
        (
            ["--algo", "sac", "--model", "m", "--env", "E", "--dataset-id", "i", "--workers", "1"],
            "--workers: not used without",
        ),
        (["--demonstrator", "door"], "invalid choice: 'door'"),
        (["--demonstrator", "lift", "--output", "x", "--episodes", "0"], "--episodes: must be at least 1, got 0"),
    ],
)
def test_record_says_which_arguments_belong_together(arguments, message, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["record", "--episodes", "1", *arguments])
    assert exit_.value.code == 2
    assert message in capsys.readouterr().err


def test_help_names_the_additions_and_rl_zoos_options(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", "--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    for option in ("--dataset-fraction", "--target-return", "--optimize-hyperparameters", "'small'"):
        assert option in text


def test_every_algorithm_has_a_tiny_policy():
    assert set(TINY) == set(ALGORITHMS)
