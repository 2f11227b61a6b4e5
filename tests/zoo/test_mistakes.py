"""Mistakes on the command line: one line each, which says what to write instead, before anything is made."""

from pathlib import Path

import pytest

from sb3_dtfm.cli.main import main
from tests.recorded import DATASET_ID, tiny_training

ENJOY = ["enjoy", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--no-render", "-n", "5"]
TRAIN = [
    (["-n", "0"], "-n: must be at least 1, got 0"),
    (["-n", "-5"], "-n: must be at least 1, got -5"),
    (["-f", ""], "-f: expected a folder, got ''; . is the current one"),
    (["--eval-episodes", "0"], "--eval-episodes: must be at least 1, got 0"),
    (["--n-eval-envs", "0"], "--n-eval-envs: must be at least 1, got 0"),
    (["--trial-id", "0"], "--storage, --study-name: needed, too"),
    (["--storage", "sqlite:///s.db", "--study-name", "s"], "--trial-id: needed, too"),
    (["--algo", "DTFM"], "--algo DTFM (did you mean dtfm?)"),
    (["--device", "evil"], "--device evil: expected auto, cpu, cuda or cuda:N"),
    (["--target-return", "nan"], "--target-return: target_return must be a finite number"),
    (["--target-return=-1e300"], "got -1e+300. `sb3-dtfm inspect DATASET` suggests one"),
    (["--dataset-fraction", "nan"], "--dataset-fraction must be a number in (0, 1], got nan"),
    (["--gym-packages", "absent_tasks"], "--gym-packages absent_tasks: No module named 'absent_tasks'"),
    (["--env-kwargs", "a:float32"], "text needs quotes of its own: \"a:'float32'\""),
]
PARAMETERS = [
    ("precision:float32", "-params precision:float32: expected key:value with a value in Python"),
    ("precision:float32", "text needs quotes of its own: \"precision:'float32'\""),
    (":3", "there is no name before the colon"),
    ("foo:3", "foo: no hyperparameter of dtfm"),
    ("bach_size:3", "bach_size (did you mean batch_size?): no hyperparameter of dtfm"),
    ("n_envs:0", "n_envs must be a whole number of at least 1, got 0"),
    ("n_envs:'2'", "n_envs must be a whole number of at least 1, got '2'"),
    ("env_wrapper:5", "env_wrapper: 5; expected a dotted name in quotes"),
    ("env_wrapper:[{'a.b':4}]", "expected a dotted name in quotes, {name: {argument: value}}"),
    ("vec_env_wrapper:5", "vec_env_wrapper: expected the dotted name of a"),
    ("callback:5", "callback: expected the dotted name of a"),
    ("policy:5", "policy: expected the dotted name of a"),
    ("env_wrapper:['sb3_dtfm.envs.ReturnToGoWrapper',{'gymnasium.wrappers.TimeLimit':{'max_episode_steps':5}}]",
     "write ReturnToGoWrapper(TimeLimit(env, max_episode_steps=N))"),
]  # fmt: skip


def is_one_line(capsys, message: str) -> bool:
    error = capsys.readouterr().err.strip().splitlines()
    return len(error) == 1 and message in error[0]


@pytest.mark.parametrize(("arguments", "message"), TRAIN)
def test_a_mistake_of_train_is_one_line(arguments, message, workplace, capsys):
    assert main(tiny_training("dtfm", "--dataset", DATASET_ID, *arguments)) == 2
    assert is_one_line(capsys, message)
    assert not Path("logs").exists()


@pytest.mark.parametrize(("parameter", "message"), PARAMETERS)
def test_a_mistake_of_params_is_one_line(parameter, message, workplace, capsys):
    assert main(tiny_training("dtfm", parameter, "--dataset", DATASET_ID)) == 2
    assert is_one_line(capsys, message)
    assert not list(Path().glob("logs/dtfm/*"))


CONF_FILES = [
    ("- a\n- b\n", "mine.yml: expected a mapping by task, found ['a', 'b']"),
    ("HalfCheetah-v5:\n\tpolicy: x\n", "mine.yml: is not YAML: while scanning"),
    ("HalfCheetah-v5: 3\n", "mine.yml: HalfCheetah-v5: expected settings, found 3"),
    ("HalfCheetah-v5:\n", "mine.yml: HalfCheetah-v5: expected settings, found None"),
    ("default: [1]\n", "mine.yml: default: expected settings, found [1]"),
    (
        "default: {learning_rate: slow}\n",
        "learning_rate: expected a number, or lin_0.001 for one that falls to 0, got 'slow'",
    ),
    ("default: {learning_rate: lin_x}\n", "learning_rate: expected a number, or lin_0.001"),
]


@pytest.mark.parametrize(("content", "message"), CONF_FILES)
def test_a_mistake_of_a_conf_file_is_one_line(content, message, workplace, capsys):
    Path("mine.yml").write_text(content)
    arguments = ["--algo", "dtfm", "--env", "HalfCheetah-v5", "--conf-file", "mine.yml", "--dataset", DATASET_ID, "-n", "2"]
    assert main(["train", *arguments]) == 2
    assert is_one_line(capsys, message)
    assert not list(Path().glob("logs/dtfm/*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--algo", "DTFM"], "--algo DTFM (did you mean dtfm?)"),
        (["--device", "evil"], "--device evil: expected auto, cpu, cuda or cuda:N"),
        (["--target-return", "nan"], "--target-return: target_return must be a finite number"),
        (["--env-kwargs", "a:float32"], "text needs quotes of its own: \"a:'float32'\""),
        (["-n", "0"], "-n: must be at least 1, got 0"),
        (["-n", "-5"], "-n: must be at least 1, got -5"),
        (["-f", ""], "-f: expected a folder, got ''; . is the current one"),
    ],
)
def test_a_mistake_of_enjoy_is_one_line(arguments, message, workplace, capsys):
    assert main([*ENJOY, *arguments]) == 2
    assert is_one_line(capsys, message)


@pytest.mark.parametrize(
    "command",
    [
        ["push", *ENJOY[1:5], "-orga", "me", "--n-eval-episodes", "0"],
        ["push", *ENJOY[1:5], "-orga", "me", "-n", "0"],
        ["video", *ENJOY[1:5], "-n", "0"],
        ["demo", "--episodes", "0"],
        ["demo", "--steps", "-1"],
        ["demo", "--demonstrations", "0"],
    ],
)
def test_numbers_of_nothing_are_refused(command, workplace, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(command)
    assert f"{command[-1]!r} is no whole number of at least" in capsys.readouterr().err
    assert not list(Path().iterdir())


def test_tasks_of_the_current_folder_are_found(workplace, monkeypatch):
    """As an installed command looks for modules, which does not look there."""
    monkeypatch.setattr("sys.path", [path for path in __import__("sys").path if path not in ("", str(workplace))])
    register = "gym.register('My-v0', 'gymnasium.envs.mujoco.half_cheetah_v5:HalfCheetahEnv', max_episode_steps=20)"
    Path("my_own_tasks.py").write_text(f"import gymnasium as gym\n{register}\n")
    mine = ["--env", "My-v0", "--gym-packages", "my_own_tasks"]
    params = ["-params", "dataset_kwargs:{'env_id':'My-v0'}"]
    command = tiny_training(
        "dtfm", "--dataset", DATASET_ID, "--eval-freq", "2", "--eval-episodes", "1", "--vec-env", "subproc"
    )
    assert main([*command, *params, *mine]) == 0
    assert main([*ENJOY, *mine, "-n", "30"]) == 0


def test_a_run_learns_with_the_first_trial_of_a_study(workplace, capsys):
    study = ["--storage", "sqlite:///study.db", "--study-name", "s"]
    search = ["-optimize", "--n-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots", "-n", "2"]
    assert main(tiny_training("dtfm", "--dataset", DATASET_ID, *study, *search)) == 0
    capsys.readouterr()
    command = ["train", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--dataset", DATASET_ID, "-n", "1", "--eval-freq", "-1"]
    assert main([*command, *study, "--trial-id", "99"]) == 2
    assert "--trial-id 99: study" in capsys.readouterr().err
    assert main([*command, *study, "--trial-id", "0"]) == 0
    assert "Loading from Optuna study" in capsys.readouterr().out


def test_settings_may_be_a_dataset_and_steps_alone(workplace, capsys):
    arguments = ["train", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--eval-freq", "-1", "--conf-file", "mine.yml"]
    Path("mine.yml").write_text(f"HalfCheetah-v5:\n  dataset: {DATASET_ID}\n")
    assert main(arguments) == 2
    assert is_one_line(capsys, "n_timesteps: the settings have none; add it there, or give -n")
    assert main([*arguments, "-n", "1"]) == 0
