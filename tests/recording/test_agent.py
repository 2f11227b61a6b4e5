"""Recording agents: what is written is what was executed, each episode with its seed, complete or not at all."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit, TransformObservation
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dtfm.data import DatasetError, load_minari
from sb3_dtfm.recording.agent import random_actions, record_agent
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes
from sb3_dtfm.recording.minari import write_minari

AGENTS = Path(__file__).parents[2].parent / "shared" / "agents"
SHORT = {"max_episode_steps": 15}


class Countdown(gym.Env):
    """
    Episodes of 1 to 40 steps, the number drawn at reset; it breaks at the step `breaks_at` of its life.

    Observations are one array that changes in place.
    """

    observation_space = spaces.Box(0.0, 100.0, (1,), np.float64)
    action_space = spaces.Box(np.array([-2.0], np.float32), np.array([1.0], np.float32))

    def __init__(self, breaks_at: int | None = None) -> None:
        self.breaks_at = breaks_at
        self.n_steps = 0
        self.left = np.zeros(1)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.left[0] = self.np_random.integers(1, 41)
        return self.left, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.n_steps += 1
        if self.n_steps == self.breaks_at:
            raise RuntimeError("the simulator broke")
        self.left -= 1
        return self.left, float(action[0]), bool(self.left == 0), False, {}


gym.register("Countdown-v0", entry_point=Countdown)
pytestmark = pytest.mark.filterwarnings(
    "ignore:The environment cannot be recovered", "ignore:.*render_mode", "ignore:.*share an object"
)


@pytest.fixture(autouse=True)
def datasets_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def save_ppo(env_id: str, path: Path) -> Path:
    PPO("MlpPolicy", env_id, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0).learn(8).save(path)
    return path


@pytest.fixture(scope="module")
def pendulum_agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_ppo("Pendulum-v1", tmp_path_factory.mktemp("agents") / "tiny-pendulum.zip")


@pytest.fixture(scope="module")
def countdown_agent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_ppo("Countdown-v0", tmp_path_factory.mktemp("agents") / "tiny-countdown.zip")


def record(model_path: Path, env_id: str = "Pendulum-v1", n_episodes: int = 3, **kwargs: Any) -> minari.MinariDataset:
    env_kwargs = SHORT if env_id != "Countdown-v0" else None
    settings = {"algo": "ppo", "dataset_id": "test/recorded-v0", "env_kwargs": env_kwargs, "progress": False, **kwargs}
    return record_agent(model_path=model_path, env_id=env_id, n_episodes=n_episodes, **settings)


def seeds(dataset: minari.MinariDataset) -> list[int]:
    return [episode["seed"] for episode in dataset.storage.get_episode_metadata(dataset.episode_indices)]


def same_episodes(first: minari.MinariDataset, second: minari.MinariDataset) -> bool:
    pairs = zip(first, second, strict=True)
    return all(np.array_equal(a.observations, b.observations) and np.array_equal(a.actions, b.actions) for a, b in pairs)


def test_the_dataset_tells_where_it_comes_from(pendulum_agent: Path):
    dataset = record(pendulum_agent, n_episodes=5)
    metadata = dataset.storage.metadata
    returns = [float(np.sum(episode.rewards)) for episode in dataset]
    assert minari.load_dataset("test/recorded-v0").total_episodes == 5
    assert metadata["algorithm_name"] == "PPO"
    assert "re-recorded from tiny-pendulum.zip" in metadata["description"]
    assert metadata["minari_version"] == minari.__version__
    assert metadata["ref_max_score"] == pytest.approx(np.mean(returns))
    assert np.isfinite(metadata["ref_min_score"])
    assert dataset.recover_environment().spec.max_episode_steps == 15
    assert "test" in minari.namespace.list_local_namespaces()


def test_episodes_are_as_the_environment_gave_them(pendulum_agent: Path):
    dataset = record(pendulum_agent, deterministic=False, n_envs=2)
    env = dataset.recover_environment()
    for episode, seed in zip(dataset, seeds(dataset), strict=True):
        assert len(episode.observations) == len(episode.actions) + 1 == 16
        observation, _ = env.reset(seed=seed)
        for step, action in enumerate(episode.actions):
            np.testing.assert_array_equal(observation, episode.observations[step])
            observation, reward, terminated, truncated, _ = env.step(action)
            assert reward == episode.rewards[step]
            assert (terminated, truncated) == (episode.terminations[step], episode.truncations[step])
        np.testing.assert_array_equal(observation, episode.observations[-1])


@pytest.mark.filterwarnings("default:The environment cannot be recovered")
def test_an_environment_whose_spec_is_not_storable_is_recorded_with_a_warning(countdown_agent: Path):
    with pytest.warns(UserWarning, match="cannot be recovered"):
        dataset = record(countdown_agent, "Countdown-v0")
    assert dataset.env_spec is None
    assert load_minari(dataset).n_episodes == 3


def test_float64_observations_stay_float64(countdown_agent: Path):
    assert record(countdown_agent, "Countdown-v0")[0].observations.dtype == np.float64


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_seed_repeats_the_recording(deterministic: bool, pendulum_agent: Path):
    settings: dict[str, Any] = {"deterministic": deterministic, "noise": 0.1, "n_envs": 2}
    first = record(pendulum_agent, dataset_id="test/a-v0", seed=4, **settings)
    again = record(pendulum_agent, dataset_id="test/b-v0", seed=4, **settings)
    other = record(pendulum_agent, dataset_id="test/c-v0", seed=5, **settings)
    assert same_episodes(first, again)
    assert not same_episodes(first, other)


def test_short_episodes_are_not_over_represented(countdown_agent: Path):
    datasets = [record(countdown_agent, "Countdown-v0", 40, dataset_id=f"test/envs{n}-v0", n_envs=n) for n in (1, 7)]
    assert seeds(datasets[0]) == seeds(datasets[1])
    for dataset in datasets:
        env = Countdown()
        lengths = [int(env.reset(seed=seed)[0][0]) for seed in seeds(dataset)]
        assert [len(episode.rewards) for episode in dataset] == lengths
        assert all(episode.terminations[-1] for episode in dataset)


def test_noise_has_the_stated_size_and_stays_in_the_action_space(countdown_agent: Path):
    dataset = record(countdown_agent, "Countdown-v0", 60, noise=0.05)
    agent = PPO.load(countdown_agent, device="cpu")
    actions = np.concatenate([episode.actions for episode in dataset])
    observations = np.concatenate([episode.observations[:-1] for episode in dataset])
    noise = actions - agent.predict(observations, deterministic=True)[0]
    inside = (actions > -2.0) & (actions < 1.0)
    assert np.std(noise[inside]) == pytest.approx(0.05 * 3.0, rel=0.1)
    large = record(countdown_agent, "Countdown-v0", 20, noise=2.0, dataset_id="test/large-v0")
    actions = np.concatenate([episode.actions for episode in large])
    assert (actions.min(), actions.max()) == (-2.0, 1.0)
    assert large[0].rewards.tolist() == large[0].actions[:, 0].tolist()


def test_without_noise_the_agent_acts_alone(countdown_agent: Path):
    dataset = record(countdown_agent, "Countdown-v0", 4)
    agent = PPO.load(countdown_agent, device="cpu")
    for episode in dataset:
        expected, _ = agent.predict(episode.observations[:-1], deterministic=True)
        np.testing.assert_allclose(episode.actions, expected, atol=1e-6)


def test_an_agent_with_memory_keeps_it_within_each_episode(tmp_path: Path):
    path = tmp_path / "recurrent.zip"
    model = RecurrentPPO("MlpLstmPolicy", "Countdown-v0", n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0)
    model.learn(8).save(path)
    dataset = record(path, "Countdown-v0", 8, algo="ppo_lstm", n_envs=3)
    for episode in dataset:
        state, start = None, np.ones(1, bool)
        for observation, action in zip(episode.observations[:-1], episode.actions, strict=True):
            expected, state = model.predict(observation[None], state, start, deterministic=True)
            start = np.zeros(1, bool)
            np.testing.assert_allclose(action, expected[0], atol=1e-5)


def test_normalisation_statistics_are_applied_and_raw_observations_recorded(tmp_path: Path, countdown_agent: Path):
    statistics = VecNormalize(DummyVecEnv([Countdown]))
    statistics.obs_rms.mean, statistics.obs_rms.var = np.array([20.0]), np.array([100.0])
    statistics.save(str(tmp_path / "vecnormalize.pkl"))
    dataset = record(countdown_agent, "Countdown-v0", 5, vec_normalize_path=tmp_path / "vecnormalize.pkl")
    agent = PPO.load(countdown_agent, device="cpu")
    for episode in dataset:
        assert episode.observations[-1, 0] == 0.0
        expected, _ = agent.predict((episode.observations[:-1] - 20.0) / 10.0, deterministic=True)
        np.testing.assert_allclose(episode.actions, expected, atol=1e-5)


def test_goal_environments_are_recorded_and_read(tmp_path: Path):
    path = tmp_path / "reach.zip"
    SAC("MultiInputPolicy", "FetchReach-v4", buffer_size=10, device="cpu", policy_kwargs={"net_arch": [8]}).save(path)
    dataset = record(path, "FetchReach-v4", 3, algo="sac", n_envs=2)
    assert set(dataset[0].observations) == {"achieved_goal", "desired_goal", "observation"}
    buffer = load_minari(dataset)
    assert buffer.observations.shape == (45, 16)
    assert buffer.truncated.all()


def test_an_existing_dataset_is_kept_unless_told_otherwise(countdown_agent: Path):
    record(countdown_agent, "Countdown-v0", 2)
    with pytest.raises(DatasetError, match="test/recorded-v0 exists at"):
        record(countdown_agent, "Countdown-v0", 3)
    assert minari.load_dataset("test/recorded-v0").total_episodes == 2
    record(countdown_agent, "Countdown-v0", 3, overwrite=True)
    assert minari.load_dataset("test/recorded-v0").total_episodes == 3


def test_a_recording_that_breaks_leaves_nothing_behind(countdown_agent: Path, datasets_path: Path):
    record(countdown_agent, "Countdown-v0", 2)
    before = sorted(datasets_path.rglob("*"))
    for dataset_id in ("test/recorded-v0", "test/new-v0"):
        settings = {"dataset_id": dataset_id, "env_kwargs": {"breaks_at": 300}, "overwrite": True, "n_envs": 2}
        with pytest.raises(RuntimeError, match="the simulator broke"):
            record(countdown_agent, "Countdown-v0", 100, **settings)
    assert sorted(datasets_path.rglob("*")) == before
    assert minari.load_dataset("test/recorded-v0").total_episodes == 2


def test_what_is_replaced_comes_back_where_that_is_interrupted(countdown_agent: Path, datasets_path: Path, monkeypatch):
    record(countdown_agent, "Countdown-v0", 2)
    before, rename = sorted(datasets_path.rglob("*")), Path.rename

    def interrupted(path: Path, target: Path) -> Path:
        if path.name == "new":
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record(countdown_agent, "Countdown-v0", 3, overwrite=True)
    assert sorted(datasets_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"algo": "alphago"}, ValueError, "Unknown algorithm 'alphago'; known are .*tqc"),
        ({"model_path": Path("nowhere.zip")}, FileNotFoundError, "nowhere.zip does not exist"),
        ({"vec_normalize_path": "nowhere.pkl"}, FileNotFoundError, "nowhere.pkl does not exist"),
        ({"dataset_id": "no version"}, DatasetError, "namespace/name-vN"),
        ({"n_episodes": 0}, ValueError, "n_episodes must be at least 1"),
        ({"n_envs": 0}, ValueError, "n_envs must be at least 1"),
        ({"noise": -0.1}, ValueError, "noise must be"),
        ({"seed": -1}, ValueError, "seed must be 0 or more, got -1"),
        ({"noise": float("nan")}, ValueError, "noise must be"),
        ({"env_id": "CartPole-v1"}, ValueError, "tiny-pendulum.zip was trained with observation_space .*CartPole-v1"),
        ({"env_id": "HalfCheetah-v5"}, ValueError, "tiny-pendulum.zip was trained with observation_space .*HalfCheetah-v5"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_it_starts(
    changes: dict[str, Any], error: type[Exception], message: str, pendulum_agent: Path, datasets_path: Path
):
    with pytest.raises(error, match=message):
        record(**{"model_path": pendulum_agent, **changes})
    assert not list(datasets_path.rglob("*.hdf5"))


@pytest.mark.skipif(not AGENTS.is_dir(), reason=f"no trained agents in {AGENTS}")
def test_a_trained_agent_is_recorded_with_its_return():
    dataset = record_agent(
        "tqc", AGENTS / "tqc-HalfCheetah-v5.zip", "HalfCheetah-v5", 2, "test/expert-v0", n_envs=2, progress=False
    )
    buffer = load_minari(dataset)
    assert buffer.episode_lengths.tolist() == [1000, 1000]
    assert buffer.episode_returns.mean() == pytest.approx(12_146, rel=0.05)
    assert buffer.score_reference is not None
    assert buffer.score_reference.minimum == pytest.approx(-280, abs=100)


class Ram(gym.Env):
    """Shows bytes, as consoles do, a vector of them and a small matrix."""

    observation_space = spaces.Dict(
        {
            "ram": spaces.Box(0, 255, (6,), np.uint8),
            "tiles": spaces.Box(0, 255, (4, 5), np.uint8),
            "x": spaces.Box(-1, 1, (2,)),
        }
    )
    action_space = spaces.Box(-1.0, 1.0, (3,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 1.0, False, False, {}


def test_bytes_are_read_back_as_they_were():
    env = TimeLimit(EpisodeRecorder(Ram()), 9)
    episodes = list(run_episodes([env], random_actions(env, 0), [0, 1]))
    dataset = write_minari("tests/ram/bytes-v0", iter(episodes), env, {})
    for read, episode in zip(dataset, episodes, strict=True):
        for key in ("ram", "tiles", "x"):
            np.testing.assert_array_equal(read.observations[key], [each[key] for each in episode.observations])


def test_a_vector_of_bytes_can_be_learned_from(tmp_path: Path):
    gym.register("tests/Ram-v0", lambda: TransformObservation(Ram(), lambda each: each["ram"], Ram.observation_space["ram"]),
                 max_episode_steps=9)  # fmt: skip
    try:
        dataset = record(save_ppo("tests/Ram-v0", tmp_path / "agent.zip"), "tests/Ram-v0")
        buffer = load_minari(dataset)
    finally:
        del gym.registry["tests/Ram-v0"]
    assert buffer.observation_space.shape == (6,)
    assert [len(episode.observations) for episode in dataset] == [16, 16, 16]
    assert len(buffer) == 45


class Unseeded(Countdown):
    """Draws its starts from a generator of its own, as Meta-World does."""

    generator = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.left[0] = self.generator.integers(1, 41)
        return self.left.copy(), {}


def test_an_environment_that_does_not_start_from_its_seed_is_warned_of(countdown_agent: Path):
    gym.register("Unseeded-v0", entry_point=Unseeded)
    with pytest.warns(UserWarning, match="two reset.* start differently, so the recorded seeds do not replay its episodes"):
        record(countdown_agent, "Unseeded-v0", env_kwargs=None)
