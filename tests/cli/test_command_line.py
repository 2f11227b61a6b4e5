"""Train, enjoy, record and plot through the command line, as a user types them."""

import shutil

import minari
import numpy as np
import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dtfm import DT, DTFM
from sb3_dtfm.cli.main import COMMANDS, main
from sb3_dtfm.zoo.manager import TrainingError
from tests.recorded import DATASET_ID, TINY, tiny_training

ALGORITHMS = {"dt": DT, "dtfm": DTFM}
ENJOY = ["--env", "HalfCheetah-v5", "--no-render", "-n", "40"]


def train(algo: str, *arguments: str) -> int:
    return main(tiny_training(algo, "--dataset", DATASET_ID, *arguments))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_train_writes_what_enjoy_reads(algo, workplace, capsys):
    assert train(algo, "--eval-freq", "2", "--eval-episodes", "1", "--save-freq", "3", "-tb", "tb") == 0
    run = workplace / "logs" / algo / "HalfCheetah-v5_1"
    names = {"HalfCheetah-v5.zip", "best_model.zip", "evaluations.npz", "rl_model_3_steps.zip"}
    assert names <= {path.name for path in run.iterdir()}
    assert {path.name for path in (run / "HalfCheetah-v5").iterdir()} == {"config.yml", "args.yml", "command.txt"}
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [0, 2, 4]
    assert ALGORITHMS[algo].load(run / "HalfCheetah-v5.zip").num_timesteps == 4

    for choice in ([], ["--load-best", "--exp-id", "1"], ["--load-checkpoint", "3", "-f", str(workplace / "logs")]):
        capsys.readouterr()
        assert main(["enjoy", "--algo", algo, *ENJOY, *choice]) == 0
        assert "2 Episodes\n" in capsys.readouterr().out
    assert main(["enjoy", "--algo", algo, *ENJOY, "--n-envs", "2"]) == 0, "in processes of their own, which RL-Zoo closes"
    assert "Recorded" in capsys.readouterr().out

    assert main(["plot", str(run), "--tensorboard", str(next((workplace / "tb").glob("*/*_1")))]) == 0
    assert (run / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_trained_agent_goes_on_training(workplace, capsys):
    assert train("dtfm", "--eval-freq", "-1") == 0
    first = workplace / "logs" / "dtfm" / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip"
    assert train("dtfm", "--eval-freq", "-1", "--trained-agent", str(first)) == 0
    assert "Loading pretrained agent" in capsys.readouterr().out
    second = workplace / "logs" / "dtfm" / "HalfCheetah-v5_2" / "HalfCheetah-v5.zip"
    before, after = DTFM.load(first), DTFM.load(second)
    assert (before._n_updates, after._n_updates) == (4, 8)
    steps = [int(next(iter(model.policy.optimizer.state.values()))["step"]) for model in (before, after)]
    assert steps == [4, 8]


def test_a_trained_agent_goes_on_training_with_evaluations_on_a_scale_of_scores(workplace, minari_folder, monkeypatch):
    shutil.copytree(minari_folder, workplace / "scored")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(workplace / "scored"))
    minari.load_dataset(DATASET_ID).storage.update_metadata({"ref_min_score": -100.0, "ref_max_score": 100.0})
    settings = ["--eval-freq", "2", "--eval-episodes", "1", "-tb", "tb"]
    assert train("dt", *settings) == 0
    runs = workplace / "logs" / "dt"
    assert train("dt", *settings, "--trained-agent", str(runs / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip")) == 0
    logs = [EventAccumulator(str(workplace / "tb" / "HalfCheetah-v5" / f"DT_{n}")).Reload() for n in (1, 2)]
    scores = [{event.step: event.value for event in log.Scalars("eval/normalized_score")} for log in logs]
    means = [np.load(runs / f"HalfCheetah-v5_{n}" / "evaluations.npz")["results"][:, 0] for n in (1, 2)]
    assert [list(score) for score in scores] == [[0, 2, 4], [0, 2, 4]]
    assert [list(score.values()) for score in scores] == [pytest.approx((mean + 100) / 200) for mean in means]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_callback_of_the_users_own_runs_beside_the_evaluation(algo, workplace):
    callback = "callback:{'stable_baselines3.common.callbacks.CheckpointCallback':dict(save_freq=3,save_path='mine')}"
    assert train(algo, "-params", callback, "--eval-freq", "3", "--eval-episodes", "1") == 0
    assert [path.name for path in (workplace / "mine").iterdir()] == ["rl_model_3_steps.zip"]
    run = workplace / "logs" / algo / "HalfCheetah-v5_1"
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [0, 3, 4]


def test_a_configuration_file_of_the_users_own_and_an_environment_it_does_not_list(workplace):
    settings = {"default": {"policy": "MultiInputPolicy", "n_timesteps": 2, "context_length": 3}}
    (workplace / "mine.yml").write_text(
        yaml.safe_dump(settings).replace("n_timesteps", "learning_rate: 3e-4\n  n_timesteps")
    )
    assert isinstance(yaml.safe_load("3e-4"), str), "YAML takes it for text"
    assert train("dt", "--conf-file", "mine.yml", "--target-return", "50", "--eval-freq", "-1") == 0
    model = DT.load(workplace / "logs" / "dt" / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip")
    assert (model.context_length, model.batch_size) == (3, 4)
    assert model.lr_schedule(1.0) == 3e-4


def test_rl_zoos_own_algorithms_still_train(workplace):
    arguments = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "20", "--eval-freq", "15", "-params", "learning_starts:10"]
    assert main(["train", *arguments]) == 0
    run = workplace / "logs" / "sac" / "Pendulum-v1_1"
    assert (run / "Pendulum-v1.zip").is_file()
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [15], "as RL-Zoo evaluates"


def test_hyperparameters_can_be_searched(workplace, capsys):
    small_model = ["--seed", "30"]
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
            "--dataset-fraction must be a number in (0, 1], got 2.0",
        ),
        (tiny_training("dtfm", "--dataset", DATASET_ID, "--conf-file", "absent.yml"), "absent.yml: No such file"),
        (["train", "--algo", "dtfm", "--env", "HalfCheeta-v5"], "HalfCheetah-v5"),
        (
            ["train", "--algo", "dtfm", "--env", "Hopper-v5"],
            "--dataset: needed for Hopper-v5",
        ),
        (
            tiny_training("dt", "--dataset", DATASET_ID, "--env", "Walker2d-v5"),
            "was recorded in HalfCheetah-v5, and the environment is Walker2d-v5",
        ),
        (tiny_training("dt", "foo:1", "--dataset", DATASET_ID), "error: foo: no hyperparameter of dt."),
        (
            tiny_training("dt", "bach_size:8", "n_timestep:3", "--dataset", DATASET_ID),
            "error: bach_size (did you mean batch_size?), n_timestep (did you mean n_timesteps?): no hyperparameter of dt.",
        ),
        (
            ["train", "--algo", "sac", "--env", "Pendulum-v1", "-n", "20", "-params", "learning_start:5"],
            "error: learning_start (did you mean learning_starts?): no hyperparameter of sac.",
        ),
        (tiny_training("dt", "gamma", "--dataset", DATASET_ID), "-params gamma: expected key:value with a value in Python"),
        (
            tiny_training(
                "dtfm", "policy_kwargs:dict(one_step_policy=False,flow_solver='one_step')", "--dataset", DATASET_ID
            ),
            "flow_solver='one_step' needs a model that was trained with policy_kwargs=dict(one_step_policy=True)",
        ),
        (
            ["enjoy", "--algo", "dtfm", *ENJOY],
            "The logs/dtfm folder was not found. -f names the folder that train wrote to, --exp-id the run in it.",
        ),
        (["plot", "nowhere"], "nowhere/evaluations.npz does not exist"),
    ],
)
def test_a_mistake_ends_in_one_clear_line(arguments, message, workplace, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"sb3-dtfm {arguments[0]}: error: ")
    assert message in error
    assert not list(workplace.glob("logs/*/*")), "no folder where `enjoy` would look for a run"


def test_enjoy_says_where_it_looked_for_a_model_that_the_run_does_not_have(workplace, capsys):
    (workplace / "logs" / "dt" / "HalfCheetah-v5_1").mkdir(parents=True)
    assert main(["enjoy", "--algo", "dt", *ENJOY, "--load-best"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(
        "sb3-dtfm enjoy: error: No model found for dt on HalfCheetah-v5, path: logs/dt/HalfCheetah-v5_1/"
    )
    assert error.endswith("-f names the folder that train wrote to, --exp-id the run in it.")


def test_debug_shows_the_traceback(workplace):
    with pytest.raises(FileNotFoundError):
        main(["--debug", "plot", "nowhere"])


def test_an_error_in_the_midst_of_training_keeps_its_traceback_and_its_run(workplace):
    callback = "callback:{'stable_baselines3.common.callbacks.CheckpointCallback':dict(save_freq=3,save_path='/proc/none')}"
    with pytest.raises(TrainingError, match="after 0 timesteps: FileNotFoundError") as error:
        train("dtfm", "-params", callback, "--eval-freq", "-1")
    assert isinstance(error.value.__cause__, FileNotFoundError)
    assert (workplace / "logs" / "dtfm" / "HalfCheetah-v5_1" / "HalfCheetah-v5" / "config.yml").is_file()


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
    for option in ("--dataset-fraction", "--target-return", "--optimize-hyperparameters", "'paper'"):
        assert option in text


def test_help_lists_all_commands_and_each_has_a_module(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    for command, description in COMMANDS.items():
        assert f"  {command:10}{description}" in text
        with pytest.raises(SystemExit) as exit_:
            main([command, "--help"])
        assert exit_.value.code == 0
        assert f"usage: sb3-dtfm {command}" in capsys.readouterr().out


def test_every_algorithm_has_a_tiny_policy():
    assert set(TINY) == set(ALGORITHMS)
