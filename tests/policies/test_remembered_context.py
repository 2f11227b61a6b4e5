"""Context with and without `state`: without it the policy remembers the steps of one caller."""

import warnings

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DT, DTFM
from tests.conftest import EPISODE_LENGTH, TINY_FLOW_POLICY, TINY_POLICY, make_env

VARIANTS = [(DT, False), (DT, True), (DTFM, False), (DTFM, True)]


@pytest.fixture(params=VARIANTS, ids=["dt", "dt-kv-cache", "dtfm", "dtfm-kv-cache"])
def model(request, cheetah_buffer):
    algorithm, kv_cache = request.param
    policy_kwargs = dict(TINY_POLICY if algorithm is DT else TINY_FLOW_POLICY, kv_cache=kv_cache)
    return algorithm("MultiInputPolicy", dataset=cheetah_buffer, context_length=5, policy_kwargs=policy_kwargs, seed=0)


@pytest.fixture(scope="module")
def episodes():
    """The observations of three episodes under random actions: what callers see, whatever the policy does."""
    found = []
    for seed in range(3):
        env = make_env()
        env.action_space.seed(seed)
        observations = [env.reset(seed=seed)[0]]
        while len(observations) < EPISODE_LENGTH:
            observations.append(env.step(env.action_space.sample())[0])
        found.append(observations)
    return found


def act(model, observation, **kwargs):
    return model.predict(observation, deterministic=True, **kwargs)[0]


def act_alone(model, observations) -> np.ndarray:
    """Actions for a caller who passes a state of their own from the first observation to the last."""
    actions, state, episode_start = [], None, np.array([True])
    for observation in observations:
        action, state = model.predict(observation, state, episode_start, deterministic=True)
        actions.append(action)
        episode_start = np.array([False])
    return np.array(actions)


def caught_hints(caught) -> list[str]:
    """The warnings that tell to pass `state`."""
    return [
        str(warning.message)
        for warning in caught
        if issubclass(warning.category, UserWarning) and "state" in str(warning.message)
    ]


@pytest.fixture
def hints():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield lambda: caught_hints(caught)


def test_a_plain_loop_over_episodes_acts_as_with_states_and_never_warns(model, episodes, hints):
    plain = [[act(model, observation) for observation in episode] for episode in episodes]
    assert np.array_equal(plain, [act_alone(model, episode) for episode in episodes])
    assert hints() == []


def test_episodes_of_one_step_are_episodes(model, episodes, hints):
    """A time step of 0 is a start, also right behind another one."""
    plain = [act(model, episode[0]) for episode in episodes]
    assert np.array_equal(plain, [act_alone(model, episode[:1])[0] for episode in episodes])
    assert hints() == []


@pytest.mark.parametrize("n_envs", [1, 2])
def test_an_evaluation_in_between_leaves_a_plain_loop_alone(n_envs, model, episodes, hints):
    expected = act_alone(model, episodes[0])
    vec_env = DummyVecEnv([lambda: Monitor(make_env())] * n_envs)
    actions = []
    for t, observation in enumerate(episodes[0]):
        if t in (0, 7, 20):
            evaluate_policy(model, vec_env, n_eval_episodes=n_envs)
        actions.append(act(model, observation))
    assert np.array_equal(actions, expected)
    assert hints() == []


@pytest.mark.filterwarnings("ignore:.*state:UserWarning")
def test_calls_with_a_state_or_an_episode_start_neither_read_nor_change_what_is_remembered(model, episodes):
    ours, theirs = episodes[:2]
    expected = act_alone(model, ours)
    with_start = act_alone(model, theirs[:1])[0]
    _, state = model.predict(theirs[0], episode_start=np.array([True]), deterministic=True)
    with_state = act(model, theirs[1], state=state)
    actions = []
    for t, observation in enumerate(ours):
        actions.append(act(model, observation))
        assert np.array_equal(act(model, theirs[0], episode_start=np.array([True])), with_start)
        assert np.array_equal(act(model, theirs[1], state=state), with_state)
        if t > 0:  # no start, but nothing was given to go on from either
            alone = act(model, observation, episode_start=np.array([False]))
            assert np.array_equal(alone, act(model, observation, episode_start=np.array([True])))
    assert np.array_equal(actions, expected)


def test_a_second_call_at_one_time_step_is_the_first_again(model, episodes, hints):
    """As by somebody who looks at an action before taking it."""
    expected = act_alone(model, episodes[0])
    for t, observation in enumerate(episodes[0]):
        for _ in range(1 + t % 3):
            assert np.array_equal(act(model, observation), expected[t])
    assert hints() == []


def test_a_jump_in_time_warns_once_and_starts_anew(model, episodes, hints):
    observations = episodes[0]
    for observation in observations[:4]:
        act(model, observation)
    assert hints() == []
    after_the_jump = [act(model, observation) for observation in observations[7:12]]
    assert len(hints()) == 1
    assert np.array_equal(after_the_jump, act_alone(model, observations[7:12]))
    act(model, observations[20])
    act(model, observations[3])
    assert len(hints()) == 1


def test_a_first_call_in_mid_episode_warns(model, episodes, hints):
    act(model, episodes[0][7])
    assert len(hints()) == 1


def test_two_environments_that_take_turns_are_warned_once(model, episodes, hints):
    """At equal time steps, where the one's observations would fill the other's context."""
    for ours, theirs in zip(*episodes[:2], strict=True):
        act(model, ours)
        act(model, theirs)
    assert len(hints()) == 1


def test_two_environments_that_take_turns_with_their_own_states_act_as_alone(model, episodes, hints):
    expected = [act_alone(model, episode) for episode in episodes[:2]]
    states, actions = [None, None], ([], [])
    for t, observations in enumerate(zip(*episodes[:2], strict=True)):
        for i, observation in enumerate(observations):
            start = np.array([t == 0])
            action, states[i] = model.predict(observation, states[i], start, deterministic=True)
            actions[i].append(action)
    assert np.array_equal(actions, expected)
    assert hints() == []


def test_what_predict_returns_is_short_and_an_ordinary_tuple_to_others(model, episodes):
    _, state = model.predict(episodes[0][0])
    assert repr(state) == "Context(1 row, 5 steps)"
    assert isinstance(state, tuple)
    again, restored = (act(model, episodes[0][1], state=each) for each in (state, tuple(state)))
    assert np.array_equal(again, restored)


@pytest.mark.filterwarnings("ignore:.*state:UserWarning")
def test_reset_forgets(model, episodes):
    observations = episodes[0]
    for observation in observations[:4]:
        act(model, observation)
    model.policy.reset()
    forgotten = act(model, observations[4])
    assert np.array_equal(forgotten, act_alone(model, observations[4:5])[0])
    assert not np.array_equal(forgotten, act_alone(model, observations[:5])[4])


def test_of_parallel_environments_one_may_be_asked_again_while_another_goes_on(model, episodes, hints):
    ours, theirs = episodes[:2]
    order = [(0, 0), (1, 1), (1, 2), (2, 3), (3, 3), (4, 4)]
    expected = [act_alone(model, episode[:5]) for episode in (ours, theirs)]
    for i, j in order:
        pair = {key: np.stack([ours[i][key], theirs[j][key]]) for key in ours[i]}
        assert np.allclose(act(model, pair), [expected[0][i], expected[1][j]], atol=1e-4), (i, j)
    assert hints() == []


def test_the_remembered_context_is_read_only_for_callers(model):
    """Writing into the state that a call without `state` returned would change the next action."""
    env = make_env()
    observation, _ = env.reset(seed=0)
    _, state = model.predict(observation, deterministic=True)
    for array in state:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
