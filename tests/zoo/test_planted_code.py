"""A run's folder is data: code that somebody planted in one runs in no command but where SECURITY.md says so."""

import contextlib
import json
import pickle
import shutil
import sys
from collections import OrderedDict
from pathlib import Path

import pytest
import yaml
from stable_baselines3 import PPO

from sb3_dtfm.cli.main import main
from sb3_dtfm.files import literal, read_run
from sb3_dtfm.zoo.resuming import START
from tests.recorded import DATASET_ID, tiny_training

ENV = ["--env", "HalfCheetah-v5"]
RUN = Path("logs/dtfm/HalfCheetah-v5_1")
PLANTED = "planted_module"
COMMANDS = {
    "enjoy": ["enjoy", "--algo", "dtfm", *ENV, "--no-render", "-n", "5"],
    "video": ["video", "--algo", "dtfm", *ENV, "-n", "2"],
    "push": ["push", "--algo", "dtfm", *ENV, "-orga", "me", "--repo-folder", "out", "--n-eval-episodes", "1", "--no-render"],
    "sweep": ["sweep", str(RUN), *ENV, "--dataset", DATASET_ID, "--episodes", "1", "--n-envs", "1", "--returns", "1"],
    "record": [
        "record",
        "--algo",
        "dtfm",
        "--model",
        str(RUN),
        *ENV,
        "--episodes",
        "1",
        "--dataset-id",
        "tests/planted/b-v0",
    ],
    "finetune": ["finetune", "--model", str(RUN), *ENV, "--algo", "dtfm", "-n", "20", "--eval-freq", "-1"],
}
OF_YAML = {
    "object": ("config.yml", "a: !!python/object/apply:os.mkdir [ran]\n"),
    "object in args.yml": ("args.yml", "env_kwargs: !!python/object/apply:os.mkdir [ran]\n"),
    "new object": ("config.yml", "a: !!python/object/new:os.mkdir [ran]\n"),
    "module": ("config.yml", f"a: !!python/module:{PLANTED}\n"),
    "normalize": ("config.yml", "normalize: \"__import__('os').mkdir('ran')\"\n"),
    "wrapper": ("config.yml", f"env_wrapper: {PLANTED}.Wrapper\n"),
    "function as wrapper": ("config.yml", "env_wrapper: [{os.mkdir: {}}]\n"),
    "wrapper that is no name": ("config.yml", "env_wrapper: [[]]\n"),
    "wrapper of vectorised environments": ("config.yml", f"vec_env_wrapper: [{PLANTED}.Wrapper]\n"),
    "name of an argument": ("config.yml", "env_kwargs: {\"a:__import__('os').mkdir('ran')#\": 1}\n"),
    "name in args.yml": ("args.yml", "env_kwargs: {\"a:__import__('os').mkdir('ran')#\": 1}\n"),
    "pickled dataset": ("config.yml", "dataset_kwargs: {allow_pickle: true}\n"),
    "no YAML": ("config.yml", "a: [\n"),
    "no mapping": ("config.yml", "- a\n"),
    "no text": ("config.yml", "\xff\x00"),
    "deep": ("config.yml", "[" * 20_000),
}


class Run:
    """Makes a folder when it is unpickled."""

    def __reduce__(self):
        return Path("ran").mkdir, ()


@pytest.fixture(scope="module")
def trained(tmp_path_factory, minari_folder) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
        assert main(tiny_training("dtfm", "--dataset", DATASET_ID, "--eval-freq", "-1")) == 0
    return folder


@pytest.fixture
def planted(trained, tmp_path, monkeypatch, minari_folder) -> Path:
    """A current folder with a run, and with a module that makes a folder where it is imported."""
    shutil.copytree(minari_folder, tmp_path / "minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    shutil.copytree(trained / "logs", tmp_path / "logs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    Path(f"{PLANTED}.py").write_text(
        "import os\nimport gymnasium\nos.mkdir('ran')\nclass Wrapper(gymnasium.Wrapper): pass\n"
    )
    yield RUN / "HalfCheetah-v5"
    sys.modules.pop(PLANTED, None)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_runs_yaml_runs_nothing(command, planted, capsys):
    original = {name: (planted / name).read_text() for name in ("config.yml", "args.yml")}
    for what, (name, text) in list(OF_YAML.items())[:: 4 if command == "video" else 1]:  # which looks for a renderer
        (planted / name).write_text(text, encoding="latin-1")
        assert main(COMMANDS[command]) == 2, what
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert str(planted / name) in error, what
        assert not Path("ran").exists(), what
        (planted / name).write_text(original[name])


@pytest.mark.parametrize("command", ["enjoy", "video", "sweep", "record"])
def test_pickled_statistics_beside_a_model_of_ours_are_not_loaded(command, planted):
    settings = yaml.unsafe_load((planted / "config.yml").read_text())
    (planted / "config.yml").write_text(yaml.dump({**settings, "normalize": True}))
    (planted / "vecnormalize.pkl").write_bytes(pickle.dumps(Run()))
    assert main(COMMANDS[command]) == 0
    assert not Path("ran").exists()


def test_a_wrapper_of_the_users_own_is_imported_where_the_command_names_it(planted):
    settings = yaml.unsafe_load((planted / "config.yml").read_text())
    settings["env_wrapper"] = [f"{PLANTED}.Wrapper", *settings["env_wrapper"]]
    (planted / "config.yml").write_text(yaml.dump(settings))
    assert main([*COMMANDS["enjoy"], "--gym-packages", PLANTED]) == 0
    assert Path("ran").exists()


def test_the_types_that_rl_zoo_writes_are_read(tmp_path):
    settings = {
        "normalize": "dict(norm_obs=False)",
        "policy_kwargs": {"net_arch": (8, 8), "activation_fn": dict},
        "a": [None],
    }
    (tmp_path / "config.yml").write_text(yaml.dump(OrderedDict(settings)))
    read = read_run(tmp_path)
    assert read["normalize"] == {"norm_obs": False}
    assert read["policy_kwargs"] == {"net_arch": (8, 8), "activation_fn": "builtins.dict"}
    assert read["a"] == [None]
    assert read["env_kwargs"] == {}


@pytest.mark.parametrize(("text", "value"), [("dict(a=[1], b=dict(c='x'))", {"a": [1], "b": {"c": "x"}}), (" -1.5 ", -1.5)])
def test_a_literal_is_read(text, value):
    assert literal(text) == value


@pytest.mark.parametrize(
    "text", ["os", "dict(**{})", "dict([])", "dict.get(a=1)", "().__class__", "[0]*3", "f'{1}'", "(" * 9999]
)
def test_anything_else_is_not(text):
    with pytest.raises(ValueError, match="literal of Python"):
        literal(text)


CODE = "__import__('os').mkdir('ran')"
OF_START = {
    "-params": (["-params", f"a:{CODE}"], "-params a:__import__"),
    "an abbreviation": (["--hyperp", f"a:{CODE}"], "a:__import__"),
    "--hyperparams=": ([f"--hyperparams=a:{CODE}"], "a:__import__"),
    "--env-kwargs": (["--env-kwargs", f"a:{CODE}"], "a:__import__"),
    "--eval-env-kwargs": (["--eval-env-kwargs", f"a:{CODE}"], "a:__import__"),
    "a string that RL-Zoo evaluates": (["-params", f'policy_kwargs:"{CODE}"'], "policy_kwargs: expected"),
    "arguments of the monitor": (["-params", f'monitor_kwargs:"{CODE}"'], "monitor_kwargs: expected"),
    "a callback": (["-params", "callback:[{'os.mkdir': {'path': 'ran'}}]"], "callback names 'os.mkdir'"),
    "a planted callback": (["-params", f"callback:'{PLANTED}.Wrapper'"], f"--gym-packages {PLANTED}"),
    "a wrapper": (["-params", "env_wrapper:'os.mkdir'"], "env_wrapper names 'os.mkdir'"),
    "a policy": (["-params", f"policy:'{PLANTED}.Wrapper'"], "policy names"),
    "a package": (["--gym-packages", PLANTED], f"--gym-packages {PLANTED}"),
    "an abbreviated package": (["--gym", PLANTED], f"--gym-packages {PLANTED}"),
    "settings in Python": (["--conf-file", "logs/evil.py"], "--conf-file logs/evil.py"),
    "settings in a package": (["-conf", PLANTED], f"--conf-file {PLANTED}"),
    "settings in YAML": (["--conf-file", "logs/evil.yml"], "--conf-file logs/evil.yml"),
    "another algorithm": (["--algo", "ppo"], "none of --algo ppo"),
}


@pytest.mark.parametrize("command", ["train", "finetune"])
@pytest.mark.parametrize("what", OF_START)
def test_what_started_a_run_runs_nothing_when_it_goes_on(what, command, planted, capsys):
    arguments, message = OF_START[what]
    own = ["--algo", "dtfm", *ENV, *(["--model", str(RUN)] if command == "finetune" else [])]
    (RUN / START).write_text(json.dumps({"arguments": [*own, *arguments], "tensorboard": None, "command": command}))
    Path("logs/evil.py").write_text(f"{CODE}\nhyperparams = {{}}\n")
    Path("logs/evil.yml").write_text(f'default: {{policy_kwargs: "{CODE}", n_timesteps: 1, policy: MultiInputPolicy}}\n')
    (RUN / "checkpoint.zip").write_bytes(pickle.dumps(Run()))
    assert main([command, "--resume", str(RUN)]) == 2
    assert message in capsys.readouterr().err.strip().splitlines()[-1]
    assert not Path("ran").exists()


@pytest.mark.parametrize(
    "start", ['{"arguments": "abc"}', '{"arguments": [1]}', "[]", "{", "[" * 9999, '{"arguments": [], "x": 1}']
)
def test_a_damaged_start_is_named(start, planted, capsys):
    (RUN / START).write_text(start)
    assert main(["train", "--resume", str(RUN)]) == 2
    assert "start.json is damaged" in capsys.readouterr().err


# Code that still runs, as SECURITY.md lists it, by command: the user's own arguments, and pickles.
PPO_ENV = ["--algo", "ppo", "--env", "Pendulum-v1"]
PPO_RUN = Path("logs/ppo/Pendulum-v1_1")
STILL_RUNS = {
    "train -params": tiny_training("dtfm", f"a:{CODE}"),
    "train --env-kwargs": tiny_training("dtfm", "--env-kwargs", f"a:{CODE}"),
    "train --conf-file YAML": ["train", *PPO_ENV, "--conf-file", "evil.yml"],
    "train --conf-file Python": ["train", *PPO_ENV, "--conf-file", "evil.py"],
    "enjoy --gym-packages": [*COMMANDS["enjoy"], "--gym-packages", PLANTED],
    "train, statistics in the current folder": ["train", *PPO_ENV, "-n", "8", "--eval-freq", "-1"],
    "train -i": ["train", *PPO_ENV, "-i", str(PPO_RUN / "Pendulum-v1.zip"), "-n", "8"],
    "finetune -i": [
        "finetune",
        "--model",
        str(RUN),
        *ENV,
        "--algo",
        "ppo",
        "-i",
        str(PPO_RUN / "Pendulum-v1.zip"),
        "-n",
        "8",
    ],
    "enjoy --env-kwargs": [*COMMANDS["enjoy"], "--env-kwargs", f"a:{CODE}"],
    "enjoy, an agent": ["enjoy", *PPO_ENV, "-f", "logs", "--no-render", "-n", "2"],
    "video, an agent": ["video", *PPO_ENV, "-n", "2"],
    "record --gym-packages": [*COMMANDS["record"], "--gym-packages", PLANTED],
    "record, an agent": ["record", *PPO_ENV, "--model", str(PPO_RUN), "--episodes", "1", "--dataset-id", "tests/ran-v0"],
    "sweep --acting": [*COMMANDS["sweep"], "--acting", f"a:{CODE}"],
    "benchmark -params": ["benchmark", "--label", "x", "-params", f"a:{CODE}"],
    "plot plot_from_file": ["plot", "plot_from_file", "-i", "results.pkl"],
}


@pytest.mark.parametrize("what", STILL_RUNS)
def test_what_security_lists_does_run(what, planted):
    Path("evil.py").write_text(f"{CODE}\nhyperparams = {{}}\n")
    Path("evil.yml").write_text(f'default: {{policy_kwargs: "{CODE}", n_timesteps: 8, policy: MlpPolicy}}\n')
    Path("results.pkl").write_bytes(pickle.dumps(Run()))
    Path("Pendulum-v1").mkdir()
    if "current folder" in what:
        Path("Pendulum-v1/vecnormalize.pkl").write_bytes(pickle.dumps(Run()))
    agent = PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu")
    agent.planted = Run()
    agent.save(PPO_RUN / "Pendulum-v1.zip")
    with contextlib.suppress(Exception, SystemExit):  # what comes of it is no agent
        main(STILL_RUNS[what])
    assert Path("ran").exists()
