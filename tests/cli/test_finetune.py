"""`sb3-dtfm finetune`: from a run of `train` to a fine-tuned model that `enjoy` plays."""

import signal

import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO, SAC

from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import load_dataset
from sb3_dtfm.finetuning import FinetunedDTFM, OnlineDTFM
from sb3_dtfm.zoo.arguments import with_target_return
from tests.recorded import DATASET_ID, tiny_training, undo_checkpoints

EVALUATIONS = ["--eval-freq", "10", "--eval-episodes", "2"]
QUICK = ["n_envs:1", "learning_starts:10", "batch_size:8", "gradient_steps:1", "policy_kwargs:dict(net_arch=[16])"]
QUICK_PPO = ["n_envs:2", "n_steps:8", "batch_size:8", "n_epochs:1", "policy_kwargs:dict(net_arch=[16])"]
FINETUNE = ["finetune", "--env", "HalfCheetah-v5", "-n", "24", "--seed", "1", *EVALUATIONS]


@pytest.fixture
def run(workplace):
    """The folder of a DTFM's run whose chunks of four are carried out by twos."""
    chunks = "policy_kwargs:dict(embed_dim=16,n_layers=1,n_heads=1,flow_hidden_dim=16,flow_n_layers=1,chunk_size=4)"
    assert main(tiny_training("dtfm", "dataset:" + repr(DATASET_ID), chunks)) == 0
    return workplace / "logs/dtfm/HalfCheetah-v5_1"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ([], [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 9.0}}]),
        (["my.Repeat", {"a.ReturnToGoWrapper": {"target_return": 5}}, {"my.Scale": {"by": 2}}],
         [{"my.Repeat": {}}, {"a.ReturnToGoWrapper": {"target_return": 9.0}}, {"my.Scale": {"by": 2}}]),
        ([{"my.Scale": {"by": 2}}, {"my.Scale": {"by": 3}}],
         [{"my.Scale": {"by": 2}}, {"my.Scale": {"by": 3}}, {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 9.0}}]),
        ("my.Repeat", [{"my.Repeat": {}}, {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 9.0}}]),
    ],
)  # fmt: skip
def test_another_target_leaves_the_other_wrappers(before, after):
    assert with_target_return(9.0, before) == after


def test_a_run_is_finetuned_and_played(run, workplace, capsys):
    arguments = ["--model", str(run), "--algo", "sac", "-tb", "tb", "--save-freq", "12", "-params", *QUICK]
    assert main([*FINETUNE, *arguments]) == 0
    finetuned = workplace / "logs/finetuned/HalfCheetah-v5_1"
    settings = yaml.unsafe_load((finetuned / "HalfCheetah-v5/config.yml").read_text())
    assert settings["noise_env"]["algorithm"] == "sac"
    assert "vec_env_wrapper" not in settings
    of_the_run = yaml.unsafe_load((run / "HalfCheetah-v5/config.yml").read_text())
    assert settings["env_wrapper"] == of_the_run["env_wrapper"]
    assert settings["env_wrapper"][0]["sb3_dtfm.envs.ReturnToGoWrapper"]["target_return"] > 0
    evaluations = np.load(finetuned / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [0, 10, 20, 24]
    assert evaluations["ep_lengths"].max() == 20, "environment's steps, of the run's own environment"
    assert SAC.load(finetuned / "agent_12_steps").num_timesteps == 12
    first, last = (FinetunedDTFM.load(finetuned / name) for name in ("rl_model_12_steps", "HalfCheetah-v5"))
    assert last.online_actor == {
        "layers": [16],
        "activation": "ReLU",
        "squashed": True,
        "bound": 0.7,
        "hidden_state": False,
        "residual": False,
    }
    assert (first.policy.online_actor.mean.weight != last.policy.online_actor.mean.weight).any()
    agent = SAC.load(finetuned / "agent")
    np.testing.assert_array_equal(agent.actor.mu.weight.detach(), last.policy.online_actor.mean.weight)
    assert list((workplace / "tb").rglob("events*"))
    for more in ([], ["--load-best"], ["--load-checkpoint", "12"]):
        capsys.readouterr()
        command = ["enjoy", "--algo", "finetuned", "--env", "HalfCheetah-v5", "--no-render", "-n", "45"]
        assert main([*command, *more]) == 0
        assert "Episode Length 20" in capsys.readouterr().out
    recording = ["--model", str(finetuned), "--episodes", "2", "--dataset-id", "local/finetuned-v0"]
    assert main(["record", "--algo", "finetuned", "--env", "HalfCheetah-v5", *recording]) == 0
    assert load_dataset("local/finetuned-v0").episode_lengths.tolist() == [20, 20]


def test_a_file_without_a_run_tells_its_target_return(run, workplace):
    (workplace / "alone.zip").write_bytes((run / "HalfCheetah-v5.zip").read_bytes())
    steps = ["--env-kwargs", "max_episode_steps:20"]
    assert main([*FINETUNE, "--model", "alone.zip", *steps, "-params", *QUICK]) == 0
    settings = yaml.unsafe_load((workplace / "logs/finetuned/HalfCheetah-v5_1/HalfCheetah-v5/config.yml").read_text())
    told = DTFM.load("alone").target_return
    assert settings["env_wrapper"] == [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": told}}]
    of_the_run = yaml.unsafe_load((run / "HalfCheetah-v5/config.yml").read_text())
    assert settings["env_wrapper"] == of_the_run["env_wrapper"]


def test_the_curve_begins_at_the_offline_policys_score(run, workplace):
    """The steps before the algorithm learns are evaluated as the model that was given, and so is the best model there."""
    assert main([*FINETUNE, "--model", str(run), "-params", *QUICK, "learning_starts:100"]) == 0
    finetuned = workplace / "logs/finetuned/HalfCheetah-v5_1"
    model = FinetunedDTFM.load(finetuned / "HalfCheetah-v5")
    assert model.online_actor is None
    assert FinetunedDTFM.load(finetuned / "best_model").online_actor is None


def test_a_run_that_is_interrupted_is_saved_at_once(run, workplace, capsys, monkeypatch):
    """Not after an evaluation, which takes minutes: who sends SIGTERM kills what has not ended soon."""
    train = SAC.train

    def interrupted(self, *args, **kwargs):
        train(self, *args, **kwargs)
        if self.num_timesteps == 14:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(SAC, "train", interrupted)
    with pytest.raises(SystemExit) as ended:
        main([*FINETUNE, "--model", str(run), "-params", *QUICK])
    assert ended.value.code == 128 + signal.SIGTERM
    finetuned = workplace / "logs/finetuned/HalfCheetah-v5_1"
    assert np.load(finetuned / "evaluations.npz")["timesteps"].tolist() == [0, 10]
    assert "Interrupted after 14 decisions; -i logs/finetuned/HalfCheetah-v5_1/agent.zip" in capsys.readouterr().out
    model, agent = FinetunedDTFM.load(finetuned / "HalfCheetah-v5"), SAC.load(finetuned / "agent")
    np.testing.assert_array_equal(agent.actor.mu.weight.detach(), model.policy.online_actor.mean.weight)


def test_a_model_that_acts_by_its_mean_action_draws_in_noise_space(run, workplace, capsys):
    """As for agents' data: noise would change nothing there."""
    model = DTFM.load(run / "HalfCheetah-v5")
    model.policy.set_acting(flow_steps=1)
    model.save(run / "HalfCheetah-v5")
    assert main([*FINETUNE, "--model", str(run), "-params", *QUICK, "learning_starts:100"]) == 0
    assert "flow_steps=1 becomes 3: else the model takes its mean action" in capsys.readouterr().out
    finetuned = FinetunedDTFM.load(workplace / "logs/finetuned/HalfCheetah-v5_1/HalfCheetah-v5")
    assert finetuned.policy.acting_settings()["flow_steps"] == 3


def test_where_noise_is_chosen_no_critic_chooses(workplace, capsys):
    critic = ["critic_steps:1", "n_action_samples:3", "embed_dim:16", "n_layers:1", "n_heads:1", "flow_hidden_dim:16"]
    assert main(tiny_training("dtfm", "dataset:" + repr(DATASET_ID), *critic)) == 0
    run = workplace / "logs/dtfm/HalfCheetah-v5_1"
    assert main([*FINETUNE, "--model", str(run), "-params", *QUICK, "learning_starts:100"]) == 0
    assert "n_action_samples=3 becomes 1: the online algorithm chooses the noise" in capsys.readouterr().out
    finetuned = FinetunedDTFM.load(workplace / "logs/finetuned/HalfCheetah-v5_1/HalfCheetah-v5")
    assert finetuned.policy.acting_settings()["n_action_samples"] == 1
    config = run / "HalfCheetah-v5" / "config.yml"
    settings = yaml.unsafe_load(config.read_text())
    settings["vec_env_wrapper"] = "stable_baselines3.common.vec_env.VecMonitor"
    config.write_text(yaml.dump(settings))
    assert main([*FINETUNE, "--model", str(run)]) == 2
    assert "it learned in stable_baselines3.common.vec_env.VecMonitor, where" in capsys.readouterr().err


def test_ten_evaluations_are_made_where_nothing_is_said(run, workplace):
    command = [
        "finetune",
        "--env",
        "HalfCheetah-v5",
        "--model",
        str(run),
        "-n",
        "40",
        "--eval-episodes",
        "1",
        "-params",
        *QUICK,
    ]
    assert main(command) == 0
    evaluations = np.load(workplace / "logs/finetuned/HalfCheetah-v5_1/evaluations.npz")
    assert evaluations["timesteps"].tolist() == [*range(0, 41, 4), 40], "and after the last gradient step"


@pytest.mark.parametrize(("algorithm", "quick"), [(SAC, QUICK), (PPO, QUICK_PPO)])
def test_how_often_a_run_is_evaluated_does_not_change_it(run, workplace, algorithm, quick):
    command = ["finetune", "--env", "HalfCheetah-v5", "--model", str(run), "--algo", algorithm.__name__.lower(), "-n", "48"]
    actors = []
    for number, every in ((1, "8"), (2, "-1")):
        evaluations = ["--eval-freq", every, "--eval-episodes", "1", "--seed", "1"]
        assert main([*command, *evaluations, "-params", *quick]) == 0
        actors.append(algorithm.load(workplace / f"logs/finetuned/HalfCheetah-v5_{number}/agent").policy.state_dict())
    for name, weights in actors[0].items():
        np.testing.assert_array_equal(weights, actors[1][name], err_msg=name)


def test_ppo_corrects_a_zip_file_with_a_target_of_its_own(run, workplace, capsys):
    """As for agents' data; one action of the run's chunks is executed, from the beginning of the curve on."""
    (workplace / "alone.zip").write_bytes((run / "HalfCheetah-v5.zip").read_bytes())
    target = ["--model", "alone.zip", "--algo", "ppo", "--target-return", "3", "--env-kwargs", "max_episode_steps:20"]
    assert main([*FINETUNE, *target, "-params", *QUICK_PPO]) == 0
    finetuned = workplace / "logs/finetuned/HalfCheetah-v5_1"
    model = FinetunedDTFM.load(finetuned / "HalfCheetah-v5")
    agent = PPO.load(finetuned / "agent")
    np.testing.assert_array_equal(agent.policy.action_net.weight.detach(), model.policy.online_actor.mean.weight)
    assert np.load(finetuned / "evaluations.npz")["timesteps"][-1] == agent.num_timesteps
    assert model.online_actor["residual"]
    assert model.policy.options.n_action_steps == 1
    output = capsys.readouterr().out
    assert "PPO adds residual actions to those of alone.zip" in output
    assert "n_action_steps=2 becomes 1: a residual action is added to each action" in output
    settings = yaml.unsafe_load((finetuned / "HalfCheetah-v5/config.yml").read_text())
    assert settings["residual_env"]["bound"] == 0.5
    assert main(["enjoy", "--algo", "finetuned", "--env", "HalfCheetah-v5", "--no-render", "-n", "45", "--load-best"]) == 0


def test_a_dtfm_goes_on_from_its_own_episodes(run, workplace, capsys):
    """And once more from there; each is a run of dtfm, as the first one, and its own episodes are taken along."""
    settings = ["--algo", "dtfm", "-tb", "tb", "-params", "n_episodes:2", "gradient_steps:2", "n_envs:2", "batch_size:4"]
    for number, n_before in ((2, 0), (3, 4)):
        source = workplace / f"logs/dtfm/HalfCheetah-v5_{number - 1}"
        command = ["finetune", "--env", "HalfCheetah-v5", "--model", str(source), "-n", "80", "--seed", "1", *settings]
        assert main([*command, "--eval-freq", "40", "--eval-episodes", "2"]) == 0
        online = workplace / f"logs/dtfm/HalfCheetah-v5_{number}"
        evaluations = np.load(online / "evaluations.npz")
        assert evaluations["timesteps"].tolist() == [0, 40, 80, 80], "before and after the gradient steps of the last round"
        assert evaluations["ep_lengths"].max() == 20, "of the run's own environment"
        own = load_dataset(online / "episodes.npz")
        assert own.episode_lengths.tolist() == [20] * (n_before + 4)
        model = DTFM.load(online / "HalfCheetah-v5")
        assert model.num_timesteps == 80
        assert not (online / "checkpoint.zip").exists()
    before = DTFM.load(run / "HalfCheetah-v5")
    assert any(
        (ours != theirs).any() for ours, theirs in zip(model.policy.parameters(), before.policy.parameters(), strict=True)
    )
    assert main(["enjoy", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--no-render", "-n", "45", "--load-best"]) == 0
    assert "Episode Length 20" in capsys.readouterr().out


def test_online_learning_that_was_interrupted_goes_on(run, workplace, capsys, monkeypatch):
    settings = ["--algo", "dtfm", "-params", "n_episodes:2", "gradient_steps:2", "n_envs:2", "batch_size:4"]
    command = ["finetune", "--env", "HalfCheetah-v5", "--model", str(run), "-n", "160", "--seed", "1", *settings]
    steps_of_both = OnlineDTFM._collect

    def interrupted(self, callback):
        if self.num_timesteps >= 80:
            signal.raise_signal(signal.SIGTERM)
        return steps_of_both(self, callback)

    with monkeypatch.context() as patch:
        patch.setattr(OnlineDTFM, "_collect", interrupted)
        with pytest.raises(SystemExit, match="143"):
            main([*command, "--eval-freq", "40", "--eval-episodes", "2"])
    online = workplace / "logs/dtfm/HalfCheetah-v5_2"
    assert f"sb3-dtfm finetune --resume {online.relative_to(workplace)} continues it." in capsys.readouterr().out
    n_before = load_dataset(online / "episodes.npz").n_episodes
    assert n_before == 4
    assert main(["train", "--resume", str(online)]) == 2
    assert "`sb3-dtfm finetune` started it" in capsys.readouterr().err
    assert main(["finetune", "--resume", str(online), "-n", "3"]) == 2
    assert "takes no other arguments" in capsys.readouterr().err
    assert main(["finetune", "--resume", str(online)]) == 0
    assert np.load(online / "evaluations.npz")["timesteps"].tolist()[:5] == [0, 40, 80, 120, 160]
    assert load_dataset(online / "episodes.npz").n_episodes > n_before
    assert DTFM.load(online / "HalfCheetah-v5").num_timesteps >= 160
    assert not (online / "checkpoint.zip").exists()


def test_a_run_that_ended_before_its_first_checkpoint_begins_anew(run, workplace, monkeypatch, capsys):
    """And not with the steps of the model that it goes on from, which are four, for its own."""
    settings = ["--algo", "dtfm", "--save-replay-buffer", "-params", "n_episodes:2", "gradient_steps:2", "batch_size:4"]
    command = ["finetune", "--env", "HalfCheetah-v5", "--model", str(run), "-n", "40", "--seed", "1", *settings, "n_envs:1"]
    with monkeypatch.context() as patch:
        patch.setattr(OnlineDTFM, "_collect", lambda *_: signal.raise_signal(signal.SIGINT))
        assert main([*command, "--eval-freq", "0"]) == 0
    online = workplace / "logs/dtfm/HalfCheetah-v5_2"
    undo_checkpoints(online)
    n_updates = DTFM.load(online / "HalfCheetah-v5")._n_updates
    assert main(["finetune", "--resume", str(online)]) == 0
    assert "was interrupted before its first checkpoint: training begins anew" in capsys.readouterr().out
    model = DTFM.load(online / "HalfCheetah-v5")
    assert (model.num_timesteps, model._n_updates) == (40, n_updates + 2)
    assert load_dataset(online / "episodes.npz").n_episodes == 2
    assert not list(online.glob("replay_buffer*"))


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "quick"), [(SAC, QUICK), (PPO, QUICK_PPO)])
def test_the_online_algorithm_goes_on_learning(run, workplace, algorithm, quick):
    arguments = ["--model", str(run), "--algo", algorithm.__name__.lower(), "--save-replay-buffer", "-params", *quick]
    assert main([*FINETUNE, *arguments]) == 0
    agent = workplace / "logs/finetuned/HalfCheetah-v5_1/agent.zip"
    assert main([*FINETUNE, *arguments, "-i", str(agent)]) == 0
    after = algorithm.load(workplace / "logs/finetuned/HalfCheetah-v5_2/agent")
    assert after._n_updates > algorithm.load(agent)._n_updates


@pytest.mark.slow
def test_a_replay_buffer_goes_on_with_as_many_environments(run, workplace, capsys):
    arguments = [*FINETUNE, "--model", str(run), "--save-replay-buffer", "-params", *QUICK]
    assert main(arguments) == 0
    agent = "logs/finetuned/HalfCheetah-v5_1/agent.zip"
    assert main([*arguments, "n_envs:2", "-i", agent]) == 2
    message = f"-i {agent}: its replay buffer has 1 environments, this run has 2; use -params n_envs:1."
    assert message in capsys.readouterr().err
    assert len(list((workplace / "logs/finetuned").iterdir())) == 1


def test_what_does_not_fit_is_said_in_one_line(run, workplace, capsys):
    assert main(tiny_training("dt", "dataset:" + repr(DATASET_ID))) == 0
    (workplace / "alone.zip").write_bytes((run / "HalfCheetah-v5.zip").read_bytes())
    untold = DTFM.load("alone")
    untold.target_return = None
    untold.save("untold")
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=1).save("agent")
    cut = workplace / "cut/HalfCheetah-v5"
    cut.mkdir(parents=True)
    (cut / "config.yml").write_text(
        "!!python/object/apply:collections.OrderedDict [[[noise_env, {model: old.zip, sha256: 1a}]]]"
    )
    (cut.parent / "agent_9_steps.zip").write_bytes((workplace / "agent.zip").read_bytes())
    (workplace / "mine.yml").write_text("default: {policy: MlpPolicy, n_steps: 8, batch_size: 8, n_timestep: 64}")
    wrong = "vec_env_wrapper:['stable_baselines3.common.vec_env.VecMonitor']"
    cases = {
        "--model nowhere": "nowhere does not exist; --model names a DTFM's zip file or its run's folder.",
        "--model logs/dt/HalfCheetah-v5_1": "was saved by 'DT', not by DTFM.",
        "--model agent.zip": "agent.zip: saved by another algorithm, one of stable_baselines3.",
        f"--model {run} --algo dtfm --dataset more.npz": "--dataset: refused, as the DTFM's own dataset is used",
        "--model untold.zip": "--target-return R: needed, as untold.zip was saved without one; `sb3-dtfm inspect DATASET` ",
        f"--model {run} --algo td3": "--algo td3: no packaged settings; those of dtfm, ppo, sac, tqc are.",
        "--model alone.zip --algo dtfm --target-return 3": "dataset:...: needed, as alone.zip does not tell what it learned",
        f"--model {run} --algo dtfm -params n_episods:3": "n_episods (did you mean n_episodes?): no hyperparameter of",
        f"--model {run} --algo dtfm -i alone.zip": "-i alone.zip: --model names the model to fine-tune",
        f"--model {run} --algo dtfm -params verbose:0": "verbose: no hyperparameter of finetune --algo dtfm.",
        f"--model {run} --algo dtfm -params policy_kwargs:dict(n_action_samples=4)": "policy_kwargs: are those of the model",
        f"--model {run} --algo dtfm -params n_action_samples:4": "policy_kwargs: are those of the model",
        "--resume logs/dtfm/HalfCheetah-v5_1 --seed 3": "takes no other arguments",
        f"--model {run} -params {wrong}": "expected sb3_dtfm.finetuning.NoiseActionVecEnv or",
        f"--model {run} -params use_sde:True": "its exploration depends on the state (use_sde)",
        f"--model {run} --algo ppo -i agent.zip": "-i: agent.zip was saved by SAC, not by PPO (--algo). It takes",
        f"--model {run} --algo sac -i untold.zip": "-i: untold.zip was saved by DTFM, not by SAC (--algo).",
        f"--model {run} --algo sac -i cut/agent_9_steps.zip": "learned on old.zip, not on these weights of",
        f"--model {run} --algo ppo --conf-file mine.yml": "n_timestep (did you mean n_timesteps?): no hyperparameter",
        f"--model {run} --algo ppo --conf-file mine.yml -n -1": "n_timesteps: the settings have none; add it there, or give",
        f"--model {run} -optimize": "-optimize: hyperparameters of finetune cannot be searched",
    }
    for arguments, message in cases.items():
        capsys.readouterr()
        assert main([*FINETUNE, *arguments.split()]) == 2, arguments
        assert message in capsys.readouterr().err, arguments
    assert main(["finetune", "--resume", "cut"]) == 2
    assert "it cannot resume; `finetune -i cut/agent_9_steps.zip` continues in a new run." in capsys.readouterr().err
    assert main(["train", "--algo", "finetuned", "--env", "HalfCheetah-v5"]) == 2
    assert "--algo finetuned: such models come from `sb3-dtfm finetune`" in capsys.readouterr().err
    assert not list((workplace / "logs").glob("finetuned/*"))
