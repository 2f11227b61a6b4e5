"""Arguments of the command line before RL-Zoo sees them."""

import argparse
import ast
from pathlib import Path

import numpy as np
import pytest
from rl_zoo3.utils import StoreDict

from sb3_dtfm import DT, DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.zoo.arguments import UsageError, enjoy_arguments, train_arguments
from sb3_dtfm.zoo.registration import packaged_config, with_policy_options
from tests.recorded import DATASET_ID, tiny_training

ENV = ["--env", "Ant-v5"]
SEARCH = ["-n", "2", "-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]


def zoo_reads(arguments: list[str]) -> argparse.Namespace:
    """The relevant part of RL-Zoo's parser."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--algo")
    parser.add_argument("--env")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", action=StoreDict)
    parser.add_argument("-n", type=int)
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict)
    return parser.parse_args(arguments)


def test_several_datasets_are_a_list():
    given = zoo_reads(train_arguments(["--algo", "dt", *ENV, "--dataset", "a.npz", "b/c-v0", "-n", "5"]))
    assert given.hyperparams["dataset"] == ["a.npz", "b/c-v0"]


@pytest.mark.parametrize("algo", ["dt", "dtfm"])
def test_conf_file_defaults_to_the_packaged_one_and_paper_is_packaged(algo):
    assert zoo_reads(train_arguments(["--algo", algo, *ENV])).conf_file == str(packaged_config(algo))
    assert zoo_reads(train_arguments(["--algo", algo, *ENV, "-conf", "paper"])).conf_file == str(
        packaged_config(algo, "paper")
    )
    assert packaged_config(algo).parent.name == "zoo_configs"
    assert packaged_config(algo, "paper").parent.name == "paper"


def test_any_other_conf_file_stays():
    assert zoo_reads(train_arguments(["--algo", "dtfm", *ENV, "--conf-file=mine.yml"])).conf_file == "mine.yml"
    assert zoo_reads(train_arguments(["--algo", "sac"])).conf_file is None
    assert zoo_reads(train_arguments(["--algo", "sac", "--conf-file", "small"])).conf_file == "small"


def test_offline_algorithms_need_a_task_and_others_have_rl_zoos():
    with pytest.raises(
        UsageError, match=r'--env: dtfm needs the Gymnasium id of its task.*Python: DTFM\("MultiInputPolicy"'
    ):
        train_arguments(["--algo", "dtfm", "--dataset", "a.npz"])
    assert zoo_reads(train_arguments(["--algo", "sac"])).env == "CartPole-v1"


def test_ppo_on_a_task_of_this_package_has_packaged_settings():
    task = ["--algo", "ppo", "--env", "Go1Velocity-v0"]
    assert Path(zoo_reads(train_arguments(task)).conf_file) == packaged_config("dt").with_name("ppo.yml")
    assert zoo_reads(train_arguments([*task, "--conf-file", "mine.yml"])).conf_file == "mine.yml"
    assert zoo_reads(train_arguments(["--algo", "ppo", *ENV])).conf_file is None
    assert zoo_reads(train_arguments(["--algo", "sac", *task[2:]])).conf_file is None


def test_shorthands_join_the_users_hyperparameters():
    arguments = ["--algo", "dt", *ENV, "--dataset", "it's a/file:1.hdf5", "-params", "batch_size:8", "-n", "5"]
    arguments += ["--dataset-fraction", "0.5", "--target-return", "3000", "--env-kwargs", "a:1", "--hyperparams", "seed:3"]
    read = zoo_reads(train_arguments(arguments))
    assert read.hyperparams == {
        "batch_size": 8,
        "seed": 3,
        "dataset": "it's a/file:1.hdf5",
        "dataset_kwargs": {"fraction": 0.5},
        "env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 3000.0}}],
    }
    assert read.n == 5
    assert read.env_kwargs == {"a": 1}


def test_a_cache_joins_the_users_own_options_of_the_reader():
    arguments = ["--algo", "dt", *ENV, "--dataset-cache", "it's a/folder"]
    assert zoo_reads(train_arguments(arguments)).hyperparams == {"dataset_kwargs": {"cache_dir": "it's a/folder"}}
    arguments += ["-params", "dataset_kwargs:dict(filter_key='train')", "batch_size:8"]
    assert zoo_reads(train_arguments(arguments)).hyperparams == {
        "dataset_kwargs": {"filter_key": "train", "cache_dir": "it's a/folder"},
        "batch_size": 8,
    }


def test_a_dataset_for_an_online_algorithm_is_refused():
    with pytest.raises(UsageError, match="--dataset: for --algo dt and dtfm only, not for sac"):
        train_arguments(["--algo", "sac", "--dataset", "x"])


def test_a_task_that_the_settings_do_not_list_needs_a_dataset():
    with pytest.raises(UsageError, match="--dataset: needed for Hopper-v5"):
        train_arguments(["--algo", "dt", "--env", "Hopper-v5", "--target-return", "3"])
    train_arguments(["--algo", "dt", "--env", "Hopper-v5", "--dataset", "x"])


def test_enjoy_looks_where_train_writes():
    assert enjoy_arguments(["--algo", "dtfm", "--env", "E"])[1][-2:] == ["--folder", "logs"]
    assert enjoy_arguments(["--algo", "dtfm", "-f", "mine"]) == (None, ["--algo", "dtfm", "--folder", "mine"])
    assert enjoy_arguments(["--algo", "sac"]) == (None, ["--algo", "sac"])


def test_enjoy_takes_a_target_return_for_models_that_look_at_one():
    given = ["--algo", "dt", "--env-kwargs", "a:1", "--target-return", "-5", "-n", "3"]
    assert enjoy_arguments(given) == (-5.0, ["--algo", "dt", "--env-kwargs", "a:1", "-n", "3", "--folder", "logs"])
    with pytest.raises(UsageError, match="--target-return: for --algo dt and dtfm only, not for sac"):
        enjoy_arguments(["--algo", "sac", "--target-return", "5"])


def test_options_of_the_policy_stand_among_the_others():
    settings = {"n_timesteps": 3, "critic_steps": 4, "chunk_size": 2, "policy_kwargs": {"chunk_size": 8, "embed_dim": 16}}
    nested = {"n_timesteps": 3, "policy_kwargs": {"critic_steps": 4, "chunk_size": 2, "embed_dim": 16}}
    assert with_policy_options(settings) == nested
    assert with_policy_options({"critic_steps": 4}) == {"policy_kwargs": {"critic_steps": 4}}
    for alone in ({"n_timesteps": 3}, nested):
        assert with_policy_options(alone) == alone
    with pytest.raises(ValueError, match="critic_steps: policy_kwargs is 'dict\\(\\)', no mapping"):
        with_policy_options({"critic_steps": 4, "policy_kwargs": "dict()"})


def test_a_run_has_the_options_of_its_policy_and_the_settings_files_others(workplace, capsys):
    (workplace / "mine.yml").write_text(
        "HalfCheetah-v5:\n  policy: MultiInputPolicy\n  n_timesteps: 4\n  batch_size: 4\n"
        f"  dataset: {DATASET_ID}\n  env_wrapper: [{{sb3_dtfm.envs.ReturnToGoWrapper: {{target_return: 5}}}}]\n"
        "  policy_kwargs: {embed_dim: 16, n_layers: 1, n_heads: 1, flow_hidden_dim: 16, flow_n_layers: 1}\n"
    )
    command = [*tiny_training("dtfm")[:9], "--conf-file", "mine.yml", "--eval-freq", "-1", "-params"]
    assert main([*command, "critic_steps:1", "n_action_samples:3"]) == 0
    model = DTFM.load(workplace / "logs/dtfm/HalfCheetah-v5_1/HalfCheetah-v5")
    assert model.policy_kwargs.items() >= {"embed_dim": 16, "critic_steps": 1, "n_action_samples": 3}.items()
    assert model.policy.critic is not None
    assert "critic_steps" in (workplace / "logs/dtfm/HalfCheetah-v5_1/HalfCheetah-v5/config.yml").read_text()
    assert main([*command, "flow_layers:1"]) == 2
    assert "flow_layers" in capsys.readouterr().err


def test_another_target_leaves_the_yaml_files_other_wrappers(tmp_path):
    wrappers = "[{gymnasium.wrappers.TransformReward: {func: abs}}, {sb3_dtfm.envs.ReturnToGoWrapper: {target_return: 5}}]"
    for name in ("HalfCheetah-v5", "default"):
        (tmp_path / "mine.yml").write_text(f"{name}: {{env_wrapper: {wrappers}}}\n")
        given = [
            "--algo",
            "dt",
            "--env",
            "HalfCheetah-v5",
            "--conf-file",
            str(tmp_path / "mine.yml"),
            "--target-return",
            "3",
        ]
        *_, wanted = train_arguments(given)
        name, _, value = wanted.partition(":")
        assert name == "env_wrapper"
        assert ast.literal_eval(value) == [
            {"gymnasium.wrappers.TransformReward": {"func": "abs"}},
            {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 3.0}},
        ]


def test_evaluations_count_gradient_steps_whatever_n_envs_is(workplace):
    command = tiny_training("dt", "--dataset", DATASET_ID, "-n", "8", "--eval-freq", "4", "--eval-episodes", "1")
    assert main([*command, "--save-freq", "4", "-params", "n_envs:2"]) == 0
    run = workplace / "logs/dt/HalfCheetah-v5_1"
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [0, 4, 8]
    assert sorted(path.name for path in run.glob("rl_model*")) == ["rl_model_4_steps.zip", "rl_model_8_steps.zip"]


def test_a_trial_that_diverges_does_not_end_a_search(workplace, monkeypatch, capfd):
    learn, fail = DT.learn, iter([True])

    def diverge(self, *args, **kwargs):
        if next(fail, False):
            raise FloatingPointError("on purpose")
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(DT, "learn", diverge)
    assert main(tiny_training("dt", "--dataset", DATASET_ID, "--seed", "1", *SEARCH)) == 0
    assert "Number of finished trials:  2" in capfd.readouterr().out


def test_a_search_of_which_no_trial_ends_says_so(workplace, monkeypatch, capfd):
    def diverge(self, *args, **kwargs):
        raise FloatingPointError("on purpose")

    monkeypatch.setattr(DT, "learn", diverge)
    assert main(tiny_training("dt", "--dataset", DATASET_ID, *SEARCH)) == 2
    assert "No trials are completed yet. Of 2 the last ended by FloatingPointError: on purpose" in capfd.readouterr().err
