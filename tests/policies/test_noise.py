"""The noise that acting starts from: its own in every episode, the same each time, and the seed's where it is drawn."""

import os
import subprocess
import sys

import numpy as np
import pytest

from sb3_dtfm import DTFM
from sb3_dtfm.policies.context import empty_context, push
from tests.conftest import TINY_FLOW_POLICY, make_env

N = 200
# Rows of the noise table, among which an episode's key chooses.
N_ROWS = 1024
RANDOM = np.random.default_rng(0)
COARSE = {
    "one-hot": np.eye(N),
    "grid": np.stack(np.meshgrid(*[np.arange(6)] * 3), axis=-1).reshape(-1, 3)[:N],
    "switches": (np.arange(N)[:, None] >> np.arange(8)) & 1,
    "float16": RANDOM.normal(size=(N, 17)).astype(np.float16),
    "pixels": RANDOM.integers(0, 256, (N, 4)) / 256.0,
}


def episode_keys(observations: np.ndarray) -> np.ndarray:
    """Keys of the episodes that begin with these observations, (B,)."""
    n, dim = observations.shape
    start = np.zeros(n, np.float32), np.zeros(n, np.int64)
    return push(empty_context(n, 3, dim, 2), observations.astype(np.float32), *start).episode_keys


@pytest.mark.parametrize("name", COARSE)
def test_episodes_with_coarse_observations_start_at_rows_of_their_own(name):
    """200 draws of 1,024 rows are 182 different ones on average."""
    observations = COARSE[name]
    assert len(np.unique(observations, axis=0)) == N
    assert len(np.unique(episode_keys(observations) % N_ROWS)) > 150


def test_equal_observations_have_equal_keys():
    observations = RANDOM.normal(size=(N, 5))
    assert np.array_equal(episode_keys(observations), episode_keys(observations[::-1])[::-1])
    assert np.array_equal(episode_keys(np.zeros((1, 5))), episode_keys(-np.zeros((1, 5))))


def test_a_key_is_the_same_in_another_process():
    """Python's own hash is not: it is salted anew in every process."""
    script = "from tests.policies.test_noise import *; print(*episode_keys(COARSE['float16']))"
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    output = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert [int(key) for key in output.stdout.split()] == episode_keys(COARSE["float16"]).tolist()


@pytest.fixture
def model(cheetah_buffer):
    return DTFM("MultiInputPolicy", dataset=cheetah_buffer, context_length=5, policy_kwargs=TINY_FLOW_POLICY, seed=0)


def test_coarse_observations_start_from_noise_of_their_own(model):
    """
    Far outside of the data all of these look alike to the network, clipped as they are: what is left to tell their
    actions apart is the noise.
    """
    corners = 1024.0 * 2.0 ** ((np.arange(N)[:, None] >> np.arange(17)) & 1)
    start = np.array([True])
    actions = []
    for corner in corners:
        observation = dict(observation=corner, return_to_go=np.zeros(1), timestep=np.zeros(1, np.int64))
        actions.append(model.predict(observation, episode_start=start, deterministic=True)[0])
    assert len(np.unique(np.round(actions, 4), axis=0)) > 150


def sample(model, n_actions: int = 5) -> np.ndarray:
    observation, _ = make_env().reset(seed=0)
    start = np.array([True])
    return np.array([model.predict(observation, episode_start=start, deterministic=False)[0] for _ in range(n_actions)])


def test_a_random_seed_decides_what_is_sampled(model, tmp_path):
    """Whenever it is set, before the first action or in between; also on a loaded model."""
    drawn = {}
    for seed in (1, 2, 1, 2):
        model.set_random_seed(seed)
        actions = sample(model)
        assert len(np.unique(actions, axis=0)) == len(actions)
        assert np.array_equal(actions, drawn.setdefault(seed, actions))
    assert not np.isclose(drawn[1], drawn[2]).all(axis=1).any()
    model.save(tmp_path / "model")
    loaded = DTFM.load(tmp_path / "model")
    loaded.set_random_seed(1)
    assert np.array_equal(sample(loaded), drawn[1])


def test_a_random_seed_leaves_deterministic_actions_as_they_are(model):
    observation, _ = make_env().reset(seed=0)
    start = np.array([True])
    actions = []
    for seed in (1, 2):
        model.set_random_seed(seed)
        actions.append(model.predict(observation, episode_start=start, deterministic=True)[0])
    assert np.array_equal(*actions)
