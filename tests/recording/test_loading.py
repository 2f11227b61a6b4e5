"""Agents and what they were trained with: an RL-Zoo run is played as RL-Zoo plays it, and what does not fit is refused."""

import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import yaml
from rl_zoo3.utils import create_test_env, get_saved_hyperparams, get_wrapper_class
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.recording.loading import find_agent, load_agent, load_fitting_agent
from tests.recorded import DATASET_ID as CHEETAH_DATA
from tests.recorded import tiny_training

AGENTS = Path(__file__).parents[2].parent / "shared" / "agents"
DATASET_ID = "test/run-v0"
ALGORITHMS = {
    "a2c": stable_baselines3.A2C,
    "ddpg": stable_baselines3.DDPG,
    "ppo": stable_baselines3.PPO,
    "sac": stable_baselines3.SAC,
    "td3": stable_baselines3.TD3,
    "ars": sb3_contrib.ARS,
    "crossq": sb3_contrib.CrossQ,
    "tqc": sb3_contrib.TQC,
    "trpo": sb3_contrib.TRPO,
    "ppo_lstm": sb3_contrib.RecurrentPPO,
}
SAME_FILES = {"ddpg": {"ddpg", "td3"}, "td3": {"ddpg", "td3"}}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of RL-Zoo: a few steps of PPO, which sees normalised observations with the time, in weak gravity."""
    folder = tmp_path_factory.mktemp("logs")
    options = ["--eval-freq", "-1", "--log-folder", str(folder), "--seed", "1", "--device", "cpu", "--env-kwargs", "g:5.0"]
    params = ["n_timesteps:64", "n_envs:1", "n_steps:32", "batch_size:32", "n_epochs:1", "normalize:True"]
    params += ["env_wrapper:'sb3_contrib.common.wrappers.TimeFeatureWrapper'"]
    assert main(["train", "--algo", "ppo", "--env", "Pendulum-v1", *options, "-params", *params]) == 0
    return folder / "ppo" / "Pendulum-v1_1"


@pytest.fixture(autouse=True)
def datasets_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def record(model: Path, *arguments: str, algo: str = "ppo") -> int:
    options = ["--env", "Pendulum-v1", "--episodes", "2", "--n-envs", "1", "--dataset-id", DATASET_ID]
    return main(["record", "--algo", algo, "--model", str(model), *options, *arguments])


def copy(run: Path, folder: Path, **config: Any) -> Path:
    """The same run with other settings in its config.yml."""
    shutil.copytree(run, folder)
    path = folder / "Pendulum-v1" / "config.yml"
    path.write_text(yaml.dump({**yaml.load(path.read_text(), Loader=yaml.UnsafeLoader), **config}))
    return folder


@pytest.mark.filterwarnings("error:.*without step")  # where an environment has nothing more to do
def test_a_run_of_ours_is_recorded_with_its_return_to_go(workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    assert main(tiny_training("dtfm", "--dataset", CHEETAH_DATA, "--eval-freq", "-1")) == 0
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(workplace / "datasets"))
    run = workplace / "logs" / "dtfm" / "HalfCheetah-v5_1"
    arguments = ["--model", str(run), "--env", "HalfCheetah-v5", "--episodes", "3", "--n-envs", "2"]
    arguments += ["--dataset-id", DATASET_ID, "--env-kwargs", "max_episode_steps:30"]
    assert main(["record", "--algo", "dt", *arguments]) == 2
    assert "HalfCheetah-v5.zip was saved by DTFM, not by DT (--algo)" in capsys.readouterr().err
    assert main(["record", "--algo", "dtfm", *arguments]) == 0
    dataset = minari.load_dataset(DATASET_ID)
    model = DTFM.load(run / "HalfCheetah-v5.zip", device="cpu")
    hyperparams, _ = get_saved_hyperparams(str(run / "HalfCheetah-v5"))
    env = get_wrapper_class(hyperparams)(gym.make("HalfCheetah-v5", max_episode_steps=30))
    for episode in dataset:
        assert episode.observations.shape == (31, 17)
        (metadata,) = dataset.storage.get_episode_metadata([episode.id])
        observation, _ = env.reset(seed=metadata["seed"])
        state, start = None, np.ones(1, bool)
        for recorded_action in episode.actions:
            action, state = model.predict(observation, state, start, deterministic=True)
            np.testing.assert_allclose(action, recorded_action, atol=1e-5)
            observation, start = env.step(recorded_action)[0], np.zeros(1, bool)


@pytest.mark.parametrize("named", [".", "Pendulum-v1.zip"])
def test_a_run_is_recorded_as_rl_zoo_plays_it_and_the_bare_environment_gives_it(named: str, run: Path):
    assert record(run / named) == 0
    dataset = minari.load_dataset(DATASET_ID)
    hyperparams, stats_path = get_saved_hyperparams(str(run / "Pendulum-v1"), test_mode=True)
    env = create_test_env(
        "Pendulum-v1",
        stats_path=stats_path,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs={"g": 5.0},
        vec_env_cls=DummyVecEnv,
    )
    assert isinstance(env, VecNormalize)
    agent = PPO.load(run / "Pendulum-v1.zip", device="cpu")
    seeds = [episode["seed"] for episode in dataset.storage.get_episode_metadata(dataset.episode_indices)]
    for episode, seed in zip(dataset, seeds, strict=True):
        assert episode.observations.shape == (201, 3)
        env.seed(seed)
        observation = env.reset()
        for step, recorded_action in enumerate(episode.actions):
            np.testing.assert_array_equal(env.get_original_obs()[0, :3], episode.observations[step])
            action, _ = agent.predict(observation, deterministic=True)
            np.testing.assert_array_equal(action[0], recorded_action)
            observation, _, _, _ = env.step(action)
            assert env.get_original_reward()[0] == np.float32(episode.rewards[step])
    assert dataset.env_spec.kwargs["g"] == 5.0
    assert dataset.env_spec.additional_wrappers == ()


def test_arguments_on_the_command_line_are_added_to_those_of_the_run(run: Path):
    assert record(run, "--env-kwargs", "max_episode_steps:7", "g:2.5") == 0
    dataset = minari.load_dataset(DATASET_ID)
    assert dataset.env_spec.kwargs["g"] == 2.5
    assert [len(episode.actions) for episode in dataset] == [7, 7]


def test_an_argument_that_is_no_literal_is_refused(run: Path, capsys):
    with pytest.raises(SystemExit):
        record(run, "--env-kwargs", "g")
    assert "'g' is no key:value" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("key", "value"), [("frame_stack", 4), ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecMonitor")]
)
def test_a_run_that_vectorised_wrappers_belong_to_is_refused(key: str, value: Any, run: Path, tmp_path: Path, capsys):
    assert record(copy(run, tmp_path / "run", **{key: value})) == 2
    assert f"config.yml: {key} is {value!r}; agents trained so cannot be recorded" in capsys.readouterr().err


def test_a_run_that_lacks_its_statistics_is_refused(run: Path, tmp_path: Path, capsys):
    statistics = copy(run, tmp_path / "run") / "Pendulum-v1" / "vecnormalize.pkl"
    statistics.rename(tmp_path / "elsewhere.pkl")
    assert record(tmp_path / "run") == 2
    assert f"{statistics} does not exist" in capsys.readouterr().err
    assert (
        record(tmp_path / "run", "--vec-normalize", str(tmp_path / "elsewhere.pkl"), "--env-kwargs", "max_episode_steps:5")
        == 0
    )


def test_a_folder_without_the_environments_model_is_refused(run: Path, capsys):
    assert record(run.parent) == 2
    assert f"{run.parent / 'Pendulum-v1.zip'} does not exist; expected" in capsys.readouterr().err


def normalized_agent(algorithm: type[BaseAlgorithm], folder: Path, env_id: str = "Pendulum-v1", **kwargs: Any) -> Path:
    """A few steps behind `VecNormalize(**kwargs)`, whose statistics are saved beside the agent."""
    env = VecNormalize(DummyVecEnv([lambda: gym.make(env_id)]), **kwargs)
    short = {"n_steps": 32, "batch_size": 32} if algorithm is PPO else {"buffer_size": 100, "learning_starts": 100}
    algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", **short).learn(32).save(folder / "agent.zip")
    env.save(str(folder / "statistics.pkl"))
    return folder / "agent.zip"


def test_an_agent_without_its_statistics_is_refused(tmp_path: Path, datasets_path: Path, capsys):
    path = normalized_agent(PPO, tmp_path)
    agent = PPO.load(path, device="cpu")
    assert record(path) == 2
    assert "agent.zip was trained with VecNormalize" in capsys.readouterr().err
    assert not list(datasets_path.rglob("*.hdf5"))

    statistics = VecNormalize.load(str(tmp_path / "statistics.pkl"), DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    assert record(path, "--vec-normalize", str(tmp_path / "statistics.pkl")) == 0
    for episode in minari.load_dataset(DATASET_ID):
        expected, _ = agent.predict(statistics.normalize_obs(episode.observations[:-1]), deterministic=True)
        np.testing.assert_allclose(episode.actions, expected, atol=1e-5)

    assert record(path, "--vec-normalize", "none", "--overwrite") == 0
    for episode in minari.load_dataset(DATASET_ID):
        expected, _ = agent.predict(episode.observations[:-1], deterministic=True)
        np.testing.assert_allclose(episode.actions, expected, atol=1e-5)


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_observations_of_float64_tell_whether_they_were_normalised(algorithm: type[BaseAlgorithm], tmp_path: Path):
    env_id, name = "InvertedPendulum-v5", algorithm.__name__.lower()
    files = find_agent(normalized_agent(algorithm, tmp_path, env_id), env_id)
    with pytest.raises(ValueError, match=r"agent.zip was trained with VecNormalize"):
        load_fitting_agent(name, files, gym.make(env_id), None, "cpu")
    files = find_agent(normalized_agent(algorithm, tmp_path, env_id, norm_obs=False), env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_fitting_agent(name, files, gym.make(env_id), None, "cpu")[1] is None


def test_an_agent_that_does_not_tell_whether_it_needs_statistics_is_warned_of(tmp_path: Path):
    files = find_agent(normalized_agent(SAC, tmp_path), "Pendulum-v1")
    with pytest.warns(UserWarning, match="agent.zip does not tell whether it was trained with VecNormalize"):
        load_fitting_agent("sac", files, gym.make("Pendulum-v1"), None, "cpu")


def test_a_run_tells_that_its_agent_needs_no_statistics(tmp_path: Path):
    agent = normalized_agent(SAC, tmp_path, norm_obs=False).rename(tmp_path / "Pendulum-v1.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    for name, content in {"config.yml": "{policy: MlpPolicy}", "args.yml": "{}"}.items():
        (tmp_path / "Pendulum-v1" / name).write_text(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, statistics = load_fitting_agent("sac", find_agent(agent, "Pendulum-v1"), gym.make("Pendulum-v1"), None, "cpu")
    assert statistics is None


def test_statistics_of_something_else_are_refused(run: Path, tmp_path: Path, capsys):
    statistics = str(run / "Pendulum-v1" / "vecnormalize.pkl")  # of observations with the time, (4,)
    assert record(normalized_agent(PPO, tmp_path), "--vec-normalize", statistics) == 2
    assert f"{statistics}: no VecNormalize for Box" in capsys.readouterr().err


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An agent of each algorithm."""
    folder = tmp_path_factory.mktemp("agents")
    for name, algorithm in ALGORITHMS.items():
        policy = next(iter(algorithm.policy_aliases))
        algorithm(policy, "Pendulum-v1", device="cpu", policy_kwargs={"net_arch": [8]}).save(folder / f"{name}.zip")
    return {name: folder / f"{name}.zip" for name in ALGORITHMS}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_agent_loads_as_its_own_algorithm_alone(name: str, saved: dict[str, Path]):
    assert type(load_agent(name, saved[name], "cpu")) is ALGORITHMS[name]
    for other in ALGORITHMS.keys() - SAME_FILES.get(name, {name}):
        with pytest.raises(
            ValueError, match=rf"{name}.zip was saved by \w+, not by {ALGORITHMS[other].__name__} \(--algo\)"
        ):
            load_agent(other, saved[name], "cpu")


class OwnPolicy(ActorCriticPolicy):
    """Some user's."""


def test_a_policy_of_ones_own_does_not_hide_the_algorithm(tmp_path: Path):
    PPO(OwnPolicy, "Pendulum-v1", device="cpu").save(tmp_path / "own.zip")
    assert isinstance(load_agent("ppo", tmp_path / "own.zip", "cpu").policy, OwnPolicy)
    with pytest.raises(ValueError, match=r"own.zip was saved by"):
        load_agent("a2c", tmp_path / "own.zip", "cpu")


def test_a_file_that_holds_no_agent_is_refused(tmp_path: Path):
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(ValueError, match=r"text.zip: no model of Stable-Baselines3"):
        load_agent("ppo", tmp_path / "text.zip", "cpu")


@pytest.mark.skipif(not AGENTS.is_dir(), reason=f"no trained agents in {AGENTS}")
def test_trained_agents_load():
    for path in AGENTS.glob("*.zip"):
        name = path.name.split("-")[0]
        assert type(load_agent(name, path, "cpu")) is ALGORITHMS[name]
