"""Planted code, in the folder of a run, a file or an argument, runs where SECURITY.md says so and nowhere else."""

import contextlib
import json
import pickle
import shutil
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
import yaml
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from stable_baselines3 import PPO, SAC

from sb3_dtfm.benchmark.runner import CALLBACK
from sb3_dtfm.cli.main import main
from sb3_dtfm.files import literal, read_run
from sb3_dtfm.zoo.manager import TrainingError
from sb3_dtfm.zoo.registration import packaged_config
from sb3_dtfm.zoo.resuming import START
from tests.recorded import DATASET_ID, tiny_training

ENV = ["--env", "HalfCheetah-v5"]
RUN = Path("logs/dtfm/HalfCheetah-v5_1")
PLANTED = "planted_module"
CODE = "__import__('os').mkdir('ran') or 1 / 0"  # which ends a command
PPO_RUN, NORMALIZED_RUN = Path("logs/ppo/Pendulum-v1_1"), Path("logs/ppo/Pendulum-v1_2")
SAC_RUN = Path("logs/sac/Pendulum-v1_1")
# Settings that RL-Zoo evaluates or imports.
SETTINGS = {
    **dict.fromkeys(("policy_kwargs", "normalize", "monitor_kwargs", "replay_buffer_class", "replay_buffer_kwargs"), CODE),
    **dict.fromkeys(("policy", "callback", "env_wrapper", "vec_env_wrapper"), f"{PLANTED}.Absent"),
}
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
    "a circle": ("config.yml", "env_wrapper: [{sb3_dtfm.envs.ReturnToGoWrapper: &a {b: *a, env_wrapper: [os.mkdir]}}]\n"),
    "a circle of wrappers": (
        "config.yml",
        f"env_wrapper: &a [{{sb3_dtfm.envs.ReturnToGoWrapper: {{env_wrapper: *a, vec_env_wrapper: {PLANTED}.Wrapper}}}}]\n",
    ),
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
        _plant()
    return folder


def _plant() -> None:
    """Agents, statistics, data, settings and a study that hold code, beside the run."""
    pickled = pickle.dumps(Run())
    small = dict(env="Pendulum-v1", device="cpu", policy_kwargs={"net_arch": [4]})
    PPO_RUN.mkdir(parents=True)
    agent = PPO("MlpPolicy", n_steps=8, batch_size=8, **small)
    agent.save(NORMALIZED_RUN / "Pendulum-v1.zip")
    for task in ("Pendulum-v1", "HalfCheetah-v5"):
        (NORMALIZED_RUN / task).mkdir()
        (NORMALIZED_RUN / task / "config.yml").write_text("normalize: true\n")
        (NORMALIZED_RUN / task / "args.yml").write_text("env_kwargs: null\n")
        (NORMALIZED_RUN / task / "vecnormalize.pkl").write_bytes(pickled)
    agent.planted = Run()
    agent.save(PPO_RUN / "Pendulum-v1.zip")
    SAC("MlpPolicy", buffer_size=9, **small).save(SAC_RUN / "Pendulum-v1.zip")
    (SAC_RUN / "replay_buffer.pkl").write_bytes(pickled)
    Path("evil.pkl").write_bytes(pickled)
    Path("repository").mkdir()
    settings = {"algo": "dtfm", "env": "HalfCheetah-v5", "target_return": 1.0, "env_kwargs": {}}
    Path("repository/settings.json").write_text(json.dumps(settings))
    shutil.copy(PPO_RUN / "Pendulum-v1.zip", "repository/dtfm-HalfCheetah-v5.zip")
    np.savez("evil.npz", observations=np.array([Run()], dtype=object))
    flat = {"observations": (9, 17), "actions": (9, 6), "rewards": 9, "terminals": 9}
    np.savez("flat.npz", **{name: np.zeros(shape, np.float32) for name, shape in flat.items()}, timeouts=np.arange(9) == 8)
    Path("plotted").mkdir()
    np.savez("plotted/evaluations.npz", timesteps=np.array([Run()], dtype=object), results=np.zeros((1, 1)))
    Path("evil.py").write_text(f"{CODE}\nhyperparams = {{}}\n")
    Path("optunahub.py").write_text(f"{CODE}\n")  # which downloads and runs samplers
    Path(f"{PLANTED}.py").write_text(
        "import os\nimport gymnasium\nos.mkdir('ran')\nclass Wrapper(gymnasium.Wrapper): pass\n"
    )
    entries = {"packages": {"gym_packages": [PLANTED]}, "pickled": {"dataset_kwargs": {"allow_pickle": True}}}
    for name, entry in entries.items():
        Path(f"{name}.yml").write_text(yaml.safe_dump({"HalfCheetah-v5": {"dataset": "evil.pkl", **entry}}))
    study = optuna.create_study(storage=JournalStorage(JournalFileBackend("study.log")), study_name="s")
    for name, value in SETTINGS.items():
        Path(f"{name}.yml").write_text(yaml.safe_dump({"default": {"n_timesteps": 8, "policy": "MlpPolicy", name: value}}))
        choices = {name: optuna.distributions.CategoricalDistribution([value])}
        study.add_trial(optuna.trial.create_trial(params={name: value}, distributions=choices, value=0.0))


@pytest.fixture
def planted(trained, tmp_path, monkeypatch, minari_folder) -> Path:
    """A current folder with a run, and with a module that makes a folder where it is imported."""
    shutil.copytree(minari_folder, tmp_path / "minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield RUN / "HalfCheetah-v5"
    sys.modules.pop(PLANTED, None)


def yaml_for(command: str) -> list[str]:
    """Names of the texts that are planted in a command's run: a part for `video`, which looks for a renderer each time."""
    return list(OF_YAML)[:: 4 if command == "video" else 1]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_runs_yaml_runs_nothing(command, planted, capsys):
    original = {name: (planted / name).read_text() for name in ("config.yml", "args.yml")}
    for what in yaml_for(command):
        name, text = OF_YAML[what]
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


def evaluating(**row: object) -> dict:
    """Arguments of the benchmark's evaluations."""
    plain = {"task": "HalfCheetah-v5", "settings": {}}
    return dict(rows="rows.jsonl", row={**plain, **row}, eval_freq=1, n_episodes=1, n_final_episodes=1)


PACKAGED = ["--conf-file", str(packaged_config("dtfm"))]
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
    "a wrapper of a callback's environments": (
        ["-params", f"callback:[{{'{CALLBACK}': {evaluating(settings={'env_wrapper': [{'os.mkdir': {'path': 'ran'}}]})}}}]"],
        "env_wrapper names 'os.mkdir'",
    ),
    "a task of a callback's environments": (
        ["-params", f"callback:[{{'{CALLBACK}': {evaluating(task=f'{PLANTED}:HalfCheetah-v5')}}}]"],
        "expected the id of a registered task",
    ),
    "a policy": (["-params", f"policy:'{PLANTED}.Wrapper'"], "policy names"),
    "a package": (["--gym-packages", PLANTED], f"--gym-packages {PLANTED}"),
    "an abbreviated package": (["--gym", PLANTED], f"--gym-packages {PLANTED}"),
    "settings in Python": (["--conf-file", "logs/evil.py"], "--conf-file logs/evil.py"),
    "settings in a package": (["-conf", PLANTED], f"--conf-file {PLANTED}"),
    "settings in YAML": (["--conf-file", "logs/evil.yml"], "--conf-file logs/evil.yml"),
    "a study": (
        [*PACKAGED, "--storage", "study.log", "--study-name", "s", "--trial-id", "1"],
        "study 's': normalize: expected",
    ),
    "a search": ([*PACKAGED, "--optimize"], "-optimize"),
    "a module's task": (["--env", f"{PLANTED}:HalfCheetah-v5"], "not found in gym registry"),
    "another algorithm": (["--algo", "ppo"], "none of --algo ppo"),
    "an upload": (["--trac", "--wandb-entity", "evil"], "says --track, which uploads the run"),
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


# Code that still runs, as SECURITY.md lists it, by command and option. Commands end early: behind a package that is imported
# an absent one follows.
PENDULUM = ["--env", "Pendulum-v1"]
DTFM_TRAINING = ["train", "--algo", "dtfm", *ENV, "-n", "1", "--eval-freq", "-1"]
FINETUNE = ["finetune", "--model", str(RUN), *ENV, "-n", "8"]
BENCHMARK = ["benchmark", "--dataset", f"HalfCheetah-v5={DATASET_ID}", "--algo", "dt", "--fractions", "1"]
COMMANDS_WITH_PACKAGES = {
    **COMMANDS,
    "train": ["train", "--algo", "dtfm", *ENV],
    "benchmark": ["benchmark"],
    "inspect": ["inspect", "absent.npz"],
}
AGENT = [str(PPO_RUN / "Pendulum-v1.zip"), "-n", "8"]
STILL_RUNS = {
    "train -params": ["train", "--algo", "dtfm", *ENV, "-params", f"a:{CODE}"],
    "train --env-kwargs": ["train", "--algo", "ppo", *PENDULUM, "--env-kwargs", f"a:{CODE}"],
    "train --eval-env-kwargs": ["train", "--algo", "ppo", *PENDULUM, "--eval-env-kwargs", f"a:{CODE}"],
    "finetune -params": [*FINETUNE, "-params", f"a:{CODE}"],
    "finetune --env-kwargs": [*FINETUNE, "--env-kwargs", f"a:{CODE}"],
    "finetune --eval-env-kwargs": [*FINETUNE, "--eval-env-kwargs", f"a:{CODE}"],
    "benchmark -params": ["benchmark", "--label", "x", "-params", f"a:{CODE}"],
    "benchmark --env-kwargs": ["benchmark", "--env-kwargs", f"a:{CODE}"],
    "enjoy --env-kwargs": [*COMMANDS["enjoy"], "--env-kwargs", f"a:{CODE}"],
    "video --env-kwargs": [*COMMANDS["video"], "--env-kwargs", f"a:{CODE}"],
    "sweep --env-kwargs": [*COMMANDS["sweep"], "--env-kwargs", f"a:{CODE}"],
    "sweep --acting": [*COMMANDS["sweep"], "--acting", f"a:{CODE}"],
    "sweep --dataset-kwargs": [*COMMANDS["sweep"], "--dataset-kwargs", f"a:{CODE}"],
    **{
        f"{command} --gym-packages": [*arguments, "--gym-packages", PLANTED, "absent_module"]
        for command, arguments in COMMANDS_WITH_PACKAGES.items()
    },
    "benchmark --datasets, gym_packages": ["benchmark", "--datasets", "packages.yml"],
    **{
        f"{command} --env MODULE:ID": [*arguments, "--env", f"{PLANTED}:HalfCheetah-v5"]
        for command, arguments in COMMANDS.items()
        if command in ("push", "record")
    },
    "sweep --env MODULE:ID": [*COMMANDS["sweep"], "--dataset", "flat.npz", "--env", f"{PLANTED}:HalfCheetah-v5"],
    "inspect --env MODULE:ID": ["inspect", DATASET_ID, "--env", f"{PLANTED}:HalfCheetah-v5"],
    "record --env-wrapper": [*COMMANDS["record"], "--env-wrapper", f"{PLANTED}.Absent"],
    **{f"train --conf-file, {key}": ["train", "--algo", "ppo", *PENDULUM, "--conf-file", f"{key}.yml"] for key in SETTINGS},
    "train --conf-file FILE.py": ["train", "--algo", "ppo", *PENDULUM, "--conf-file", "evil.py"],
    "train --conf-file PACKAGE": ["train", "--algo", "ppo", *PENDULUM, "--conf-file", PLANTED],
    **{
        f"finetune --conf-file, {key}": [*FINETUNE, "--algo", "ppo", "--conf-file", f"{key}.yml"]
        for key in SETTINGS
        if key != "vec_env_wrapper"
    },
    "finetune --conf-file FILE.py": [*FINETUNE, "--conf-file", "evil.py"],
    **{
        f"benchmark --profile, {key}": [*BENCHMARK, "--profile", f"{key}.yml"]
        for key in ("normalize", "policy", "callback", "env_wrapper", "vec_env_wrapper")
    },
    "train --sampler auto": [*DTFM_TRAINING, "--dataset", DATASET_ID, "-optimize", "--sampler", "auto"],
    "train -i": ["train", "--algo", "ppo", *PENDULUM, "-i", *AGENT],
    "train -i, statistics": ["train", "--algo", "ppo", *PENDULUM, "-i", str(NORMALIZED_RUN / "Pendulum-v1.zip"), "-n", "8"],
    "train -i, replay buffer": ["train", "--algo", "sac", *PENDULUM, "-i", str(SAC_RUN / "Pendulum-v1.zip"), "-n", "1"],
    "finetune -i": [*FINETUNE, "--algo", "ppo", "-i", *AGENT],
    "finetune -i, statistics": [*FINETUNE, "--algo", "ppo", "-i", str(NORMALIZED_RUN / "Pendulum-v1.zip")],
    "train, statistics in the current folder": ["train", "--algo", "ppo", *PENDULUM, "-n", "8", "--eval-freq", "-1"],
    "finetune, statistics in the current folder": [*FINETUNE, "--algo", "ppo"],
    "enjoy, an agent": ["enjoy", "--algo", "ppo", *PENDULUM, "-f", "logs", "--exp-id", "1", "--no-render", "-n", "2"],
    "video, an agent": ["video", "--algo", "ppo", *PENDULUM, "--exp-id", "1", "-n", "2"],
    "record, an agent": [*COMMANDS["record"], "--algo", "ppo", *PENDULUM, "--model", str(PPO_RUN)],
    "enjoy, statistics": ["enjoy", "--algo", "ppo", *PENDULUM, "-f", "logs", "--exp-id", "2", "--no-render", "-n", "2"],
    "video, statistics": ["video", "--algo", "ppo", *PENDULUM, "--exp-id", "2", "-n", "2"],
    "record, statistics": [*COMMANDS["record"], "--algo", "ppo", *PENDULUM, "--model", str(NORMALIZED_RUN)],
    "record --vec-normalize": [*COMMANDS["record"], "--vec-normalize", "evil.pkl"],
    "plot plot_from_file -i": ["plot", "plot_from_file", "-i", "evil.pkl"],
    "plot plot_from_file --merge": ["plot", "plot_from_file", "-i", "results.pkl", "--merge", "evil.pkl"],
    "inspect --dataset-kwargs, a pickle": ["inspect", "evil.pkl", "--dataset-kwargs", "allow_pickle:True"],
    "inspect --dataset-kwargs, arrays": ["inspect", "evil.npz", "--dataset-kwargs", "allow_pickle:True"],
    "sweep --dataset-kwargs, a pickle": [
        *COMMANDS["sweep"],
        "--dataset",
        "evil.pkl",
        "--dataset-kwargs",
        "allow_pickle:True",
    ],
    "sweep --dataset-kwargs, arrays": [*COMMANDS["sweep"], "--dataset", "evil.npz", "--dataset-kwargs", "allow_pickle:True"],
}


class HereInstead:
    """A process of the benchmark, as far as it needs one, whose command runs in this process."""

    def __init__(self, command: list[str], **_):
        self.stdout, self.returncode = iter(()), 1
        with contextlib.suppress(Exception, SystemExit):
            main(command[command.index("train") :])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def poll(self) -> int:
        return self.returncode


@pytest.mark.parametrize("what", STILL_RUNS)
def test_what_security_lists_does_run(what, planted, monkeypatch):
    results = {"results_table": {"headers": ["a"], "value_matrix": [[1]]}}
    Path("results.pkl").write_bytes(pickle.dumps(results))
    if "current folder" in what:
        for task in ("Pendulum-v1", "HalfCheetah-v5"):
            Path(task).mkdir()
            Path(task, "vecnormalize.pkl").write_bytes(pickle.dumps(Run()))
    processes = SimpleNamespace(**{**vars(subprocess), "Popen": HereInstead})
    monkeypatch.setattr("sb3_dtfm.benchmark.runner.subprocess", processes)
    with contextlib.suppress(Exception, SystemExit):  # what comes of it is no agent
        main(STILL_RUNS[what])
    assert Path("ran").exists()


# Options that read data, models and literals: with what their error says.
TRIALS = {name: number for number, name in enumerate(SETTINGS)}
RUNS_NOTHING = {
    "inspect --dataset-kwargs": (["inspect", DATASET_ID, "--dataset-kwargs", f"a:{CODE}"], "is no key:value"),
    "inspect --env-kwargs": (["inspect", DATASET_ID, *ENV, "--env-kwargs", f"a:{CODE}"], "is no key:value"),
    "record --env-kwargs": ([*COMMANDS["record"], "--env-kwargs", f"a:{CODE}"], "is no key:value"),
    "export --acting": (["export", str(RUN), "--acting", f"a:{CODE}"], "is no key:value"),
    "inspect, a pickle": (["inspect", "evil.pkl"], "evil.pkl"),
    "inspect, arrays": (["inspect", "evil.npz"], "evil.npz"),
    "sweep, a pickle": ([*COMMANDS["sweep"], "--dataset", "evil.pkl"], "evil.pkl"),
    "sweep, arrays": ([*COMMANDS["sweep"], "--dataset", "evil.npz"], "evil.npz"),
    "train, a pickle": ([*DTFM_TRAINING, "--dataset", "evil.pkl"], "evil.pkl"),
    "train, arrays": ([*DTFM_TRAINING, "--dataset", "evil.npz"], "evil.npz"),
    "train, a pickle that is allowed": (
        [*DTFM_TRAINING, "--dataset", "evil.pkl", "-params", "dataset_kwargs:{'allow_pickle':True}"],
        "allow_pickle is accepted by load_dataset alone",
    ),
    "finetune, a pickle that is allowed": (
        [*COMMANDS["finetune"], "-params", "dataset:'evil.pkl'", "dataset_kwargs:{'allow_pickle':True}"],
        "allow_pickle is accepted by load_dataset alone",
    ),
    "benchmark, a pickle": (["benchmark", "--dataset", "HalfCheetah-v5=evil.pkl"], "evil.pkl"),
    "benchmark, a pickle that is allowed": (["benchmark", "--datasets", "pickled.yml"], "allow_pickle is accepted by"),
    "train --env MODULE:ID": (
        [*DTFM_TRAINING, "--env", f"{PLANTED}:HalfCheetah-v5"],
        f"--gym-packages {PLANTED} --env HalfCheetah-v5",
    ),
    "finetune --env MODULE:ID": (
        [*COMMANDS["finetune"], "--env", f"{PLANTED}:HalfCheetah-v5"],
        f"--gym-packages {PLANTED} --env HalfCheetah-v5",
    ),
    **{
        f"{command} --env MODULE:ID": (
            [*COMMANDS[command], "--env", f"{PLANTED}:HalfCheetah-v5"],
            f"--gym-packages {PLANTED} --env HalfCheetah-v5",
        )
        for command in ("enjoy", "video")
    },
    "benchmark --env MODULE:ID": (["benchmark", "--env", f"{PLANTED}:HalfCheetah-v5"], "planted_module"),
    "finetune --conf-file, vec_env_wrapper": (
        [*FINETUNE, "--algo", "ppo", "--conf-file", "vec_env_wrapper.yml"],
        "expected sb3_dtfm.finetuning.NoiseActionVecEnv or",
    ),
    "benchmark --profile FILE.py": ([*BENCHMARK, "--profile", "evil.py"], "expected a mapping by task"),
    **{
        f"benchmark --profile, {key}": ([*BENCHMARK, "--profile", f"{key}.yml"], key)
        for key in ("policy_kwargs", "monitor_kwargs", "replay_buffer_class", "replay_buffer_kwargs")
    },
    **{
        f"train --storage, {name}": (
            [
                *DTFM_TRAINING,
                "--dataset",
                DATASET_ID,
                "--storage",
                "study.log",
                "--study-name",
                "s",
                "--trial-id",
                str(trial),
            ],
            f"study 's': {name}",
        )
        for name, trial in TRIALS.items()
    },
    "train -i of dtfm, an agent": (
        [*DTFM_TRAINING, "--dataset", DATASET_ID, "-i", str(PPO_RUN / "Pendulum-v1.zip")],
        "saved by another algorithm",
    ),
    "finetune --model, an agent": (
        [*COMMANDS["finetune"], "--model", str(PPO_RUN / "Pendulum-v1.zip")],
        "saved by another algorithm",
    ),
    "export, an agent": (["export", str(PPO_RUN / "Pendulum-v1.zip")], "saved by another algorithm"),
    "pull, an agent": (
        ["pull", "--algo", "dtfm", *ENV, "-orga", "me", "--repo-folder", "repository"],
        "saved by another algorithm",
    ),
    "plot, arrays": (["plot", "plotted"], "plotted/evaluations.npz is damaged, or no file of SB3's EvalCallback"),
    "report --baseline, arrays": (["report", "results", "--baseline", "a=plotted/evaluations.npz"], ""),
}


@pytest.mark.parametrize("what", RUNS_NOTHING)
def test_other_options_run_nothing(what, planted, capsys):
    arguments, message = RUNS_NOTHING[what]
    raised = ""
    try:
        assert main(arguments) == 2
    except (SystemExit, KeyError, TrainingError) as error:
        raised = repr(error)
    assert message in capsys.readouterr().err + raised
    assert not Path("ran").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_an_agent_in_the_place_of_a_model_of_ours_is_refused(command, planted, capsys):
    """With pickled statistics beside it, which are not loaded either."""
    shutil.copy(PPO_RUN / "Pendulum-v1.zip", RUN / "HalfCheetah-v5.zip")
    settings = yaml.unsafe_load((planted / "config.yml").read_text())
    (planted / "config.yml").write_text(yaml.dump({**settings, "normalize": True}))
    (planted / "vecnormalize.pkl").write_bytes(pickle.dumps(Run()))
    assert main(COMMANDS[command]) == 2
    error = capsys.readouterr().err
    assert "saved by another algorithm" in error or "was saved by PPO" in error
    assert not Path("ran").exists()


def test_pickles_beside_a_model_that_learns_further_are_not_loaded(planted, monkeypatch):
    monkeypatch.setattr("sb3_dtfm.zoo.manager.OfflineExperimentManager.learn", lambda *_: None)
    for name in ("replay_buffer.pkl", "HalfCheetah-v5/vecnormalize.pkl"):
        (RUN / name).write_bytes(pickle.dumps(Run()))
    arguments = ["--dataset", DATASET_ID, "-i", str(RUN / "HalfCheetah-v5.zip"), "-params", "normalize:True"]
    with contextlib.suppress(AssertionError):  # RL-Zoo's, of an algorithm without a replay buffer
        main([*DTFM_TRAINING, *arguments])
    assert not Path("ran").exists()
    assert main(COMMANDS["finetune"]) == 0
    assert not Path("ran").exists()


# In a file that others wrote: it clears a terminal.
CLEAR = "a\x1b[2Jb"
PRINTED = {
    "start.json, command": ({"command": CLEAR}, "`sb3-dtfm a"),
    "start.json, --gym-packages": ({"arguments": ["--algo", "dtfm", *ENV, "--gym-packages", CLEAR]}, "names the package a"),
    "start.json, --conf-file": ({"arguments": ["--algo", "dtfm", *ENV, "--conf-file", CLEAR]}, "names the settings a"),
    "start.json, --algo": ({"arguments": ["--algo", CLEAR, *ENV]}, "'a"),
    "start.json, --env": ({"arguments": ["--algo", "dtfm", "--env", CLEAR]}, "a"),
    "start.json, -params": ({"arguments": ["--algo", "dtfm", *ENV, "-params", f"{CLEAR}:1"]}, "-params a"),
}


@pytest.mark.parametrize("what", PRINTED)
def test_what_started_a_run_controls_no_terminal(what, planted, capfd):
    start, message = PRINTED[what]
    (RUN / START).write_text(json.dumps({"arguments": ["--algo", "dtfm", *ENV], **start}))
    with contextlib.suppress(SystemExit):
        main(["train", "--resume", str(RUN)])
    printed = "".join(capfd.readouterr())
    assert message in printed
    assert "\x1b" not in printed


@pytest.mark.parametrize("command", COMMANDS)
def test_a_runs_yaml_controls_no_terminal(command, planted, capfd):
    (planted / "config.yml").write_text(json.dumps({"env_wrapper": f"{CLEAR}.Wrapper"}))
    assert main(COMMANDS[command]) == 2
    printed = "".join(capfd.readouterr())
    assert "config.yml" in printed
    assert "\x1b" not in printed


def test_settings_of_a_repository_control_no_terminal(planted, capfd):
    settings = {"algo": "dtfm", "env": CLEAR, "target_return": 1.0, "env_kwargs": {}}
    Path("repository/settings.json").write_text(json.dumps(settings))
    assert main(["pull", "--algo", "dtfm", *ENV, "-orga", "me", "--repo-folder", "repository"]) == 2
    printed = "".join(capfd.readouterr())
    assert "holds a model of dtfm for a" in printed
    assert "\x1b" not in printed
