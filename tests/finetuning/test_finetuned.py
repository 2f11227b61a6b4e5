"""A DTFM and its online actor as one model."""

import io
import json
import zipfile

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_dtfm import DTFM
from sb3_dtfm.files import ModelFileError
from sb3_dtfm.finetuning import FinetunedDTFM, NoiseActionVecEnv
from sb3_dtfm.policies.context import Context
from sb3_dtfm.policies.exported import ExportedPolicy
from sb3_dtfm.windows import Windows
from tests.algorithms.small import make_model
from tests.finetuning.test_noise_env import CHUNKS, make_venv, table_noise

OFF_POLICY = dict(learning_starts=6, batch_size=8)
QUICK = {SAC: OFF_POLICY, TQC: OFF_POLICY, PPO: dict(n_steps=4, batch_size=4, n_epochs=1), A2C: dict(n_steps=4)}


@pytest.fixture(scope="module")
def model(cheetah_buffer):
    return make_model(DTFM, cheetah_buffer, ema_decay=0.9, policy_kwargs=CHUNKS).learn(5)


def make_agent(model, algorithm=SAC, hidden_state=False, **kwargs):
    env = NoiseActionVecEnv(make_venv(), model, hidden_state=hidden_state)
    small = dict(device="cpu", seed=0, policy_kwargs=dict(net_arch=[16, 8]))
    return algorithm("MlpPolicy", env, **{**small, **QUICK.get(algorithm, {}), **kwargs})


@pytest.fixture(scope="module")
def agent(model):
    return make_agent(model, hidden_state=True).learn(30)


@pytest.mark.parametrize(("algorithm", "hidden_state"), [(SAC, False), (SAC, True), (TQC, False), (PPO, False), (A2C, True)])
def test_noise_is_a_draw_of_the_actors_own_distribution(model, algorithm, hidden_state):
    """The actor's mean and standard deviation, as Stable-Baselines3 computes them, and the row of the noise table."""
    agent = make_agent(model, algorithm, hidden_state).learn(30)
    finetuned = FinetunedDTFM.of(model, agent)
    env = NoiseActionVecEnv(make_venv(), model, hidden_state=hidden_state)
    shown = th.as_tensor(env.reset())
    drawn = th.as_tensor(table_noise(model.policy, env._known[0]))
    with th.no_grad():
        if algorithm in (SAC, TQC):
            mean, log_std, _ = agent.actor.get_action_dist_params(shown)
            expected = 1.5 * (mean + log_std.exp() * drawn).tanh()
        else:
            distribution = agent.policy.get_distribution(shown).distribution
            expected = (distribution.mean + distribution.stddev * drawn).clamp(-1.5, 1.5)
    th.testing.assert_close(finetuned.policy.online_actor.choose(shown, drawn), expected)
    _, context = model.policy.decode(*env._known, expected.numpy())
    observations = make_venv().reset()
    actions, _ = finetuned.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    np.testing.assert_allclose(actions, model.policy._to_environment(context.actions[:, -1]), atol=1e-5)


def test_a_finetuned_model_plays_in_the_environment_what_its_noise_plays_in_the_wrapper(model, agent):
    finetuned = FinetunedDTFM.of(model, agent)
    plain, state, starts = make_venv(), None, np.ones(3, bool)
    observations, expected = plain.reset(), [[], [], []]
    for _ in range(20):
        actions, state = finetuned.predict(observations, state, starts, deterministic=True)
        observations, _, starts, infos = plain.step(actions)
        for row in np.flatnonzero(starts):
            expected[row].append(infos[row]["episode"]["r"])
    env = NoiseActionVecEnv(make_venv(), model, hidden_state=True)
    shown, found = env.reset(), [[], [], []]
    for _ in range(20):
        with th.no_grad():
            drawn = th.as_tensor(table_noise(model.policy, env._known[0]))
            noise = finetuned.policy.online_actor.choose(th.as_tensor(shown), drawn).numpy()
        shown, _, dones, infos = env.step(noise)
        for row in np.flatnonzero(dones):
            found[row].append(infos[row]["terminal_observation"][17] * model.policy.normalization.return_scale.item())
    for row in range(3):
        assert len(expected[row]) >= 2
        reached = 5.0 - np.array(found[row][: len(expected[row])])
        np.testing.assert_allclose(reached, expected[row], atol=1e-3)


def test_a_file_holds_both_and_nothing_that_is_run(model, agent, tmp_path):
    finetuned = FinetunedDTFM.of(model, agent)
    finetuned.save(tmp_path / "finetuned")
    loaded = FinetunedDTFM.load(tmp_path / "finetuned")
    assert loaded.online_actor == finetuned.online_actor
    assert loaded.online_actor["layers"] == [16, 8]
    observations = make_venv().reset()
    for deterministic in (True, False):
        actions, state = finetuned.predict(observations, episode_start=np.ones(3, bool), deterministic=deterministic)
        again, other = loaded.predict(observations, episode_start=np.ones(3, bool), deterministic=deterministic)
        np.testing.assert_array_equal(actions, again)
        for ours, theirs in zip(state, other, strict=True):
            np.testing.assert_array_equal(ours, theirs)
    names = zipfile.ZipFile(tmp_path / "finetuned.zip").namelist()
    assert not [name for name in names if name.endswith((".pth", ".pkl", "data"))]
    with pytest.raises(
        ModelFileError, match=r"FinetunedDTFM loads it\. To fine-tune further, .* --model the DTFM that it began with"
    ):
        DTFM.load(tmp_path / "finetuned")


def test_it_has_no_part_that_learns():
    assert not {"train", "compute_loss", "set_dataset"} & set(dir(FinetunedDTFM))


def test_without_an_actor_it_is_the_dtfm(model, tmp_path):
    FinetunedDTFM.of(model).save(tmp_path / "without_actor")
    observations = make_venv().reset()
    expected, _ = model.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    for cls, path in ((FinetunedDTFM, tmp_path / "without_actor"), (DTFM, tmp_path / "without_actor")):
        actions, _ = cls.load(path).predict(observations, episode_start=np.ones(3, bool), deterministic=True)
        np.testing.assert_array_equal(actions, expected)


def test_the_model_that_is_finetuned_stays_as_it_is(model, agent):
    observations = make_venv().reset()
    before, _ = model.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    finetuned = FinetunedDTFM.of(model, agent)
    assert model.policy.online_actor is None
    assert not any(parameter.requires_grad for parameter in finetuned.policy.online_actor.parameters())
    actions, _ = finetuned.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    assert np.abs(actions - before).max() > 1e-4
    again, _ = model.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    np.testing.assert_array_equal(again, before)


def test_later_weights_of_the_agent_are_taken_over_when_asked(model):
    agent = make_agent(model).learn(12)
    finetuned = FinetunedDTFM.of(model, agent)
    before = finetuned.policy.online_actor.mean.weight.clone()
    agent.learn(12)
    th.testing.assert_close(finetuned.policy.online_actor.mean.weight, before, rtol=0, atol=0)
    finetuned.take_actor(agent)
    th.testing.assert_close(finetuned.policy.online_actor.mean.weight, agent.actor.mu.weight.detach(), rtol=0, atol=0)


class Hundredfold(BaseFeaturesExtractor):
    """As wide as the observation."""

    def __init__(self, observation_space):
        super().__init__(observation_space, observation_space.shape[0])

    def forward(self, observations):
        return 100.0 * observations


def test_other_actors_are_refused_by_name(model):
    stacked = VecFrameStack(NoiseActionVecEnv(make_venv(), model), 2)
    cases = [
        (make_agent(model, TD3), "The actor of TD3 cannot be taken over: it is a TD3"),
        (make_agent(model, use_sde=True), r"use_sde"),
        (make_agent(model, PPO, policy_kwargs=dict(activation_fn=th.nn.Softplus)), "expected linear layers"),
        (SAC("MlpPolicy", "Pendulum-v1", device="cpu"), "it does not learn in a NoiseActionVecEnv"),
        (
            SAC("MlpPolicy", VecNormalize(NoiseActionVecEnv(make_venv(), model)), device="cpu"),
            "VecNormalize stands between",
        ),
        (
            SAC("MlpPolicy", stacked, device="cpu"),
            r"it sees observations of \(38,\), and the NoiseActionVecEnv shows \(19,\)",
        ),
        *(
            (
                make_agent(model, algorithm, policy_kwargs=dict(features_extractor_class=Hundredfold)),
                "features of a Hundredf",
            )
            for algorithm in (SAC, PPO)
        ),
    ]
    for agent, message in cases:
        with pytest.raises(ValueError, match=message):
            FinetunedDTFM.of(model, agent)
    with pytest.raises(ValueError, match="does not learn from data"):
        FinetunedDTFM.of(model).learn(1)


BAD_SETTINGS = [
    ({"layers": [16, 9]}, "online_actor.*shape"),
    ({"layers": [1] * 33}, "layers must be at most 32"),
    ({"layers": "16"}, "layers must be at most 32"),
    ({"activation": "Softplus"}, "activation must be one of ReLU"),
    ({"bound": -1.0}, "bound must be a number above 0"),
    ({"squashed": 1}, "squashed must be one of True, False"),
    ({"hidden_state": False}, "online_actor.*shape"),
    ({"residual": True}, "online_actor.*shape"),
    ({"residual": 1}, "residual must be one of True, False"),
    ({"more": 1}, "No settings of an online actor"),
]


def save_with_other_settings(finetuned, path, change):
    """A model's file, of whose online actor the settings are changed by a function."""
    file = io.BytesIO()
    finetuned.save(file)
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(path, "w") as changed:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "model.json":
                configuration = json.loads(content)
                change(configuration["attributes"]["online_actor"])
                content = json.dumps(configuration).encode()
            changed.writestr(name, content)


@pytest.mark.parametrize(("changed", "message"), BAD_SETTINGS)
def test_a_file_whose_actor_is_damaged_is_refused(model, agent, tmp_path, changed, message):
    finetuned = FinetunedDTFM.of(model, agent)
    save_with_other_settings(finetuned, tmp_path / "damaged.zip", lambda settings: settings.update(changed))
    with pytest.raises(ModelFileError, match=message):
        FinetunedDTFM.load(tmp_path / "damaged.zip")


def test_a_file_without_residual_chooses_noise(model, agent, tmp_path):
    finetuned = FinetunedDTFM.of(model, agent)
    save_with_other_settings(finetuned, tmp_path / "old.zip", lambda settings: settings.pop("residual"))
    observations = make_venv().reset()
    actions, _ = finetuned.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    again, _ = FinetunedDTFM.load(tmp_path / "old").predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    np.testing.assert_array_equal(again, actions)


@pytest.mark.slow
def test_an_exported_file_acts_as_the_finetuned_model_does(model, agent, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    from sb3_dtfm.cli.main import main

    finetuned = FinetunedDTFM.of(model, agent)
    finetuned.save(tmp_path / "finetuned")
    assert main(["export", str(tmp_path / "finetuned.zip"), "-o", str(tmp_path / "finetuned.onnx")]) == 0
    exported = ExportedPolicy(finetuned.policy)
    inputs = exported.example(3)
    for noise in (inputs["noise"], th.zeros_like(inputs["noise"])):
        inputs = {**inputs, "noise": noise}
        session = onnxruntime.InferenceSession(tmp_path / "finetuned.onnx")
        (chunk,) = session.run(["chunk"], {name: each.numpy() for name, each in inputs.items()})
        np.testing.assert_allclose(chunk, exported(**inputs)[0].numpy(), atol=1e-4)
    observations = make_venv().reset()
    _, state = finetuned.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    of_a_first_step = {
        **{name: th.from_numpy(each) for name, each in zip(Windows._fields, state, strict=False)},
        "actions": model.policy.normalization.unscale_action(th.zeros(3, 5, 6)),
        "noise": th.zeros_like(inputs["noise"]),
        "episode_keys": th.from_numpy(state[Context._fields.index("episode_keys")]),
    }
    (chunk,) = session.run(["chunk"], {name: each.numpy() for name, each in of_a_first_step.items()})
    actions, _ = finetuned.predict(observations, episode_start=np.ones(3, bool), deterministic=True)
    np.testing.assert_allclose(chunk[:, 0], actions, atol=1e-4)


def test_an_actor_goes_before_a_critics_choice(cheetah_buffer):
    """In the wrapper the algorithm's noise is what acts, so that has to be what the fine-tuned model does."""
    critic = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(CHUNKS, critic_steps=1, n_action_samples=8)).learn(2)
    finetuned = FinetunedDTFM.of(critic, make_agent(critic).learn(30))
    observations = make_venv().reset()
    chosen, _ = finetuned.predict(observations, deterministic=True)
    finetuned.policy.set_acting(n_action_samples=1)
    alone, _ = finetuned.predict(observations, deterministic=True, episode_start=np.ones(len(chosen), bool))
    np.testing.assert_array_equal(chosen, alone)
    finetuned.policy.set_acting(n_action_samples=8)
    exported = ExportedPolicy(finetuned.policy)
    assert exported.online_actor is not None, "no critic chooses"


def test_a_finetuned_policy_without_its_model_is_not_saved(model, agent, tmp_path):
    with pytest.raises(ValueError, match=r"saved with its model: model\.save"):
        FinetunedDTFM.of(model, agent).policy.save(str(tmp_path / "policy.pt"))
    assert not list(tmp_path.iterdir())
