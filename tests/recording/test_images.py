"""Recording images: those that an environment observes or renders are read as they were, and seen alike while acting."""

import gymnasium as gym
import minari
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import load_dataset
from sb3_dtfm.envs import RenderWrapper, ReturnToGoWrapper, resize_image
from sb3_dtfm.recording.agent import random_actions, record_agent
from sb3_dtfm.recording.episodes import EpisodeRecorder, run_episodes
from sb3_dtfm.recording.minari import write_minari

ID = "local/images/test-v0"
TINY_PPO = dict(n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0)
SMALL = dict(features_extractor_kwargs=dict(channels=(8, 8), features_dim=8))


def make_pixels(state=True):
    return RenderWrapper(gym.make("Pendulum-v1", render_mode="rgb_array"), 40, state)


def wrapped(env):
    return ReturnToGoWrapper(env, target_return=-100.0)


gym.register("Pixels-v0", entry_point=make_pixels, max_episode_steps=5)


@pytest.fixture(autouse=True)
def datasets_path(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


class Noise(gym.Env):
    """Episodes of three steps, images in which no pixel is like its neighbour."""

    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, observation_space):
        self.observation_space = observation_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), 0.0, False, self.n_steps == 3, {}


def image(*shape):
    return spaces.Box(0, 255, shape, np.uint8)


@pytest.mark.parametrize(
    "space",
    [
        image(40, 48, 3),
        image(3, 40, 48),
        image(20, 48, 3),
        image(40, 48, 1),
        image(40, 48, 4),
        spaces.Dict(a=image(40, 48, 3), b=image(40, 48, 3)),
        spaces.Dict(a=image(40, 48, 3), small=image(1, 16, 16), bytes=image(6), x=spaces.Box(-1, 1, (2,))),
    ],
)
def test_any_image_comes_back_as_it_was(space):
    env = EpisodeRecorder(Noise(space))
    episodes = list(run_episodes([env], random_actions(env, 0), [5, 6]))
    dataset = write_minari(ID, episodes, env, {})
    buffer, ours = load_dataset(ID), dict(space.spaces) if isinstance(space, spaces.Dict) else {"image": space}
    cameras = [camera for camera, each in ours.items() if len(each.shape) == 3]
    assert sorted(buffer.image_spaces) == sorted(cameras)
    for camera in cameras:
        seen = [each if ours == {"image": space} else each[camera] for one in episodes for each in one.observations[:-1]]
        np.testing.assert_array_equal(buffer.own(camera), np.stack(seen))
        read = [one.observations if ours == {"image": space} else one.observations[camera] for one in dataset]
        np.testing.assert_array_equal(np.concatenate([each[:-1] for each in read]).reshape(np.shape(seen)), np.stack(seen))
    assert ReturnToGoWrapper(env, 0.0).observation_space["observation"].shape == buffer.observation_space.shape


def replay(env):
    """The environment's observation before each recorded action."""
    dataset = minari.load_dataset(ID)
    for episode, metadata in zip(dataset, dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True):
        observation, _ = env.reset(seed=metadata["seed"])
        for action in episode.actions:
            yield observation
            observation = env.step(action)[0]


@pytest.mark.parametrize("state", [True, False])
def test_what_an_agent_of_images_sees_is_recorded(state, tmp_path):
    pytest.importorskip("pygame")
    policy = dict(features_extractor_kwargs=dict(cnn_output_dim=8))
    env = gym.make("Pixels-v0", state=state)
    PPO("MultiInputPolicy", env, policy_kwargs=policy, **TINY_PPO).save(tmp_path / "agent")
    record_agent("ppo", tmp_path / "agent.zip", "Pixels-v0", 2, ID, n_envs=2, env_kwargs=dict(state=state), progress=False)
    buffer, seen = load_dataset(ID), list(replay(env))
    np.testing.assert_array_equal(buffer.own("pixels"), np.stack([each["pixels"] for each in seen]))
    assert len(buffer) == len(seen) == 2 * 5
    model = DTFM("MultiInputPolicy", dataset=buffer, batch_size=4, policy_kwargs=SMALL, seed=0).learn(1)
    model.set_env(wrapped(env))
    shown = model.get_env().reset()["pixels"]
    assert shown.shape == (1, 3, 40, 40), "channels first, by SB3"
    model.save(tmp_path / "dtfm")
    how = dict(env_kwargs=dict(state=state), env_wrapper=f"{__name__}.wrapped", progress=False, overwrite=True)
    record_agent("dtfm", tmp_path / "dtfm.zip", "Pixels-v0", 1, ID, **how)
    np.testing.assert_array_equal(load_dataset(ID).own("pixels"), np.stack([each["pixels"] for each in replay(env)]))


def test_what_an_environment_renders_is_recorded_beside_what_its_agent_sees(tmp_path, capsys):
    pytest.importorskip("pygame")
    PPO("MlpPolicy", "Pendulum-v1", **TINY_PPO).save(tmp_path / "agent")
    recording = ["record", "--algo", "ppo", "--model", str(tmp_path / "agent.zip"), "--env", "Pendulum-v1"]
    recording += ["--env-kwargs", "max_episode_steps:5", "--dataset-id", ID]
    assert main([*recording, "--episodes", "2", "--camera", "render", "--camera-size", "20"]) == 0
    buffer = load_dataset(ID)
    assert buffer.image_spaces == {"pixels": image(20, 20, 3)}
    env = RenderWrapper(gym.make("Pendulum-v1", render_mode="rgb_array", max_episode_steps=5), 20)
    seen = list(replay(env))
    np.testing.assert_array_equal(buffer.own("pixels"), np.stack([each["pixels"] for each in seen]))
    np.testing.assert_array_equal(buffer.observations, np.stack([each["state"] for each in seen]))
    env.reset(seed=0)
    whole = env.render()
    shown = env.observation(np.zeros(3))["pixels"]
    np.testing.assert_allclose(shown, whole.reshape(20, 25, 20, 25, 3).mean(axis=(1, 3)), atol=1.0)
    np.testing.assert_array_equal(resize_image(whole, (20, 20)), shown)
    with pytest.raises(SystemExit):
        main([*recording, "--episodes", "2", "--camera", "agentview"])
    assert "only 'render' is accepted of an agent, got agentview" in capsys.readouterr().err
    with pytest.raises(ValueError, match="RenderWrapper needs render_mode='rgb_array', got None"):
        RenderWrapper(gym.make("Pendulum-v1"))
