"""Discrete actions from the command line: recorded, looked at, learned from, refused to DTFM."""

import shlex

import minari
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO

from sb3_dtfm.cli.main import main
from tests.recorded import TINY

ID = "tests/cartpole/agent-v0"


@pytest.fixture(scope="module")
def agents(tmp_path_factory):
    """Such as have hardly learned."""
    folder = tmp_path_factory.mktemp("agents")
    PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu").save(folder / "ppo.zip")
    DQN("MlpPolicy", "CartPole-v1", device="cpu").save(folder / "dqn.zip")
    return folder


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def record(agent, *options):
    algo = agent.stem
    task = ["--env", "CartPole-v1", "--episodes", "4", "--dataset-id", ID]
    return main(["record", "--algo", algo, "--model", str(agent), *task, *options])


@pytest.mark.parametrize("algo", ["ppo", "dqn"])
@pytest.mark.parametrize("options", [[], ["--stochastic"]])
def test_an_agents_episodes_replay(algo, options, agents):
    assert record(agents / f"{algo}.zip", *options) == 0
    dataset = minari.load_dataset(ID)
    env = dataset.recover_environment()
    seeds = [episode["seed"] for episode in dataset.storage.get_episode_metadata(dataset.episode_indices)]
    for episode, seed in zip(dataset, seeds, strict=True):
        assert episode.actions.dtype == np.int64
        assert episode.actions.shape == episode.rewards.shape
        observation, _ = env.reset(seed=seed)
        for step, action in enumerate(episode.actions):
            np.testing.assert_array_equal(observation, episode.observations[step])
            observation, *_ = env.step(action)
    assert dataset.storage.metadata["ref_min_score"] > 5.0
    assert "Gaussian" not in dataset.storage.metadata["description"]


def test_noise_is_refused(agents, capsys):
    assert record(agents / "ppo.zip", "--noise", "0.1") == 2
    assert (
        "noise must be 0 for Discrete(2), got 0.1; actions that are sampled (--stochastic) vary" in capsys.readouterr().err
    )


def test_what_inspect_shows_is_what_train_takes(agents, capsys):
    assert record(agents / "ppo.zip", "--stochastic") == 0
    assert main(["inspect", ID]) == 0
    text = capsys.readouterr().out
    dataset = minari.load_dataset(ID)
    chosen = np.bincount(np.concatenate([episode.actions for episode in dataset]), minlength=2)
    (row,) = [line for line in text.splitlines() if line.startswith("| actions")]
    for action in (0, 1):
        assert f"{action} in {chosen[action]} steps" in row
    command = shlex.split(text.split("To begin with:\n")[1].splitlines()[0])
    assert command[command.index("--algo") + 1] == "dt"
    short = ["-n", "2", "--eval-freq", "-1", "--verbose", "0"]
    assert main([*command[1:], *short]) == 0
    command[command.index("--algo") + 1] = "dtfm"
    capsys.readouterr()
    assert main([*command[1:], *short, "-params", TINY["dtfm"]]) == 2
    assert "DTFM learns vectors of numbers and not Discrete(2); use DT for Discrete actions." in capsys.readouterr().err
