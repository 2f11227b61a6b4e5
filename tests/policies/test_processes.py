"""A model in other processes: forked, pickled, and beside environments that run in their own."""

import copy
import multiprocessing
import pickle
import sys

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_dtfm import DT, DTFM
from tests.algorithms.small import make_model
from tests.conftest import make_env


@pytest.fixture(params=[(DT, False), (DTFM, True)], ids=["dt", "dtfm-kv-cache"])
def model(request, cheetah_buffer):
    algorithm, kv_cache = request.param
    return make_model(algorithm, cheetah_buffer, policy_kwargs=dict(kv_cache=kv_cache))


def go_on(model, state, first: int, n_steps: int):
    """Actions from a state on, and the state after them."""
    actions = []
    for t in range(first, first + n_steps):
        values = np.random.default_rng(t).normal(size=17).astype(np.float32)
        observation = {"observation": values, "return_to_go": np.ones(1), "timestep": np.array([t])}
        action, state = model.predict(observation, state, np.array([t == 0]), deterministic=True)
        actions.append(action)
    return np.array(actions), state


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))], ids=["deepcopy", "pickle"]
)
def test_a_policy_and_a_state_that_were_copied_go_on_as_the_originals(copied, model):
    _, state = go_on(model, None, 0, 7)
    policy, other_state = copied(model.policy), copied(state)
    expected, _ = go_on(model, state, 7, 8)
    assert np.array_equal(go_on(policy, other_state, 7, 8)[0], expected)
    assert np.array_equal(go_on(model, other_state, 7, 8)[0], expected)


@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux forks safely.")
def test_a_forked_process_goes_on_as_its_parent(model):
    _, state = go_on(model, None, 0, 7)
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=lambda: sender.send(go_on(model, state, 7, 8)[0]))
    process.start()
    expected, _ = go_on(model, state, 7, 8)
    assert receiver.poll(60)
    assert np.array_equal(receiver.recv(), expected)
    process.join(60)
    assert process.exitcode == 0


@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux forks safely.")
def test_environments_in_their_own_processes_are_acted_in_as_in_this_one(cheetah_buffer):
    model = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(kv_cache=True))
    makers = [lambda: Monitor(make_env())] * 2
    returns = []
    for vec_env in (DummyVecEnv(makers), SubprocVecEnv(makers, start_method="fork")):
        vec_env.seed(0)
        returns.append(evaluate_policy(model, vec_env, n_eval_episodes=2, return_episode_rewards=True))
        vec_env.close()
    assert returns[0] == returns[1]
