"""An exported policy: what the file gives is what `predict` gives, step by step."""

import importlib.util
import json
import zlib
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import TrajectoryBuffer
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.policies.exported import ExportedPolicy
from tests.algorithms.small import make_model
from tests.choices import Signs, record
from tests.choices import make_env as make_signs
from tests.conftest import record_random_episodes

ort = pytest.importorskip("onnxruntime")

LENGTHS = (30, 17, 9)  # of the environments' episodes: rows begin anew at different times
CHUNKS = {"chunk_size": 4, "n_action_steps": 3}
EVERYTHING = {
    **CHUNKS,
    "tokens_per_step": 1,
    "film_return_to_go": True,
    "return_scaling": "timestep",
    "clip_return_to_go": True,
    "observation_scaling": "robust",
    "timestep_embedding": False,
    "flow_prediction": "action",
    "flow_solver": "heun",
    "flow_steps": 2,
    "n_layers": 1,
}
VARIANTS = {
    "dt": (DT, {}),
    "dtfm, one token, chunks and the other options": (DTFM, EVERYTHING),
    "dtfm, kept keys and values, chunks": (DTFM, {**CHUNKS, "kv_cache": True, "flow_steps": 2}),
    "dtfm": (DTFM, {}),
    "dtfm, one step": (DTFM, {"flow_solver": "one_step"}),
    "dt, one token, chunks": (DT, {**CHUNKS, "tokens_per_step": 1}),
    "dt, one token, kept keys and values": (DT, {"tokens_per_step": 1, "kv_cache": True}),
}
N_FAST = 3  # an export takes ten seconds
DEPLOY = Path(__file__).parents[2] / "examples" / "deploy.py"
TYPES = {"tensor(float)": np.float32, "tensor(int64)": np.int64, "tensor(bool)": bool}


class Exported:
    """
    The loop around a file that every caller has, for B environments.

    :param path: the file
    :param n_rows: B
    """

    def __init__(self, path, n_rows):
        self.session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        self.settings = json.loads(self.session.get_modelmeta().custom_metadata_map["sb3_dtfm"])
        inputs = self.session.get_inputs()
        self.inputs = {each.name: np.zeros((n_rows, *each.shape[1:]), TYPES[each.type]) for each in inputs}
        self.plans = [[] for _ in range(n_rows)]

    def act(self, observation, noise=0.0):
        timestep = observation["timestep"][:, 0]
        for row in np.flatnonzero(timestep == 0):
            self.inputs["mask"][row], self.plans[row] = False, []
            if "noise" in self.inputs:
                self.inputs["episode_keys"][row] = zlib.crc32(observation["observation"][row] + 0.0)
        newest = {
            "observations": observation["observation"],
            "returns_to_go": observation["return_to_go"][:, 0],
            "timesteps": timestep,
            "mask": True,
            "actions": np.nan,  # is not read
        }
        for name, value in newest.items():
            self.inputs[name] = np.roll(self.inputs[name], -1, axis=1)
            self.inputs[name][:, -1] = value
        if "noise" in self.inputs:
            self.inputs["noise"][:] = noise
        chunks, *kept = self.session.run(None, self.inputs)
        if kept:
            self.inputs["keys_values"] = kept[0]
        self.plans = [
            plan or list(chunk[: self.settings["n_action_steps"]]) for plan, chunk in zip(self.plans, chunks, strict=True)
        ]
        action = np.array([plan.pop(0) for plan in self.plans])
        self.inputs["actions"][:, -1] = action
        return action


@pytest.fixture(scope="module")
def buffer():
    """Actions whose range is not [-1, 1]."""
    return TrajectoryBuffer.from_trajectories(
        record_random_episodes(6), spaces.Box(-2.0, 3.0, (6,)), source="random cheetah"
    )


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=pytest.mark.slow if i >= N_FAST else ()) for i, name in enumerate(VARIANTS)],
)
def pair(request, buffer, tmp_path_factory):
    """A model that has learned a little, and its file."""
    algorithm, policy_kwargs = VARIANTS[request.param]
    model = make_model(algorithm, buffer, policy_kwargs=policy_kwargs, learning_rate=1e-3, ema_decay=0.5).learn(20)
    path = tmp_path_factory.mktemp("exported") / "policy.onnx"
    model.export(path, env_id="HalfCheetah-v5", target_return=5.0)
    return model, path


def play(n_steps, lengths):
    """Observations of environments side by side, which the last action sent moves on."""
    vec_env = DummyVecEnv(
        [lambda n=n: ReturnToGoWrapper(gym.make("HalfCheetah-v5", max_episode_steps=n), 5.0) for n in lengths]
    )
    vec_env.seed(0)
    observation = vec_env.reset()
    for _ in range(n_steps):
        action = yield {key: value.copy() for key, value in observation.items()}
        observation, *_ = vec_env.step(action)
        yield


@pytest.mark.parametrize("lengths", [LENGTHS[:1], LENGTHS], ids=["one environment", "several"])
def test_whole_episodes_are_those_of_predict(pair, lengths):
    model, path = pair
    exported, episodes, state = Exported(path, len(lengths)), play(50, lengths), None
    for observation in episodes:
        expected, state = model.predict(observation, state, observation["timestep"][:, 0] == 0, deterministic=True)
        np.testing.assert_allclose(exported.act(observation), expected, rtol=0, atol=1e-5)
        episodes.send(expected)


def test_noise_that_is_given_is_started_from(pair):
    """Rows of zeros take the model's own."""
    model, path = pair
    if not model.policy.network.head.noise_dim or model.policy.options.kv_cache:
        pytest.skip("this one starts from none, or is seen above")
    exported, generator = Exported(path, 2), th.Generator().manual_seed(3)
    model.policy.seed_noise(3)
    observation = next(play(1, LENGTHS[:2]))
    noise = th.randn(2, exported.settings["noise_dim"], generator=generator).numpy()
    expected, _ = model.predict(observation, episode_start=np.ones(2, bool))
    np.testing.assert_allclose(exported.act(observation, noise), expected, rtol=0, atol=1e-5)


def test_the_file_says_what_a_caller_needs(pair):
    model, path = pair
    policy, settings = model.policy, Exported(path, 1).settings
    assert settings["algorithm"] == type(model).__name__
    assert (settings["env_id"], settings["target_return"]) == ("HalfCheetah-v5", 5.0)
    assert (settings["action_low"], settings["action_high"]) == ([-2.0] * 6, [3.0] * 6)
    assert settings["context_length"] == model.context_length
    assert settings["chunk_size"] == policy.options.chunk_size
    assert policy.acting_settings().items() <= settings.items()


@pytest.mark.slow
def test_choices_are_those_of_predict(tmp_path):
    """By way of the example, which acts in one environment; and drawn from noise that is given."""
    space = Signs().action_space
    buffer = TrajectoryBuffer.from_trajectories(record(error=0.3), space)
    model = make_model(DT, buffer, learning_rate=3e-3, policy_kwargs={"tokens_per_step": 1, "kv_cache": True}).learn(20)
    model.export(tmp_path / "policy.onnx")
    spec = importlib.util.spec_from_file_location("deploy", DEPLOY)
    deploy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(deploy)
    exported, env = deploy.Policy(str(tmp_path / "policy.onnx")), make_signs()
    for episode in range(2):
        observation, _ = env.reset(seed=episode)
        for _ in range(10):
            expected, _ = model.predict(observation, deterministic=True)
            found = exported.act(*(observation[key].squeeze() for key in ("observation", "return_to_go", "timestep")))
            assert space.contains(found)
            assert found == expected
            observation, *_ = env.step(found)
    generator = th.Generator().manual_seed(3)
    model.policy.seed_noise(3)
    many = {key: np.stack([value] * 500) for key, value in env.reset(seed=5)[0].items()}
    drawn, _ = model.predict(many, episode_start=np.ones(500, bool))
    noise = th.randn(500, space.n, generator=generator).numpy()
    chunks = Exported(tmp_path / "policy.onnx", 500).act(many, noise)
    assert (space.start + chunks.argmax(axis=1)).tolist() == drawn.tolist()
    assert len(set(drawn.tolist())) > 1


def test_exporting_changes_nothing_of_the_model(buffer):
    model = make_model(DTFM, buffer)
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.policy.set_training_mode(True)
    exported = ExportedPolicy(model.policy)
    exported(**exported.example())
    assert model.policy.training
    assert all(th.equal(tensor, before[name]) for name, tensor in model.policy.state_dict().items())
    assert all(parameter.requires_grad for parameter in model.policy.network.parameters())
