"""The return-to-go wrapper: its spaces, its countdown, and that it agrees with recorded data to the bit."""

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_dtfm.data import load_dataset, load_minari
from sb3_dtfm.envs import (
    ReturnToGoWrapper,
    check_vec_env,
    flatten_observation_space,
    known_task,
    reader_options,
    register_gymnasium_robotics,
    return_to_go_space,
)
from sb3_dtfm.recording.agent import record_agent

register_gymnasium_robotics()

# Processes that are forked have imported everything already.
VEC_ENVS = [DummyVecEnv, pytest.param(partial(SubprocVecEnv, start_method="fork"), id="SubprocVecEnv")]


class ConstantReward(gym.Env):
    """Rewards 0.1 a step and shows what it is told to."""

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, observation_space: spaces.Space, observation: Any) -> None:
        self.observation_space = observation_space
        self.observation = observation

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        return self.observation, {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        return self.observation, 0.1, False, False, {}


def constant_env() -> ConstantReward:
    return ConstantReward(spaces.Box(-1.0, 1.0, (2,), np.float64), np.array([0.25, -0.5]))


def test_observation_has_the_three_entries_with_their_types():
    env = ReturnToGoWrapper(gym.make("HalfCheetah-v5"), 12_000)
    observation, _ = env.reset(seed=0)
    assert {key: (value.shape, value.dtype) for key, value in observation.items()} == {
        "observation": ((17,), np.float32),
        "return_to_go": ((1,), np.float32),
        "timestep": ((1,), np.int64),
    }
    assert env.observation_space.contains(observation)
    assert env.observation_space.contains(env.observation_space.sample())


def test_return_to_go_falls_by_each_reward_in_float64():
    env = ReturnToGoWrapper(constant_env(), 1.0)
    observation, _ = env.reset()
    expected = 1.0
    for timestep in range(1000):
        assert observation["return_to_go"][0] == np.float32(expected)
        assert observation["timestep"][0] == timestep
        observation, reward, *_ = env.step(np.zeros(1))
        expected -= reward
    observation, _ = env.reset()
    assert (observation["return_to_go"][0], observation["timestep"][0]) == (1.0, 0)


@pytest.mark.parametrize(("target", "shown"), [(1.0, [1.0, 0.9, 0.8, 0.7]), (-2.0, [-2.0, -1.5, -1.0, -0.5])])
def test_the_return_to_go_of_an_episode_ahead_of_its_target_is_bounded(target: float, shown: list[float]):
    """Each step's reward is 0.1, of 4 steps: behind a target of 1, and ahead of one of -2."""
    for bound_return_to_go, expected in ((True, shown), (False, [target - 0.1 * t for t in range(4)])):
        gym.register("Constant-v0", constant_env, max_episode_steps=4)
        env = ReturnToGoWrapper(
            gym.make("Constant-v0", disable_env_checker=True), target, bound_return_to_go=bound_return_to_go
        )
        observations = [env.reset(seed=0)[0], *(env.step(np.zeros(1, np.float32))[0] for _ in range(3))]
        assert [each["return_to_go"].item() for each in observations] == pytest.approx(expected)
        gym.registry.pop("Constant-v0")


def test_a_new_target_takes_effect_at_the_next_reset():
    env = ReturnToGoWrapper(constant_env(), 1.0)
    env.reset()
    env.set_target_return(5.0)
    assert env.step(np.zeros(1))[0]["return_to_go"][0] == np.float32(0.9)
    assert env.reset()[0]["return_to_go"][0] == 5.0


def monitored_env() -> gym.Env:
    return Monitor(ReturnToGoWrapper(gym.make("Pendulum-v1"), 1.0))


@pytest.mark.parametrize("vec_env_class", VEC_ENVS)
def test_the_target_is_settable_through_a_vec_env(vec_env_class: type):
    vec_env = vec_env_class([monitored_env, monitored_env])
    vec_env.reset()
    vec_env.env_method("set_target_return", 7.5, indices=[1])
    assert vec_env.reset()["return_to_go"].tolist() == [[1.0], [7.5]]
    vec_env.close()


@pytest.mark.parametrize("target_return", [np.nan, np.inf, "100", True, [1.0, 2.0], -1e300, 10**400])
def test_a_target_that_is_no_finite_number_is_refused(target_return: Any):
    with pytest.raises(ValueError, match="target_return must be a finite number"):
        ReturnToGoWrapper(constant_env(), target_return)
    env = ReturnToGoWrapper(constant_env(), np.float32(2.0))
    with pytest.raises(ValueError, match="target_return must be a finite number"):
        env.set_target_return(target_return)
    assert env.reset()[0]["return_to_go"][0] == 2.0


def test_the_checkers_of_gymnasium_and_sb3_pass_without_warnings():
    # Bounds on observations that HalfCheetah itself does not have, and wrapping as such, are what gymnasium remarks on.
    accepted = ("infinity", "is different from the unwrapped version")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sb3_check_env(ReturnToGoWrapper(gym.make("HalfCheetah-v5"), 12_000))
        gymnasium_check_env(ReturnToGoWrapper(gym.make("HalfCheetah-v5"), 12_000), skip_render_check=True)
    messages = [str(warning.message) for warning in caught]
    assert [message for message in messages if not any(part in message for part in accepted)] == []


def test_a_wrapped_environment_is_made_again_from_its_spec():
    env = gym.make(ReturnToGoWrapper(gym.make("Pendulum-v1"), -150.0).spec)
    assert isinstance(env, ReturnToGoWrapper)
    assert env.reset()[0]["return_to_go"][0] == -150.0


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "FetchReach-v4", "Pendulum-v1"])
def test_a_dataset_and_its_environment_have_the_same_space(env_id: str):
    env = gym.make(env_id)
    from_dataset = return_to_go_space(flatten_observation_space(env.observation_space))
    assert from_dataset == ReturnToGoWrapper(env, 0.0).observation_space


def test_the_bounds_of_the_environment_are_kept():
    space = flatten_observation_space(gym.make("Pendulum-v1").observation_space)
    np.testing.assert_array_equal(space.high, [1.0, 1.0, 8.0])


def test_goal_dict_is_flattened_as_gymnasium_does():
    env = gym.make("FetchReach-v4")
    expected, _ = gym.wrappers.FlattenObservation(gym.make("FetchReach-v4")).reset(seed=3)
    observation, _ = ReturnToGoWrapper(env, 0.0).reset(seed=3)
    np.testing.assert_array_equal(observation["observation"], expected.astype(np.float32))


def test_dict_entries_come_in_sorted_order_however_the_space_was_built():
    one, two = spaces.Box(-1.0, 1.0, (1,)), spaces.Box(-2.0, 2.0, (2,))
    space = spaces.Dict(zebra=one, ant=spaces.Dict(y=two, x=spaces.Discrete(3)))
    observation = {"zebra": np.ones(1, np.float32), "ant": {"y": np.array([2.0, -2.0], np.float32), "x": np.int64(1)}}
    env = ReturnToGoWrapper(ConstantReward(space, observation), 0.0)
    assert env.reset()[0]["observation"].tolist() == [0.0, 1.0, 0.0, 2.0, -2.0, 1.0]
    assert env.observation_space["observation"].high.tolist() == [1.0, 1.0, 1.0, 2.0, 2.0, 1.0]


def test_a_matrix_is_flattened():
    matrix = np.arange(6, dtype=np.float64).reshape(2, 3)
    env = ReturnToGoWrapper(ConstantReward(spaces.Box(0.0, 9.0, (2, 3), np.float64), matrix), 0.0)
    assert env.reset()[0]["observation"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize(
    "space", [spaces.Box(0.0, 1.0, (2, 3, 5, 6)), spaces.Box(0.0, 1.0, (2, 5, 7)), spaces.MultiBinary((20, 30, 3))]
)
def test_numbers_with_several_axes_are_flattened_alike_in_environments_and_data(space, recwarn):
    space.seed(0)
    observation = space.sample()
    env = ReturnToGoWrapper(ConstantReward(space, observation), 0.0)
    seen = env.reset()[0]["observation"]
    np.testing.assert_array_equal(seen, observation.ravel())
    episode = {"observations": np.stack([observation] * 2), "actions": np.zeros((2, 1)), "rewards": [0.0, 1.0]}
    buffer = load_dataset([episode], observation_space=space)
    np.testing.assert_array_equal(buffer.observations[0].numpy(), seen)
    assert not [each for each in recwarn if "becomes a vector" in str(each.message)]


def test_a_matrix_as_large_as_a_picture_is_told_of(recwarn):
    ReturnToGoWrapper(ConstantReward(spaces.Box(0.0, 1.0, (15, 84)), None), 0.0)
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"shape \(84, 84\) and becomes a vector of 7056 numbers. If it is an image, give"):
        ReturnToGoWrapper(ConstantReward(spaces.Dict(seen=spaces.Box(0.0, 1.0, (84, 84))), None), 0.0)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Dict(camera=spaces.Box(0, 255, (64, 64), np.uint8)), "is no image that can be used: height, width and"),
        (spaces.Dict(arm=spaces.Dict(camera=spaces.Box(0, 255, (64, 64, 3), np.uint8))), "an entry of the Dict that the"),
        (spaces.Dict(observation=spaces.Box(0, 255, (64, 64, 3), np.uint8)), "An image is called observation"),
        (spaces.Box(0, 1, (64, 64, 3)), "looks like an image of float32; images are uint8, 0 to 255"),
        (spaces.Box(0, 1, (1, 1, 7)), "looks like an image of float32; images are uint8, 0 to 255"),
        (spaces.Box(0, 1, (4, 64, 64, 3)), "looks like an image of float32; images are uint8, 0 to 255"),
        (spaces.Dict(rewards=spaces.Box(0, 255, (64, 64, 3), np.uint8)), "An image is called rewards; other names than act"),
        (spaces.Box(0, 255, (64, 48, 2), np.uint8), r"'image' has shape \(64, 48, 2\), expected 1, 3 or 4 channels, either"),
        (spaces.Box(0, 255, (3, 48, 3), np.uint8), r"'image' has shape \(3, 48, 3\), expected 1, 3 or 4 channels, either"),
        (spaces.Box(0, 9, (48, 48, 3), np.uint8), r"'image' is Box\(0, 9, .*; bounds of 0 and 255 are expected"),
        (spaces.Text(5), "cannot be flattened"),
        (spaces.Sequence(spaces.Discrete(3)), "cannot be flattened"),
        (spaces.Dict(), "cannot be flattened"),
    ],
)
def test_spaces_that_are_no_vector_are_refused(space: spaces.Space, message: str):
    with pytest.raises(ValueError, match=message):
        ReturnToGoWrapper(ConstantReward(space, None), 0.0)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Hopper-v5"])
def test_replaying_a_recording_shows_exactly_the_return_to_go_of_the_buffer(
    env_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    PPO("MlpPolicy", env_id, n_steps=8, batch_size=8, n_epochs=1, device="cpu").learn(8).save(tmp_path / "agent.zip")
    dataset = record_agent(
        "ppo",
        tmp_path / "agent.zip",
        env_id,
        4,
        "test/replay-v0",
        deterministic=False,
        n_envs=3,
        progress=False,
        env_kwargs={"max_episode_steps": 150},
    )
    buffer = load_minari(dataset)
    episodes = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    env = ReturnToGoWrapper(gym.make(dataset.env_spec), 0.0, bound_return_to_go=False)
    row = 0
    for index, length in enumerate(buffer.episode_lengths):
        env.set_target_return(buffer.episode_returns[index])
        observation, _ = env.reset(seed=episodes[index]["seed"])
        for timestep in range(length):
            assert observation["return_to_go"][0] == buffer.returns_to_go[row].item()
            assert observation["timestep"][0] == buffer.timesteps[row].item() == timestep
            np.testing.assert_array_equal(observation["observation"], buffer.observations[row].numpy())
            observation, reward, terminated, truncated, _ = env.step(buffer.actions[row].numpy())
            assert np.float32(reward) == buffer.rewards[row].item()
            row += 1
        assert (terminated, truncated) == (buffer.terminated[index], buffer.truncated[index])


class TellsOfSuccess(gym.Wrapper):
    def __init__(self, env: gym.Env, info: dict[str, Any]) -> None:
        super().__init__(env)
        self.info = info

    def step(self, action: Any) -> tuple:
        return *self.env.step(action)[:4], self.info


@pytest.mark.parametrize(
    ("told", "shown"),
    [
        ({"success": np.True_}, {"success": True, "is_success": True}),
        ({"success": 1.0, "is_success": False}, {"success": 1.0, "is_success": False}),
        ({"other": 1}, {"other": 1}),
    ],
)
def test_success_has_the_name_that_sb3_counts_by(told, shown):
    env = ReturnToGoWrapper(TellsOfSuccess(ConstantReward(spaces.Box(-1, 1, (2,)), np.zeros(2)), told), 1.0)
    env.reset()
    *_, info = env.step(np.zeros(1))
    assert info == shown
    assert "is_success" not in told or told["is_success"] is False, "the environment's own is left alone"


@pytest.mark.parametrize("vec_env_class", VEC_ENVS)
def test_the_task_is_known_where_its_whole_spec_cannot_leave_a_process(vec_env_class):
    def make():
        env = gym.make("Pendulum-v1", max_episode_steps=70)
        return ReturnToGoWrapper(gym.wrappers.TransformReward(env, lambda reward: reward), target_return=0.0)

    venv, env_space = vec_env_class([make]), gym.make("Pendulum-v1").observation_space
    try:
        assert known_task(venv) == ("Pendulum-v1", 70)
        told = reader_options(venv)
        assert (told.pop("action_space"), told.pop("observation_space")) == (venv.action_space, env_space)
        assert told == {"env_args": None, "max_episode_steps": 70}
    finally:
        venv.close()
    bare = gym.make("Pendulum-v1").unwrapped
    bare.spec = None
    venv = DummyVecEnv([lambda: ReturnToGoWrapper(bare, target_return=0.0)])
    assert known_task(venv) is None
    assert "max_episode_steps" not in reader_options(venv), "no limit is known, which is not to say that there is none"


def bare_env() -> gym.Env:
    return ConstantReward(spaces.Box(-1.0, 1.0, (2,)), np.zeros(2, np.float32))


class OwnTimeLimit(TimeLimit):
    """As RL-Zoo has one."""


class Horizon(TimeLimit):
    """Another name, by which it is not known in a process of its own."""


@pytest.mark.parametrize("vec_env_class", VEC_ENVS)
def test_an_evaluation_ends_where_a_time_limit_stands_outside_the_monitor(vec_env_class):
    def make() -> gym.Env:
        return ReturnToGoWrapper(TimeLimit(Monitor(bare_env()), 7), 1.0)

    env = vec_env_class([make])
    check_vec_env(env)
    evaluation = EvalCallback(vec_env_class([make]), n_eval_episodes=2, eval_freq=8, verbose=0)
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, device="cpu").learn(8, evaluation)
    assert evaluation.last_mean_reward == pytest.approx(0.7)
    evaluation.eval_env.close()
    returns, lengths = evaluate_policy(model, env, 2, return_episode_rewards=True)
    env.close()
    assert returns == pytest.approx([0.7, 0.7])
    assert lengths == [7, 7]


class EndAfterThree(gym.Wrapper):
    """Ends episodes as a success does."""

    def reset(self, **kwargs):
        self.n_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        self.n_steps += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or self.n_steps == 3, truncated, info


def test_an_end_outside_the_monitor_is_told_whichever_it_is():
    env = DummyVecEnv([lambda: ReturnToGoWrapper(EndAfterThree(Monitor(bare_env())), 1.0)])
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, device="cpu")
    assert evaluate_policy(model, env, 2, return_episode_rewards=True)[1] == [3, 3]


class Lives(gym.Wrapper):
    """Terminates at each third step, and resets the game after the ninth alone, as SB3's EpisodicLifeEnv does."""

    def reset(self, **kwargs):
        if getattr(self, "n_steps", 9) == 9:
            self.n_steps = 0
            return self.env.reset(**kwargs)
        self.n_steps += 1
        return self.env.step(np.zeros(2))[0], {}

    def step(self, action):
        self.n_steps += 1
        observation, reward, _, _, info = self.env.step(action)
        return observation, reward, self.n_steps % 3 == 0, False, info


def test_a_lost_life_is_no_end_of_the_game():
    game = TimeLimit(bare_env(), 9)
    env = DummyVecEnv([lambda: ReturnToGoWrapper(Lives(Monitor(game)), 1.0)])
    env.reset()
    told = [info["episode"]["l"] for _ in range(14) for info in env.step(np.zeros((1, 2)))[3] if "episode" in info]
    assert told == [9, 9]


def test_ends_that_no_monitor_sees_are_warned_of():
    for wrapped, n_warnings in [
        (EndAfterThree(ReturnToGoWrapper(Monitor(bare_env()), 1.0)), 1),
        (ReturnToGoWrapper(EndAfterThree(Monitor(bare_env())), 1.0), 0),
        (Monitor(EndAfterThree(ReturnToGoWrapper(bare_env(), 1.0))), 0),
    ]:
        env = DummyVecEnv([lambda wrapped=wrapped: wrapped])
        env.reset()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(400):
                env.step(np.zeros((1, 2)))
        told = [str(each.message) for each in caught if "ReturnToGoWrapper(ItsWrapper(env))" in str(each.message)]
        assert len(told) == n_warnings


@pytest.mark.parametrize("vec_env_class", VEC_ENVS)
def test_a_time_limit_outside_of_everything_is_refused(vec_env_class):
    def check(*makers) -> None:
        env = vec_env_class(list(makers))
        try:
            check_vec_env(env)
        finally:
            env.close()

    good = [
        lambda: Monitor(TimeLimit(ReturnToGoWrapper(bare_env(), 1.0), 7)),
        lambda: TimeLimit(ReturnToGoWrapper(bare_env(), 1.0), 7),
        lambda: ReturnToGoWrapper(TimeLimit(Monitor(bare_env()), 7), 1.0),
    ]
    check(*good)
    limits = [TimeLimit, OwnTimeLimit, *([Horizon] if vec_env_class is DummyVecEnv else [])]
    for limit in limits:
        with pytest.raises(ValueError, match=r"write ReturnToGoWrapper\(TimeLimit\(env, max_episode_steps=N\)\)"):
            check(good[0], lambda limit=limit: limit(ReturnToGoWrapper(Monitor(bare_env()), 1.0), 7))
