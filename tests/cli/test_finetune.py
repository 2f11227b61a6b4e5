"""`sb3-dtfm finetune`: from a run of `train` to a steered model that `enjoy` plays."""

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO, SAC

from sb3_dtfm.cli.main import main
from sb3_dtfm.finetuning import SteeredDTFM
from tests.recorded import DATASET_ID, tiny_training

EVALUATIONS = ["--eval-freq", "10", "--eval-episodes", "2"]
QUICK = ["learning_starts:10", "batch_size:8", "gradient_steps:1", "policy_kwargs:dict(net_arch=[16])"]
FINETUNE = ["finetune", "--env", "HalfCheetah-v5", "-n", "24", "--seed", "1", *EVALUATIONS]


@pytest.fixture
def run(workplace):
    """The folder of a DTFM's run whose chunks of four are carried out by twos."""
    chunks = "policy_kwargs:dict(embed_dim=16,n_layers=1,n_heads=1,flow_hidden_dim=16,flow_n_layers=1,chunk_size=4)"
    assert main(tiny_training("dtfm", "dataset:" + repr(DATASET_ID), chunks)) == 0
    return workplace / "logs/dtfm/HalfCheetah-v5_1"


def test_a_run_is_finetuned_and_played(run, workplace, capsys):
    arguments = ["--model", str(run), "--algo", "sac", "-tb", "tb", "--save-freq", "12", "-params", *QUICK]
    assert main([*FINETUNE, *arguments]) == 0
    steered = workplace / "logs/steered/HalfCheetah-v5_1"
    settings = yaml.unsafe_load((steered / "HalfCheetah-v5/config.yml").read_text())
    assert settings["noise_env"]["algorithm"] == "sac"
    assert "vec_env_wrapper" not in settings
    assert settings["env_wrapper"][0]["sb3_dtfm.envs.ReturnToGoWrapper"]["target_return"] == 20000
    evaluations = np.load(steered / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [0, 10, 20, 24]
    assert evaluations["ep_lengths"].max() == 20, "environment's steps, of the run's own environment"
    first, last = (SteeredDTFM.load(steered / name) for name in ("rl_model_12_steps", "HalfCheetah-v5"))
    assert last.steering == {
        "layers": [16],
        "activation": "ReLU",
        "squashed": True,
        "bound": 1.5,
        "hidden_state": False,
    }
    assert (first.policy.steering.mean.weight != last.policy.steering.mean.weight).any()
    agent = SAC.load(steered / "agent")
    np.testing.assert_array_equal(agent.actor.mu.weight.detach(), last.policy.steering.mean.weight)
    assert list((workplace / "tb").rglob("events*"))
    for more in ([], ["--load-best"], ["--load-checkpoint", "12"]):
        capsys.readouterr()
        command = ["enjoy", "--algo", "steered", "--env", "HalfCheetah-v5", "--no-render", "-n", "45"]
        assert main([*command, *more]) == 0
        assert "Episode Length 20" in capsys.readouterr().out


def test_the_curve_begins_at_the_offline_policys_score(run, workplace):
    """The steps before the algorithm learns are evaluated as the model that was given, and so is the best model there."""
    assert main([*FINETUNE, "--model", str(run), "-params", *QUICK, "learning_starts:100"]) == 0
    steered = workplace / "logs/steered/HalfCheetah-v5_1"
    model = SteeredDTFM.load(steered / "HalfCheetah-v5")
    assert model.steering is None
    assert SteeredDTFM.load(steered / "best_model").steering is None


def test_ppo_and_a_zip_file_with_a_target_of_its_own(run, workplace):
    quick = ["n_envs:2", "n_steps:8", "batch_size:8", "n_epochs:1", "policy_kwargs:dict(net_arch=[16])"]
    (workplace / "alone.zip").write_bytes((run / "HalfCheetah-v5.zip").read_bytes())
    target = ["--model", "alone.zip", "--algo", "ppo", "--target-return", "3", "--env-kwargs", "max_episode_steps:20"]
    assert main([*FINETUNE, *target, "-params", *quick]) == 0
    steered = workplace / "logs/steered/HalfCheetah-v5_1"
    model = SteeredDTFM.load(steered / "HalfCheetah-v5")
    agent = PPO.load(steered / "agent")
    np.testing.assert_array_equal(agent.policy.action_net.weight.detach(), model.policy.steering.mean.weight)


@pytest.mark.slow
def test_the_online_algorithm_goes_on_learning(run, workplace):
    arguments = ["--model", str(run), "--save-replay-buffer", "-params", *QUICK]
    assert main([*FINETUNE, *arguments]) == 0
    agent = workplace / "logs/steered/HalfCheetah-v5_1/agent.zip"
    assert main([*FINETUNE, *arguments, "-i", str(agent)]) == 0
    after = SAC.load(workplace / "logs/steered/HalfCheetah-v5_2/agent")
    assert after._n_updates > SAC.load(agent)._n_updates


def test_what_does_not_fit_is_said_in_one_line(run, workplace, capsys):
    assert main(tiny_training("dt", "dataset:" + repr(DATASET_ID))) == 0
    (workplace / "alone.zip").write_bytes((run / "HalfCheetah-v5.zip").read_bytes())
    wrong = "vec_env_wrapper:['stable_baselines3.common.vec_env.VecMonitor']"
    cases = {
        "--model nowhere": "nowhere does not exist; --model names a DTFM's zip file or its run's folder.",
        "--model logs/dt/HalfCheetah-v5_1": "was saved by DT, not by DTFM.",
        "--model alone.zip": "--target-return: needed, as alone.zip does not tell what return was asked for.",
        f"--model {run} --algo td3": "--algo td3: no packaged settings; those of ppo, sac, tqc are.",
        f"--model {run} -params {wrong}": "expected sb3_dtfm.finetuning.NoiseActionVecEnv alone.",
        f"--model {run} -params use_sde:True": "its exploration depends on the state (use_sde)",
        f"--model {run} -optimize": "-optimize: hyperparameters of finetune cannot be searched",
    }
    for arguments, message in cases.items():
        capsys.readouterr()
        assert main([*FINETUNE, *arguments.split()]) == 2, arguments
        assert message in capsys.readouterr().err, arguments
    assert main(["train", "--algo", "steered", "--env", "HalfCheetah-v5"]) == 2
    assert "--algo steered: such models come from `sb3-dtfm finetune`" in capsys.readouterr().err
    assert not list((workplace / "logs").glob("steered/*"))
