"""Online algorithms and own episodes where a policy sees images."""

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_dtfm import DTFM
from sb3_dtfm.data import load_dataset
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import FinetunedDTFM, NoiseActionVecEnv, OnlineDTFM, ResidualActionVecEnv
from tests.algorithms.small import make_model
from tests.images import CAMERA, make_pixels, record

SMALL = dict(features_extractor_kwargs=dict(channels=(8, 8), features_dim=8))


@pytest.fixture(scope="module")
def buffer():
    pytest.importorskip("pygame")
    return load_dataset(record(4), action_bounds=(-2, 2))


def wrapped():
    return ReturnToGoWrapper(make_pixels(), target_return=-100.0)


def make(buffer, **kwargs):
    return make_model(DTFM, buffer, context_length=4, policy_kwargs={**SMALL, "flow_steps": 2, **kwargs}).learn(1)


def test_a_plan_between_two_choices_sees_its_images(buffer):
    model = make(buffer, chunk_size=2, n_action_steps=2)
    frozen, plain = NoiseActionVecEnv(make_vec_env(wrapped, 1, seed=3), model, bound=10.0), make_vec_env(wrapped, 1, seed=3)
    frozen.reset()
    observation, state, start = plain.reset(), None, np.array([True])
    for _ in range(3):
        frozen.step(model.policy.default_noise(frozen._known[0]))
        for _ in range(2):
            action, state = model.policy.predict(observation, state, start, deterministic=True)
            observation, *_ = plain.step(action)
            start = np.array([False])
    _, after = model.policy.predict(observation, state, start, deterministic=True)
    np.testing.assert_allclose(frozen._known[0].observations, after.observations, atol=1e-5)


@pytest.mark.parametrize("frozen_env", [NoiseActionVecEnv, ResidualActionVecEnv])
def test_an_online_actor_sees_features(frozen_env, buffer, tmp_path):
    model = make(buffer)
    env = frozen_env(make_vec_env(wrapped, 2), model)
    assert env.observation_space.shape[0] == 3 + 8 + 2 + (frozen_env is ResidualActionVecEnv)
    agent = SAC("MlpPolicy", env, learning_starts=4, batch_size=4, policy_kwargs=dict(net_arch=[8]), device="cpu", seed=0)
    finetuned = FinetunedDTFM.of(model, agent.learn(8))
    finetuned.save(tmp_path / "finetuned")
    acting = make_vec_env(wrapped, 1)
    loaded = FinetunedDTFM.load(tmp_path / "finetuned", acting)
    observation = loaded.get_env().reset()
    np.testing.assert_array_equal(*(each.predict(observation, deterministic=True)[0] for each in (finetuned, loaded)))
    assert np.isfinite(evaluate_policy(loaded, acting, 1)[0])


def test_own_episodes_keep_their_images(buffer, tmp_path):
    make(buffer).save(tmp_path / "model")
    model = OnlineDTFM.load(tmp_path / "model", make_vec_env(wrapped, 2), dataset=buffer)
    model.n_episodes, model.gradient_steps = 2, 2
    model.learn(40)
    own = model.replay_buffer
    images = own.own(CAMERA)
    assert (len(own), images.shape, images.float().std() > 0) == (40, (40, 3, 32, 32), True)
    assert not (images[1:] == images[:-1]).all()
    model.save_replay_buffer(tmp_path / "own")
    model.load_replay_buffer(tmp_path / "own")
    assert model.replay_buffer.image_spaces[CAMERA].shape == (3, 32, 32)
