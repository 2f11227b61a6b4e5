"""Threads that share a model, each with its own `state`, act as each alone."""

import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

from sb3_dtfm import DT, DTFM
from tests.conftest import TINY_FLOW_POLICY, TINY_POLICY, record_random_episodes

N_THREADS = 16


@pytest.fixture
def frequent_switches():
    """Threads give way to one another far more often than they would by themselves."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


def roll(model, observations: np.ndarray, barrier: Barrier | None = None) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Actions along the first steps of recorded observations, (T, O), and the state in the end."""
    actions, state, episode_start = [], None, np.array([True])
    if barrier is not None:
        barrier.wait()
    for t, values in enumerate(observations[:12]):
        observation = dict(observation=values, return_to_go=np.zeros(1), timestep=np.array([t]))
        action, state = model.predict(observation, state, episode_start, deterministic=True)
        actions.append(action)
        episode_start = np.array([False])
    return np.array(actions), state


@pytest.mark.parametrize("options", [dict(), dict(kv_cache=True), dict(kv_cache=True, tokens_per_step=1)])
@pytest.mark.parametrize(("algorithm", "policy_kwargs"), [(DT, TINY_POLICY), (DTFM, TINY_FLOW_POLICY)])
def test_threads_with_their_own_states_act_as_alone_to_the_bit(
    algorithm, policy_kwargs, options, cheetah_buffer, frequent_switches
):
    """Over the window's slide; what is kept of earlier steps, too."""
    policy_kwargs = dict(policy_kwargs, **options)
    model = algorithm("MultiInputPolicy", dataset=cheetah_buffer, context_length=5, policy_kwargs=policy_kwargs, seed=0)
    episodes = [episode.observations for episode in record_random_episodes(N_THREADS, seed=100)]
    expected = [roll(model, observations) for observations in episodes]
    assert all((state[-1].size > 0) == model.policy.options.kv_cache for _, state in expected)
    barrier = Barrier(N_THREADS)
    with ThreadPoolExecutor(N_THREADS) as pool:
        together = list(pool.map(lambda observations: roll(model, observations, barrier), episodes))
    for (actions, state), (actions_alone, state_alone) in zip(together, expected, strict=True):
        assert np.array_equal(actions, actions_alone)
        assert all(np.array_equal(array, alone) for array, alone in zip(state, state_alone, strict=True))


def test_threads_that_go_on_from_one_state_act_as_alone_to_the_bit(cheetah_buffer, frequent_switches):
    """One of them appends behind what the state keeps, and the others must not."""
    model = DT("MultiInputPolicy", dataset=cheetah_buffer, context_length=5, policy_kwargs=dict(TINY_POLICY, kv_cache=True))
    episodes = [episode.observations for episode in record_random_episodes(N_THREADS, seed=100)]
    start = dict(observation=episodes[0][0], return_to_go=np.zeros(1), timestep=np.array([0]))
    _, state = model.predict(start, None, np.array([True]), deterministic=True)
    _, state = model.predict(dict(start, timestep=np.array([1])), state, deterministic=True)
    barrier = Barrier(N_THREADS)

    def go_on(observations: np.ndarray, wait: bool = True) -> np.ndarray:
        actions, own_state = [], state
        if wait:
            barrier.wait()
        for t, values in enumerate(observations[2:], start=2):
            observation = dict(observation=values, return_to_go=np.zeros(1), timestep=np.array([t]))
            action, own_state = model.predict(observation, own_state, deterministic=True)
            actions.append(action)
        return np.array(actions)

    with ThreadPoolExecutor(N_THREADS) as pool:
        together = list(pool.map(go_on, episodes))
    assert np.array_equal(together, [go_on(observations, wait=False) for observations in episodes])
