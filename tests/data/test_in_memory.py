"""Data in memory: lists of episodes and SB3's replay buffers."""

import itertools
import warnings
from collections import namedtuple
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, Trajectory, in_memory, load_dataset
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.envs.observation_spaces import sort_observation_space

LENGTHS, N_ACTIONS = (3, 5), 2


@dataclass(frozen=True)
class Obtained:
    """The fields of a trajectory of the package imitation, whose releases ask for another Gymnasium."""

    obs: np.ndarray
    acts: np.ndarray
    infos: np.ndarray | None
    terminal: bool


@dataclass(frozen=True)
class Rewarded(Obtained):
    rews: np.ndarray


def episodes():
    rng = np.random.default_rng(0)
    return [(rng.normal(size=(n + 1, 3)), rng.uniform(-1, 1, (n, N_ACTIONS)), rng.normal(size=n), n == 5) for n in LENGTHS]


def steps(obs, acts, rews, late, extra=()):
    ends = np.arange(1, len(acts) + 1) == len(acts)
    return [(obs[t], acts[t], rews[t], bool(ends[t] and not late), bool(ends[t] and late), *extra) for t in range(len(acts))]


def dictionary(obs, acts, rews, late):
    return {"observations": obs[:-1], "actions": acts, "rewards": rews, "terminated": not late, "truncated": late}


def lists(obs, acts, rews, late):
    """As JSON would hold it, with the last observation and flags of every step."""
    nothing = [[False]] * (len(acts) - 1)
    ends = {"terminals": [*nothing, [not late]], "timeouts": [*nothing, [late]]}
    return {"obs": obs.tolist(), "action": acts.tolist(), "reward": rews[:, None].tolist(), **ends}


def obtained(obs, acts, rews, late):
    return Rewarded(obs, acts, np.array([{}] * (len(acts) - 1) + [{"TimeLimit.truncated": late}]), True, rews)


KINDS = {
    "dictionaries": dictionary,
    "lists": lists,
    "imitation": obtained,
    "steps": steps,
    "steps with info": lambda *episode: steps(*episode, extra=({"of": "the environment"},)),
    "trajectories": lambda obs, acts, rews, late: Trajectory(obs[:-1], acts, rews, not late, late),
}


@pytest.mark.parametrize("kind", KINDS)
def test_episodes_of_every_kind_are_read_alike(kind):
    given = episodes()
    buffer = load_dataset([KINDS[kind](*episode) for episode in given])
    np.testing.assert_array_equal(buffer.observations, np.concatenate([o[:-1] for o, *_ in given]).astype(np.float32))
    np.testing.assert_array_equal(buffer.actions, np.concatenate([a for _, a, *_ in given]).astype(np.float32))
    np.testing.assert_allclose(buffer.episode_returns, [r.sum() for _, _, r, _ in given])
    assert buffer.episode_lengths.tolist() == list(LENGTHS)
    assert (buffer.terminated.tolist(), buffer.truncated.tolist()) == ([True, False], [False, True])


def test_dictionary_observations_and_no_rewards():
    o, a, *_ = episodes()[0]
    buffer = load_dataset(
        [[({"b": o[t, :1], "a": o[t, 1:]}, 3 * a[t], 0.0, False, False) for t in range(3)]], action_bounds=(-3, 3)
    )
    np.testing.assert_array_equal(buffer.observations, np.roll(o[:3], -1, axis=1).astype(np.float32))
    assert not buffer.terminated.any()
    buffer = load_dataset([Obtained(o, a, None, True), {"obs": o, "acts": a}])
    assert buffer.rewards.tolist() == [0, 0, 1] * 2
    assert buffer.terminated.all()


OBS, ACTS, REWS, _ = episodes()[0]
UNFIT = {
    "nothing": ([], "the list is empty"),
    "numbers": ([1, 2], "episode 0 is a int; accepted are a dictionary of arrays, a Trajectory"),
    "short steps": (
        [[(OBS[0], ACTS[0], 0.0)]],
        "episode 0 is a list; accepted are .*observation, action, reward, terminated",
    ),
    "no actions": ([{"obs": OBS}], "episode 0: has no array called one of actions, action, acts, only obs"),
    "other actions": (
        [{"obs": OBS, "acts": ACTS}, {"obs": OBS, "acts": ACTS[:, :1]}],
        r"episode 1: actions have shape \(3, 1\)",
    ),
    "a flat action": ([{"obs": OBS, "acts": ACTS[:, 0]}], r"episode 0: actions have shape \(3,\); \(N, A\) is expected"),
    "too few observations": (
        [{"obs": OBS[:2], "acts": ACTS}],
        r"episode 0: observations have shape \(2, 3\), expected \(3, 3\)",
    ),
    "rewards of another length": (
        [{"obs": OBS, "acts": ACTS, "rews": REWS[:2]}],
        r"rewards have shape \(2,\), expected \(3,\)",
    ),
    "several episodes": (
        [{"obs": OBS, "acts": ACTS, "terminals": [False, True, False]}],
        "episode 0: ends at step 1 of 3; arrays of several episodes need no list",
    ),
    "ragged": (
        [{"obs": [[1.0], [1.0, 2.0]], "acts": ACTS}],
        "episode 0: cannot be read .*inhomogeneous.*; arrays of numbers are expected",
    ),
    "NaN": ([{"obs": OBS, "acts": ACTS, "rews": REWS * np.nan}], "episode 0, step 0: rewards hold nan"),
    "outside": (
        [{"obs": OBS, "acts": 3 * ACTS}],
        r"episode 0, step 0: action .* lies outside of the action space \[-1, 1\]",
    ),
}


@pytest.mark.parametrize(("given", "message"), UNFIT.values(), ids=UNFIT)
def test_what_is_no_episode_is_refused_by_its_number(given, message):
    with pytest.raises(DatasetError, match=f"episodes.*{message}"):
        load_dataset(given)


def test_an_unfit_episode_can_be_dropped_and_actions_clipped():
    good, bad = {"obs": OBS, "acts": ACTS}, {"obs": OBS * np.inf, "acts": ACTS}
    with pytest.warns(UserWarning, match="1 of 2 episodes have been dropped"):
        assert load_dataset([good, bad], on_invalid="drop").n_episodes == 1
    with pytest.warns(UserWarning, match="2 of 3 episodes have been dropped"):
        assert load_dataset([{"obs": OBS}, {"obs": OBS, "acts": ACTS[:, 0]}, good], on_invalid="drop").n_episodes == 1
    with pytest.raises(DatasetError, match="episode 1: has no array called one of actions"):
        load_dataset([{"obs": OBS}] * 2, on_invalid="drop")
    replay_buffer = ReplayBuffer(5, spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (2,)), device="cpu")
    for step in range(3):
        replay_buffer.add(*np.zeros((2, 1, 2), np.float32), np.full((1, 2), 9.0), np.ones(1), np.array([step == 2]), [{}])
    steps = [(np.zeros(2), np.full(2, 9.0), 1.0, t == 2) for t in range(3)]
    for given in ([{"obs": OBS, "acts": 9 * ACTS}], steps, replay_buffer):
        assert load_dataset(given, clip_actions=True).actions.abs().max() == 1.0


def test_made_up_rewards_are_told_of_whatever_lacks_them():
    """Steps one by one, too, and an episode behind others that have rewards."""
    step = {"observation": np.zeros(2), "action": np.zeros(1), "terminated": False}
    steps = [step, {**step, "terminated": True}]
    rewarded = [{**each, "reward": 1.0} for each in steps]
    for episodes, where in (
        ([steps, steps], "^episodes: there is none"),
        ([rewarded, steps, rewarded, steps], "^episodes, episode 1 and 1 more: there is none"),
    ):
        with pytest.warns(UserWarning, match=where):
            load_dataset(episodes)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_dataset([rewarded, rewarded])


def test_rewards_that_are_made_up_although_something_was_there_are_told_of():
    episode = {"obs": np.zeros((3, 2)), "acts": ACTS, "rew": np.zeros(3), "done": np.zeros(3)}
    for given in ([episode], {**episode, "episode_lengths": [3]}):
        with pytest.warns(UserWarning, match=r"none of rewards, reward, rews, nor any success, so .* Not read: rew\."):
            assert load_dataset(given).episode_returns.tolist() == [1.0]


def done_steps(lengths=(4, 5, 2)):
    """Steps of several episodes, the last of which has not ended."""
    rng = np.random.default_rng(0)
    ends = np.cumsum(lengths[:-1]) - 1
    return [
        {"obs": rng.normal(size=3), "action": rng.uniform(-1, 1, 2), "reward": float(t), "done": t in ends}
        for t in range(sum(lengths))
    ]


Transition = namedtuple("Transition", ["state", "action", "next_state", "done", "reward"])
STEPS = {
    "dictionaries": lambda step: step,
    "Gymnasium": lambda step: (step["obs"], step["action"], step["reward"], step["done"], False),
    "Gymnasium with info": lambda step: (
        step["obs"],
        step["action"],
        step["reward"],
        step["done"],
        False,
        {"is_success": 1},
    ),
    "with done": lambda step: (step["obs"], step["action"], step["reward"], step["done"]),
    "with done and info": lambda step: (step["obs"], step["action"], step["reward"], step["done"], {}),
    "SB3": lambda step: (step["obs"], step["action"], step["obs"], step["reward"], step["done"]),
    "textbook": lambda step: (step["obs"], step["action"], step["reward"], step["obs"] + 1, step["done"]),
    "named tuples": lambda step: Transition(step["obs"], step["action"], step["obs"] + 1, step["done"], step["reward"]),
    "SB3 with arrays of one": lambda step: (
        *(step["obs"], step["action"], step["obs"]),
        *(np.array([step["reward"]]), np.array([step["done"]]), [{}]),
    ),
}


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("kind", STEPS)
def test_steps_of_every_kind_are_read_alike(kind, nested):
    """All of them in one list, or an episode a list; four or five steps of one are not four or five parts of a step."""
    given, lengths = done_steps(), [4, 5, 2]
    steps = [STEPS[kind](step) for step in given]
    stops = np.cumsum(lengths)
    dataset = [steps[stop - n : stop] for stop, n in zip(stops, lengths, strict=True)] if nested else steps
    buffer = load_dataset(dataset)
    assert buffer.episode_lengths.tolist() == lengths
    np.testing.assert_array_equal(buffer.observations, np.float32([step["obs"] for step in given]))
    np.testing.assert_array_equal(buffer.actions, np.float32([step["action"] for step in given]))
    assert buffer.rewards.tolist() == [step["reward"] for step in given]
    assert buffer.terminated.tolist() == [True, True, False]
    assert np.isnan(buffer.successes).all() == (kind != "Gymnasium with info")


@pytest.mark.parametrize("camera", [False, True])
def test_demonstrated_steps_of_dictionary_observations_need_no_reward(camera):
    """Neither episodes nor rewards tell that these are steps."""
    frames = {"frame": np.zeros((8, 8, 3), np.uint8)} if camera else {"width": 0.5}
    steps = [
        {"observation": {"joints": np.float32([k, -k]), **frames}, "action": np.float32([0.1, 0.2]), "done": k in (3, 9)}
        for k in range(10)
    ]
    with pytest.warns(UserWarning, match="every episode counts as a success"):
        buffer = load_dataset(steps)
    assert buffer.episode_lengths.tolist() == [4, 6]
    assert buffer.observations[:, 0].tolist() == list(range(10))
    assert list(buffer.image_spaces) == (["frame"] if camera else [])


def test_chosen_entries_have_the_order_of_the_environments():
    """A Dict environment shows its entries sorted by name, whatever observation_keys says."""
    space = spaces.Dict(arm=spaces.Box(-9, 9, (2,)), gripper=spaces.Box(-9, 9, (2,)))
    arrays = {
        **{name: np.full((8, 2), float(i)) for i, name in enumerate(("arm", "gripper", "claw"))},
        **dict(actions=np.zeros((8, 1)), rewards=np.ones(8), episode_ends=[4, 8]),
    }
    right = load_dataset(arrays, observation_space=space, observation_keys=["arm", "gripper"])
    assert right.observations[0].tolist() == [0, 0, 1, 1]
    cure = r"has gripper, arm in this order, .* sorted by name: write observation_keys=\['arm', 'gripper'\]"
    with pytest.raises(DatasetError, match=cure):
        load_dataset(arrays, observation_space=space, observation_keys=["gripper", "arm"])
    named_otherwise = load_dataset(arrays, observation_space=space, observation_keys=["arm", "claw"])
    assert named_otherwise.observations[0].tolist() == [0, 0, 2, 2]


def test_truncations_of_steps_with_a_next_observation_are_kept():
    states = np.arange(18.0).reshape(9, 2)
    for end, next_first in itertools.product([3, 7], [False, True]):
        steps = []
        for t in range(8):
            middle = (states[t + 1], 0.5) if next_first else (0.5, states[t + 1])
            steps.append((states[t], np.array([0.1]), *middle, t == end, t in (3, 7) and t != end))
        buffer = load_dataset(steps)
        assert buffer.episode_lengths.tolist() == [4, 4]
        assert buffer.rewards.tolist() == [0.5] * 8
        assert buffer.terminated.tolist() == [end == 3, end == 7]
        assert buffer.truncated.tolist() == [end == 7, end == 3]


def test_named_tuples_of_other_names_go_by_their_places():
    step = namedtuple("Step", ["state", "action", "reward", "done_trunc"])
    episode = [step(np.ones(2), np.array([0.5]), 1.0, t == 2) for t in range(3)]
    assert load_dataset([episode, episode]).terminated.all()
    other = namedtuple("Other", ["obs", "action", "r", "done"])
    assert load_dataset([other(*each) for each in episode]).rewards.tolist() == [1.0] * 3


def test_an_episode_of_single_numbers_is_no_step():
    episode = {"obs": {"a": np.zeros(5), "b": np.ones(5)}, "actions": np.array([0, 1, 1, 0, 1]), "terminated": True}
    ended = {"obs": np.zeros((5, 3)), "actions": episode["actions"], "done": True}
    for given in (episode, ended, {**ended, "obs": {"a": np.zeros((5, 3)), "b": np.ones(5)}}):
        with pytest.warns(UserWarning, match="every episode counts as a success"):
            buffer = load_dataset([given] * 3, action_space=spaces.Discrete(2))
        assert buffer.episode_lengths.tolist() == [5, 5, 5]


def test_steps_without_an_array_or_an_end_are_named():
    steps = done_steps()
    del steps[4]["reward"]
    with pytest.raises(DatasetError, match="steps: step 4 has no 'reward', which step 0 has"):
        load_dataset(steps)
    endless = [{name: part for name, part in step.items() if name != "done"} for step in done_steps()]
    with pytest.raises(DatasetError, match=r"does not say where episodes end; one of .*dones"):
        load_dataset(endless)
    numbered = [{**step, "episode_id": number // 4} for number, step in enumerate(endless)]
    assert load_dataset(numbered).episode_lengths.tolist() == [4, 4, 3]


NUMBERS = {
    "SB3": [(t, 1, t + 1, float(t), t == 3) for t in range(4)],
    "SB3, whole rewards": [(t, 1, t + 1, t, t == 3) for t in range(4)],
    "Gymnasium": [(t, 1, float(t), t == 3, False) for t in range(4)],
    "Gymnasium, whole flags": [(t, 1, float(t), int(t == 3), 0) for t in range(4)],
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_a_next_observation_that_is_a_number_is_no_reward(kind):
    buffer = load_dataset(NUMBERS[kind], action_space=spaces.Discrete(2))
    assert (buffer.rewards.tolist(), buffer.terminated.tolist()) == ([0, 1, 2, 3], [True])


def test_infos_tell_of_the_time_limit():
    late = {"TimeLimit.truncated": True}
    steps = [(OBS[0], ACTS[0], 1.0, t % 2 == 1, late if t == 3 else {}) for t in range(6)]
    buffer = load_dataset(steps)
    assert (buffer.terminated.tolist(), buffer.truncated.tolist()) == ([True, False, True], [False, True, False])


CHOICES = spaces.Dict({"where": spaces.Discrete(3, start=1), "arm": spaces.Box(-9, 9, (2,))})


def test_choices_in_observations_are_those_of_the_environment():
    observations = {"where": np.array([1, 3, 2, 1]), "arm": np.arange(8.0).reshape(4, 2)}
    arrays = {"actions": np.zeros((4, 2)), "rewards": np.zeros(4), "dones": [0, 1, 0, 1]}
    halves = [
        {"obs": {name: part[half] for name, part in observations.items()}, "acts": np.zeros((2, 2)), "rews": np.zeros(2)}
        for half in (slice(2), slice(2, 4))
    ]
    steps = [({name: part[t] for name, part in observations.items()}, np.zeros(2), 0.0, t % 2 == 1, False) for t in range(4)]
    expected = np.hstack([observations["arm"], np.eye(3)[observations["where"] - 1]])
    for given in ({**arrays, "observations": observations}, halves, steps, [steps[:2], steps[2:]]):
        np.testing.assert_array_equal(load_dataset(given, observation_space=CHOICES).observations, expected)
        chosen = load_dataset(given, observation_space=CHOICES, observation_keys=["where"])
        np.testing.assert_array_equal(chosen.observations, expected[:, 2:])
        assert load_dataset(given).observation_space.shape == (3,)
        with pytest.raises(DatasetError, match=r"no 'leg', only (where, arm|arm, where)"):
            load_dataset(given, observation_keys=["leg"])
    for given in ([(4, 1, 0.0, True)], [(0, 1, 0.0, True)]):
        with pytest.raises(DatasetError, match=r"hold . *, which is not in Discrete\(3, start=1\)"):
            load_dataset(given, observation_space=CHOICES["where"], action_space=spaces.Discrete(2))
    with pytest.raises(DatasetError, match="has no where, which the environment observes, only arm"):
        load_dataset({**arrays, "observations": {"arm": observations["arm"]}}, observation_space=CHOICES)


def test_a_model_tells_its_data_of_the_environments_choices():
    course = Course(goal=True)
    steps = [({"b": np.arange(3.0), "a": t % 2}, np.array([0.5, 1.0]), 1.0, t % 4 == 3, False) for t in range(8)]
    model = DT("MultiInputPolicy", ReturnToGoWrapper(course), dataset=steps, device="cpu")
    assert model.buffer.observations[:2].tolist() == [[1, 0, 0, 1, 2], [0, 1, 0, 1, 2]]


class Course(gym.Env):
    """Shows what was done: step and episode are observed, actions rewarded; every other episode ends itself."""

    action_space = spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 10.0]), dtype=np.float64)

    def __init__(self, goal: bool = False) -> None:
        shape = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.observation_space = spaces.Dict({"b": shape, "a": spaces.Discrete(2)}) if goal else shape
        self.done, self.episode, self.goal = [], -1, goal

    def see(self):
        vector = np.array([self.t, self.episode, 0.5])
        return {"b": vector, "a": self.episode % 2} if self.goal else vector

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.episode = 0, self.episode + 1
        return self.see(), {}

    def step(self, action):
        self.t += 1
        self.done.append(np.array(action))
        return self.see(), float(action.sum()), self.episode % 2 == 0 and self.t == 4, False, {}


@pytest.mark.parametrize("goal", [False, True])
@pytest.mark.parametrize("buffer_size", [1000, 40])
def test_the_replay_buffer_of_an_sb3_model(goal, buffer_size):
    """Actions that the environment was given, time-outs, several environments, normalisation, a buffer that is full."""
    env = make_vec_env(lambda: TimeLimit(Course(goal), 7), n_envs=2)
    courses = [each.unwrapped for each in env.envs]
    keys = {"norm_obs_keys": ["b"]} if goal else {}
    model = DDPG(
        "MultiInputPolicy" if goal else "MlpPolicy", VecNormalize(env, **keys), seed=0, buffer_size=buffer_size,
        learning_starts=100, train_freq=(20, "step"), batch_size=8, policy_kwargs={"net_arch": [4]}, device="cpu",
    ).learn(60)  # fmt: skip
    with pytest.warns(UserWarning, match=r"replay buffer: \d unfinished episodes with \d+ steps are left out"):
        buffer = load_dataset(model.replay_buffer)
    first = 1 if buffer_size == 40 else 0
    assert buffer.observation_space.shape == (5 if goal else 3,)
    n_steps, kept = len(courses[0].done), min(len(courses[0].done), buffer_size // 2)
    expected = []
    for course in courses:
        ends, t = [], 0
        while t < n_steps:
            t += 4 if len(ends) % 2 == 0 else 7
            ends.append(t)
        starts = [0, *ends[:-1]]
        whole = [(n, s, e) for n, (s, e) in enumerate(zip(starts, ends, strict=True)) if n_steps - kept < e]
        expected += [(course, *piece) for piece in whole[first:] if piece[2] <= n_steps]
    assert buffer.episode_lengths.tolist() == [e - s for _, _, s, e in expected]
    assert buffer.terminated.tolist() == [n % 2 == 0 for _, n, _, _ in expected]
    assert buffer.truncated.tolist() == [n % 2 == 1 for _, n, _, _ in expected]
    actions = np.concatenate([course.done[s:e] for course, _, s, e in expected])
    np.testing.assert_allclose(buffer.actions, actions, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(buffer.rewards, actions.sum(axis=1), rtol=1e-5)
    seen = [[t, n, 0.5] for _, n, s, e in expected for t in range(e - s)]
    np.testing.assert_array_equal(buffer.observations[:, -3:], np.array(seen, np.float32))
    if goal:
        np.testing.assert_array_equal(
            buffer.observations[:, :2], np.eye(2, dtype=np.float32)[[int(n % 2) for _, n, _ in seen]]
        )
    assert np.ptp(actions, axis=0).min() > 1.0  # of ranges 4 and 10: scaled ones would not have been


@pytest.mark.parametrize("block", [1000, 4])
@pytest.mark.parametrize("goal", [False, True])
def test_a_second_learn_begins_another_episode(goal, block, monkeypatch):
    """It resets the environment without a word to the buffer: the episode of that time is unfinished, and left out."""
    monkeypatch.setattr(in_memory, "BLOCK", block)
    small = dict(learning_starts=100, buffer_size=50, policy_kwargs={"net_arch": [4]}, device="cpu", seed=0)
    env = make_vec_env(lambda: TimeLimit(Course(goal), 7))
    model = DDPG("MultiInputPolicy" if goal else "MlpPolicy", env, train_freq=(1, "step"), **small).learn(6).learn(9)
    with pytest.warns(UserWarning, match="replay buffer: 2 unfinished episodes with 7 steps are left out"):
        buffer = load_dataset(model.replay_buffer)
    assert buffer.episode_lengths.tolist() == [4, 4]
    assert buffer.terminated.all()


def test_an_episode_without_an_end_is_all_that_there_is():
    buffer = ReplayBuffer(5, spaces.Box(-1, 1, (1,)), spaces.Box(-1, 1, (1,)), device="cpu")
    for step in range(4):
        buffer.add(np.array([step / 10]), np.array([(step + 1) / 10]), np.zeros(1), np.zeros(1), np.zeros(1), [{}])
    with pytest.warns(UserWarning, match="1 unfinished episodes with 4 steps are all that there is; another learn()"):
        loaded = load_dataset(buffer)
    assert loaded.episode_lengths.tolist() == [4]
    assert not loaded.terminated[0]


def test_a_replay_buffer_without_a_whole_episode():
    empty = ReplayBuffer(10, spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,)), device="cpu")
    with pytest.raises(DatasetError, match="replay buffer: holds no whole episode in 0 steps of 1 environments"):
        load_dataset(empty)
    images = ReplayBuffer(10, spaces.Box(0, 255, (8, 8), np.uint8), spaces.Box(-1, 1, (2,)), device="cpu")
    with pytest.raises(DatasetError, match=r"replay buffer: Observation space .* is no image that can be used"):
        load_dataset(images)
    several = ReplayBuffer(10, spaces.Box(-1, 1, (3,)), spaces.MultiBinary(3), device="cpu")
    with pytest.raises(DatasetError, match=r"replay buffer: the action space is MultiBinary\(3\)"):
        load_dataset(several)


def test_a_replay_buffers_images_stay_bytes():
    """As `SAC("MultiInputPolicy", ...)` stores them, channels first."""
    image = spaces.Box(0, 255, (3, 16, 16), np.uint8)
    space = spaces.Dict({"camera": image, "gripper": spaces.Box(-1, 1, (2,), np.float32)})
    replay_buffer = DictReplayBuffer(10, space, spaces.Box(-1, 1, (1,)), device="cpu", handle_timeout_termination=True)
    space.seed(0)
    frames = [space.sample() for _ in range(4)]
    seen = [{key: each[None] for key, each in frame.items()} for frame in [*frames, frames[-1]]]
    for step in range(4):
        replay_buffer.add(seen[step], seen[step + 1], np.zeros((1, 1)), np.ones(1), np.array([step == 3]), [{}])
    buffer = load_dataset(replay_buffer)
    np.testing.assert_array_equal(buffer.own("camera").numpy(), [frame["camera"] for frame in frames])
    np.testing.assert_array_equal(buffer.observations.numpy(), [frame["gripper"] for frame in frames])
    alone = load_dataset(replay_buffer, observation_keys=["camera"])
    assert list(alone.image_spaces) == ["camera"]
    assert (alone.observations == 0).all()


def several_episodes() -> dict[str, Any]:
    """Flat arrays of three episodes of 20 steps."""
    rng = np.random.default_rng(0)
    flat = {"observations": rng.random((60, 3)), "actions": rng.uniform(-1, 1, (60, 1)), "rewards": rng.random(60)}
    return {**flat, "episode_ends": [20, 40, 60]}


@pytest.mark.parametrize(
    "ends", [{"episode_ends": [20, 40, 60]}, {"episode_lengths": [20] * 3}, {"episode": np.arange(60) // 20}]
)
@pytest.mark.parametrize("n", [1, 2])
def test_arrays_of_several_episodes_in_a_list_are_datasets(ends, n):
    """As episodes they would be one of 60 steps each, and the returns-to-go would not end where they do."""
    arrays = {**several_episodes(), **ends}
    if "episode_ends" not in ends:
        del arrays["episode_ends"]
    buffer = load_dataset([arrays] * n, action_space=spaces.Box(-1, 1, (1,)))
    assert buffer.episode_lengths.tolist() == [20] * 3 * n
    with pytest.raises(
        TypeError, match=r"unknown option action_bounds .* Those of a single one: \{'dataset': \.\.\., 'action_b"
    ):
        load_dataset([arrays] * n, action_bounds=(-1, 1))


def test_a_list_mixes_files_tables_buffers_and_arrays(tmp_path):
    space, arrays = spaces.Box(-1, 1, (1,)), several_episodes()
    np.savez(tmp_path / "flat.npz", **arrays)
    alone = {name: array for name, array in arrays.items() if name != "episode_ends"}
    others = [tmp_path / "flat.npz", load_dataset(arrays, action_space=space), {"dataset": arrays, "weight": 3}]
    for other in others:
        assert load_dataset([arrays, other], action_space=space).episode_lengths.tolist() == [20] * 6
        with pytest.raises(DatasetError, match="does not say where episodes end"):
            load_dataset([alone, other], action_space=space)
    numbered = {**alone, "episode": np.full(60, 7)}
    assert load_dataset([alone, numbered], action_bounds=(-1, 1)).episode_lengths.tolist() == [60, 60], "one episode each"
    table = pd.DataFrame({"obs": [0.0, 1.0], "action": [0.5, -0.5], "reward": [1.0, 2.0], "done": [0, 1]})
    assert load_dataset([table, table], action_space=space).episode_lengths.tolist() == [2, 2]


TUPLES = {
    "a Box and a Discrete": spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Discrete(3))),
    "a MultiDiscrete, by tuples": spaces.MultiDiscrete([3, 4]),
    "Boxes": spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (3,)))),
    "Blackjack's": spaces.Tuple((spaces.Discrete(32), spaces.Discrete(11), spaces.Discrete(2))),
    "in a Dict": spaces.Dict(seen=spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Discrete(3))), goal=spaces.Box(-1, 1, (1,))),
}


@pytest.mark.parametrize("kind", TUPLES)
@pytest.mark.parametrize("followed", [False, True])
@pytest.mark.parametrize("nested", [False, True])
def test_tuple_observations_are_those_of_the_wrapper(kind, followed, nested):
    space = TUPLES[kind]
    space.seed(0)
    seen = [space.sample() for _ in range(7)]
    if isinstance(space, spaces.MultiDiscrete):
        seen = [tuple(map(int, each)) for each in seen]
    action = np.array([0.5])
    steps = [
        (before, action, after, 1.0, t == 5) if followed else (before, action, 1.0, t == 5, False)
        for t, (before, after) in enumerate(itertools.pairwise(seen))
    ]
    buffer = load_dataset([steps, steps] if nested else steps, action_space=spaces.Box(-1, 1, (1,)), observation_space=space)
    expected = [spaces.flatten(sort_observation_space(space), each) for each in seen[:-1]]
    np.testing.assert_array_equal(buffer.observations[: len(expected)], np.float32(expected))
    assert buffer.rewards[:6].tolist() == [1.0] * 6


def test_tuples_of_different_lengths_are_refused():
    steps = [((np.zeros(2), *[0] * n), [0.5], 1.0, n == 2) for n in (1, 2)]
    with pytest.raises(DatasetError, match="steps: cannot be read"):
        load_dataset(steps, action_space=spaces.Box(-1, 1, (1,)))


def test_arrays_of_single_numbers_in_a_list_are_no_steps():
    arrays = {"obs": np.zeros(60), "actions": np.zeros(60), "episode_ends": [20, 40, 60]}
    with pytest.warns(UserWarning, match="there is none of rewards"):
        assert load_dataset([arrays], action_space=spaces.Box(-1, 1, (1,))).n_episodes == 3


def test_entries_of_lists_are_not_renamed():
    episode = {"observations": {"top": np.zeros((3, 8, 8, 3), np.uint8)}, "actions": np.zeros((3, 1)), "rewards": np.ones(3)}
    with pytest.raises(TypeError, match="a mapping renames entries of LeRobot, robomimic and zarr datasets; give a list of"):
        load_dataset([episode], observation_keys={"pixels": "top"})
