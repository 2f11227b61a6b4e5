"""Which spaces a model takes: any bounded vector of actions in whatever precision, and an environment like its data."""

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import DatasetError, Trajectory, TrajectoryBuffer
from sb3_dtfm.envs import ReturnToGoWrapper
from tests.algorithms.small import make_model, record_curves
from tests.conftest import make_env, record_random_episodes

gym.register_envs(gymnasium_robotics)

REFUSED = {
    "unbounded": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "half bounded": spaces.Box(np.array([-1.0, -np.inf], np.float32), np.ones(2, np.float32)),
    "zero width": spaces.Box(np.array([-1.0, 0.5], np.float32), np.array([1.0, 0.5], np.float32)),
    "two axes": spaces.Box(-1.0, 1.0, (2, 3), np.float32),
    "integer": spaces.Box(0, 5, (2,), np.int64),
    "several discrete": spaces.MultiDiscrete([3, 2]),
    "binary": spaces.MultiBinary(2),
}


class PointMass(gym.Env):
    """A point that is pushed about in the plane for ten steps."""

    def __init__(self, action_space: spaces.Space) -> None:
        self.action_space = action_space
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self._state, self._n_steps = np.zeros(4), 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._state, self._n_steps = np.concatenate((self.np_random.normal(size=2), np.zeros(2))), 0
        return self._state.copy(), {}

    def step(self, action):
        self._state[2:] += 0.1 * np.resize(action, 2)
        self._state[:2] += 0.1 * self._state[2:]
        self._n_steps += 1
        return self._state.copy(), -float(np.linalg.norm(self._state[:2])), False, self._n_steps == 10, {}


def record(env: gym.Env, n_episodes: int = 3, n_steps: int = 10) -> list[Trajectory]:
    """Episodes under random actions, with observations as one vector."""
    env.action_space.seed(0)
    episodes = []
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed)
        observations, actions, rewards = [], [], []
        for _ in range(n_steps):
            observations.append(spaces.flatten(env.observation_space, observation))
            actions.append(env.action_space.sample())
            observation, reward, _, _, _ = env.step(actions[-1])
            rewards.append(float(reward))
        episodes.append(Trajectory(np.array(observations), np.array(actions), np.array(rewards), truncated=True))
    return episodes


def wrapped(env: gym.Env) -> gym.Env:
    return ReturnToGoWrapper(env, target_return=0.0)


DOUBLE_ENVS = {
    "box": lambda: PointMass(spaces.Box(np.array([-1.0, -0.3]), np.array([0.1, 2.0]), dtype=np.float64)),
    "kitchen": lambda: gym.make("FrankaKitchen-v1", max_episode_steps=10, disable_env_checker=True),
}


@pytest.mark.parametrize("with_env", [False, True])
@pytest.mark.parametrize("make", DOUBLE_ENVS.values(), ids=DOUBLE_ENVS)
@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_actions_of_float64_are_learned_and_given_back(algorithm, make, with_env, tmp_path):
    """0.1, 0.3 and the like have no float32 of their own: rounded there, an action may leave its space."""
    env = wrapped(make())
    assert env.action_space.dtype == np.float64
    buffer = TrajectoryBuffer.from_trajectories(record(make()), env.action_space)
    model = make_model(algorithm, buffer, env=env if with_env else None, learning_rate=0.1)
    model.learn(5).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    observation, _ = env.reset(seed=0)
    for _ in range(10):
        action, _ = loaded.predict(observation, deterministic=True)
        assert action.dtype == np.float64
        assert env.action_space.contains(action)
        observation, *_ = env.step(action)


OBSERVED = {
    "integers": (spaces.Box(0, 1000, (3,), np.int64), 3),
    "bytes": (spaces.Box(0, 255, (3,), np.uint8), 3),
    "one of four": (spaces.Discrete(4), 4),
    "several of some": (spaces.MultiDiscrete([2, 3]), 5),
    "a dictionary": (spaces.Dict(place=spaces.Box(-1.0, 1.0, (2,)), room=spaces.Discrete(3)), 5),
}


class Seen(PointMass):
    """A point mass of which something else is seen; what is pushed is bounded otherwise in each dimension."""

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([0.5, 7.0], np.float32)))
        self.observation_space = observation_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), *super().step(action)[1:]


@pytest.mark.parametrize("name", OBSERVED)
@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_whole_numbers_and_dictionaries_are_seen(algorithm, name):
    """And actions stay within the bounds of their dimension."""
    space, size = OBSERVED[name]
    env = wrapped(Seen(space))
    buffer = TrajectoryBuffer.from_trajectories(record(Seen(space)), env.action_space)
    model = make_model(algorithm, buffer, env=env, learning_rate=0.1).learn(3)
    assert model.policy.observation_dim == size
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        action, _ = model.predict(observation)
        observation, *_ = env.step(action)


@pytest.mark.parametrize("name", REFUSED)
def test_an_action_space_that_cannot_be_learned_is_refused_from_data(name):
    space = REFUSED[name]
    with pytest.raises(DatasetError, match="point mass") as refusal:
        TrajectoryBuffer.from_trajectories(record(PointMass(space), 1), space, source="point mass")
    assert str(space) in str(refusal.value)
    assert "dimension 1" in str(refusal.value) or name != "zero width"


@pytest.mark.parametrize("name", REFUSED)
def test_an_action_space_that_cannot_be_learned_is_refused_from_an_env(name):
    """As the action space it is, before the data are found not to fit."""
    space, learnable = REFUSED[name], spaces.Box(-1.0, 1.0, (2,), np.float32)
    buffer = TrajectoryBuffer.from_trajectories(record(PointMass(learnable), 1), learnable, source="point mass")
    with pytest.raises(ValueError, match=r"(?i)action") as refusal:
        make_model(DT, buffer, env=wrapped(PointMass(space)))
    assert str(space) in str(refusal.value)
    assert "point mass" not in str(refusal.value)
    assert "dimension 1" in str(refusal.value) or name != "zero width"


def make_pendulum(n_steps: int = 10) -> gym.Env:
    """Its observations have bounds, of which arrays say nothing."""
    return wrapped(gym.make("Pendulum-v1", max_episode_steps=n_steps))


@pytest.fixture(scope="module")
def pendulum_buffer():
    """One's own arrays: observations of three numbers, and that is all that is known of them."""
    env = gym.make("Pendulum-v1", max_episode_steps=10)
    return TrajectoryBuffer.from_trajectories(record(env), env.action_space, source="own arrays")


def test_a_model_of_ones_own_arrays_takes_the_real_env(pendulum_buffer, tmp_path):
    model = make_model(DT, pendulum_buffer)
    model.set_env(make_pendulum())
    assert model.get_env().num_envs == 1
    model.save(tmp_path / "model")
    loaded = DT.load(tmp_path / "model", env=DummyVecEnv([make_pendulum] * 2))
    assert loaded.get_env().num_envs == 2


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_a_model_of_ones_own_arrays_is_evaluated_in_the_real_env(algorithm, pendulum_buffer):
    model = make_model(algorithm, pendulum_buffer)
    curves = record_curves(model)
    model.learn(2, callback=EvalCallback(Monitor(make_pendulum()), eval_freq=2, n_eval_episodes=1, verbose=0))
    ((step, reward),) = curves.points["eval/mean_reward"]
    assert step == 2
    assert reward < 0.0


@pytest.mark.parametrize("own_arrays", [True, False])
def test_an_env_of_another_shape_or_range_is_refused(own_arrays, pendulum_buffer, tmp_path):
    """Whether the model's spaces come from arrays or from an environment."""
    model = make_model(DT, pendulum_buffer, env=None if own_arrays else make_pendulum())
    model.save(tmp_path / "model")
    louder = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(-3.0), np.float32(3.0))
    for env, named in ((make_env(), r"\(17,\).*\(3,\)"), (wrapped(louder), "Box.*3.0.*Box.*2.0")):
        with pytest.raises(ValueError, match=named):
            model.set_env(env)
        with pytest.raises(ValueError, match=named):
            DT.load(tmp_path / "model", env=env)
        if own_arrays:  # the environment of an evaluation becomes the model's where it has none
            with pytest.raises(ValueError, match=named):
                model.learn(1, callback=EvalCallback(Monitor(env), eval_freq=1, n_eval_episodes=1, verbose=0))


def test_random_cheetah_fits_its_env(cheetah_buffer):
    """An observation space without bounds is what arrays give as well."""
    buffer = TrajectoryBuffer.from_trajectories(record_random_episodes(1), cheetah_buffer.action_space)
    model = make_model(DT, buffer)
    model.set_env(make_env())
    assert model.get_env() is not None


def test_an_environment_of_gymnasiums_own_vectors_is_refused(cheetah_buffer):
    with pytest.raises(ValueError, match=r"env is a SyncVectorEnv: write make_vec_env\(env_id, n_envs\)"):
        DTFM("MultiInputPolicy", gym.make_vec("HalfCheetah-v5", num_envs=2), cheetah_buffer)
