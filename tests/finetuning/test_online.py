"""Fine-tuning of a DTFM by rounds of filtered imitation."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dtfm import DTFM
from sb3_dtfm.data import DatasetError, Trajectory, TrajectoryBuffer
from sb3_dtfm.envs import OBSERVATION, ReturnToGoWrapper
from sb3_dtfm.finetuning import OnlineDTFM
from sb3_dtfm.policies.context import Context
from tests.algorithms.small import make_model, record_curves
from tests.finetuning.test_learning import Sides, small_flow_of_two_sides
from tests.finetuning.test_noise_env import CHUNKS, make_venv

ONLINE = dict(n_episodes=4, gradient_steps=2, seed=5, device="cpu")


@pytest.fixture
def file(cheetah_buffer, tmp_path):
    model = make_model(DTFM, cheetah_buffer, ema_decay=0.9, policy_kwargs=CHUNKS).learn(5)
    model.save(tmp_path / "offline.zip")
    return tmp_path / "offline.zip"


@pytest.fixture
def model(file, cheetah_buffer):
    return OnlineDTFM.load(file, make_venv(), dataset=cheetah_buffer, **ONLINE)


class Watch(BaseCallback):
    """Keeps what each environment's steps were, environment by environment, and may end the training."""

    def __init__(self, n_steps: float = np.inf) -> None:
        super().__init__()
        self.ended: list[list] = []
        self.n_steps = n_steps

    def _on_training_start(self) -> None:
        self.running = [[] for _ in range(self.training_env.num_envs)]

    def _on_step(self) -> bool:
        now = self.locals
        for row, steps in enumerate(self.running):
            steps.append([now["observations"][OBSERVATION][row], now["actions"][row], now["rewards"][row]])
            if now["dones"][row]:
                self.ended.append(self.running[row])
                self.running[row] = []
        return self.n_calls < self.n_steps


def test_own_episodes_are_kept_as_they_were(model):
    """Episodes of 7, 10 and 4 steps in environments of their own, of which the second one ends for good."""
    watch = Watch()
    model.learn(90, watch)
    assert model.num_timesteps % 3 == 0
    assert 90 <= model.num_timesteps < 90 + 3 * 10
    own = model.replay_buffer
    assert own.episode_lengths[:4].tolist() == [4, 7, 4, 10]
    assert own.terminated.tolist() == [length == 10 for length in own.episode_lengths]
    assert own.truncated.tolist() == [length != 10 for length in own.episode_lengths]
    assert (own.successes == 1.0).all()
    expected = [np.array(column) for column in zip(*(step for steps in watch.ended for step in steps), strict=True)]
    assert [len(steps) for steps in watch.ended][: own.n_episodes] == own.episode_lengths.tolist()
    for array, column in zip((own.observations, own.actions, own.rewards), expected, strict=True):
        np.testing.assert_allclose(array, column[: len(own)], rtol=1e-6)


def test_learning_repeats_and_is_logged_and_a_callback_ends_it(file, cheetah_buffer):
    models = [OnlineDTFM.load(file, make_venv(), dataset=cheetah_buffer, **ONLINE) for _ in range(2)]
    curves = record_curves(models[0])
    for each in models:
        each.learn(60)
    for ours, theirs in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        th.testing.assert_close(ours, theirs, rtol=0, atol=0)
    assert models[0]._n_updates > 5
    assert {"rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate", "train/loss"} <= curves.points.keys()
    n_before = models[0].replay_buffer.n_episodes
    assert models[0].learn(60, Watch(n_steps=7)).num_timesteps == 21
    n_ended = models[0].replay_buffer.n_episodes - n_before
    assert n_ended == 2, "those that had ended, one after four steps and one after seven"


def episodes(returns, successes, first=100.0):
    """Episodes of three steps whose observations tell which one they are of."""
    return TrajectoryBuffer.from_trajectories(
        [
            Trajectory(np.full((3, 17), first + i), np.zeros((3, 6)), np.array([0.0, 0.0, value]), True, success=success)
            for i, (value, success) in enumerate(zip(returns, successes, strict=True))
        ],
        make_venv().action_space,
    )


@pytest.mark.parametrize(
    ("successes", "worthy"), [([True, False, None, None], {0, 3}), ([False] * 4, set())], ids=["some", "none"]
)
def test_so_many_steps_are_of_own_episodes_that_succeeded(model, successes, worthy):
    """
    A quarter of what is imitated is own.

    If nothing tells of success, an episode above the average counts: the second of the last two.
    """
    model.set_dataset(episodes([0.0] * 6, [None] * 6, first=0.0))
    model._training_seed = 0
    model.replay_buffer = episodes([-1e3, 1e3, -1e3, 1e3], successes)
    _, *batches = zip(range(20), model._imitated(), strict=False)
    present = {round(float(each) - 100) for _, batch in batches for each in batch.observations[:, -1, 0] if each > 50}
    n_own = {int((batch.observations[:, -1, 0] > 50).sum()) for _, batch in batches}
    assert present == worthy
    assert n_own == ({4} if worthy else {0})
    assert {len(batch.mask) for _, batch in batches} == {16}


def test_what_it_saves_is_a_dtfm(model, tmp_path, cheetah_buffer):
    model.learn(40).save(tmp_path / "online.zip")
    observations = make_venv().reset()
    expected, _ = model.predict(observations, deterministic=True, episode_start=np.ones(3, bool))
    for cls in (DTFM, OnlineDTFM):
        loaded = cls.load(tmp_path / "online.zip", device="cpu")
        actions, _ = loaded.predict(observations, deterministic=True, episode_start=np.ones(3, bool))
        np.testing.assert_array_equal(actions, expected)
    goes_on = OnlineDTFM.load(tmp_path / "online.zip", make_venv(), dataset=cheetah_buffer, **ONLINE)
    assert goes_on.learn(30).replay_buffer is not None


def test_what_a_turn_is_stays_in_its_file(model, tmp_path, cheetah_buffer):
    model.save(tmp_path / "online.zip")
    loaded = OnlineDTFM.load(tmp_path / "online.zip")
    assert (loaded.n_episodes, loaded.gradient_steps) == (4, 2)


def test_the_seed_is_the_environments_too(file, cheetah_buffer):
    firsts = []
    for _ in range(2):
        venv = make_vec_env("HalfCheetah-v5", 2, wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=1.0))
        OnlineDTFM.load(file, venv, dataset=cheetah_buffer, **ONLINE)
        firsts.append(venv.reset()[OBSERVATION])
    np.testing.assert_array_equal(*firsts)


def test_own_returns_are_expected_ones_as_the_datasets_are(cheetah_buffer, monkeypatch, tmp_path):
    monkeypatch.setattr("sb3_dtfm.data.expected.N_TIMESTEPS", 100)
    make_model(DTFM, cheetah_buffer, policy_kwargs={**CHUNKS, "expected_return_steps": 2}).save(tmp_path / "model")
    model = OnlineDTFM.load(tmp_path / "model", make_venv(), dataset=cheetah_buffer, **ONLINE)
    model.set_dataset(cheetah_buffer)
    model.replay_buffer = cheetah_buffer.best(best_share=0.2)
    asked = []
    model._batches = lambda buffer, *_: (asked.append(buffer.returns_to_go), iter(()))[1]
    model._imitated()
    _, own = asked
    assert (own != model.replay_buffer.returns_to_go).any()


def test_own_episodes_are_saved_and_taken_up(model, tmp_path):
    with pytest.raises(ValueError, match="no own episodes"):
        model.save_replay_buffer(tmp_path / "own.npz")
    model.learn(60).save_replay_buffer(tmp_path / "own")
    before, model.replay_buffer = model.replay_buffer, None
    model.load_replay_buffer(tmp_path / "own")
    for name in ("observations", "actions", "rewards", "returns_to_go"):
        th.testing.assert_close(getattr(model.replay_buffer, name), getattr(before, name), rtol=0, atol=0)
    np.testing.assert_array_equal(model.replay_buffer.successes, before.successes)
    np.testing.assert_array_equal(model.replay_buffer.terminated, before.terminated)
    model.learn(3, CheckpointCallback(1, str(tmp_path), save_replay_buffer=True), reset_num_timesteps=False)
    kept = model.replay_buffer
    model.load_replay_buffer(tmp_path / f"rl_model_replay_buffer_{model.num_timesteps}_steps.pkl")
    assert model.replay_buffer.episode_lengths.tolist() == kept.episode_lengths.tolist()
    th.testing.assert_close(model.replay_buffer.actions, kept.actions, rtol=0, atol=0)
    buffer = TrajectoryBuffer.from_trajectories(
        [Trajectory(np.zeros((2, 3)), np.zeros((2, 6)), np.zeros(2))], model.action_space
    )
    buffer.save(tmp_path / "other.npz")
    with pytest.raises(DatasetError, match=r"other\.npz holds observations of"):
        model.load_replay_buffer(tmp_path / "other.npz")


def test_a_critic_learns_of_all_episodes(cheetah_buffer, tmp_path):
    policy_kwargs = dict(CHUNKS, critic_steps=2, n_action_samples=4)
    make_model(DTFM, cheetah_buffer, policy_kwargs=policy_kwargs).learn(2).save(tmp_path / "critic.zip")
    model = OnlineDTFM.load(tmp_path / "critic.zip", make_venv(), dataset=cheetah_buffer, **ONLINE)
    model.set_dataset(episodes([0.0] * 4, [None] * 4, first=0.0))
    model.replay_buffer = episodes([-1e3] * 4, [False] * 4)
    generator = th.Generator().manual_seed(0)
    batch = model._sample_transitions(64, generator)
    assert int((batch.observations[:, 0] > 50).sum()) == 32
    assert len(batch.mask) == 64
    before = model.policy.critic.value[0].weight.clone()
    model.learn(40)
    assert (model.policy.critic.value[0].weight != before).any()


def test_what_it_cannot_learn_with_is_refused(file, cheetah_buffer):
    with pytest.raises(ValueError, match="no environment to act in"):
        OnlineDTFM.load(file, dataset=cheetah_buffer).learn(10)
    with pytest.raises(ValueError, match="no dataset to learn from"):
        OnlineDTFM.load(file, make_venv()).learn(10)
    normalized = VecNormalize(make_venv(), norm_obs=False)
    with pytest.raises(ValueError, match="norm_reward=True"):
        OnlineDTFM.load(file, normalized, dataset=cheetah_buffer).learn(10)
    for name, wrong in {"n_episodes": 0, "gradient_steps": 1.5}.items():
        with pytest.raises(ValueError, match=name):
            OnlineDTFM.load(file, make_venv(), dataset=cheetah_buffer, **{name: wrong})


def test_each_turn_has_the_whole_schedule_of_the_learning_rate(file, cheetah_buffer):
    settings = dict(ONLINE, learning_rate=0.1, learning_rate_schedule="linear", n_episodes=1, gradient_steps=4)
    model = OnlineDTFM.load(file, make_venv((10,), (False,)), dataset=cheetah_buffer, **settings)
    rates = []
    model._gradient_step = lambda *_: (
        model._update_learning_rate(model.policy.optimizer),
        rates.append(model._current_learning_rate),
        vars(model).update(_n_updates=model._n_updates + 1),
    )
    model.learn(15)
    np.testing.assert_allclose(rates, 0.1 * np.array(2 * [1.0, 0.75, 0.5, 0.25]))
    model.warmup_steps, model.learning_rate_schedule = 2, "constant"
    rates.clear()
    model.learn(15)
    np.testing.assert_allclose(rates, 0.1 * np.array(2 * [0.5, 1.0, 1.0, 1.0]))


def test_episodes_that_had_ended_survive_an_interrupt(model):
    class Interrupt(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 9:
                raise KeyboardInterrupt
            return True

    with pytest.raises(KeyboardInterrupt):
        model.learn(90, Interrupt())
    assert model.replay_buffer.episode_lengths.tolist() == [4, 7, 4]


def test_a_turn_that_was_interrupted_while_it_learned_is_learned_to_its_end(file, cheetah_buffer, tmp_path, monkeypatch):
    settings = dict(ONLINE, gradient_steps=5)
    model = OnlineDTFM.load(file, make_venv(), dataset=cheetah_buffer, **settings)
    before, step = model._n_updates, OnlineDTFM.train

    def interrupted(self, *args):
        if self._n_updates == before + 2:
            raise KeyboardInterrupt
        step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(OnlineDTFM, "train", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(9)
    model.save(tmp_path / "checkpoint.zip")
    model.save_replay_buffer(tmp_path / "own.npz")
    rest = OnlineDTFM.load(tmp_path / "checkpoint.zip", make_venv(), dataset=cheetah_buffer)
    rest.load_replay_buffer(tmp_path / "own.npz")
    factors = []
    monkeypatch.setattr(rest, "_update_learning_rate", lambda _: factors.append(rest._schedule_position()[0]))
    n_steps = rest.num_timesteps
    rest.learn(9 - n_steps, reset_num_timesteps=False)
    assert (rest.num_timesteps, rest._n_updates) == (n_steps, before + 5)
    assert factors == [2, 3, 4], "at the learning rates of the steps that were left"


def test_kept_keys_and_values_are_those_of_the_present_weights(cheetah_buffer, tmp_path):
    policy_kwargs = dict(kv_cache=True)
    make_model(DTFM, cheetah_buffer, policy_kwargs=policy_kwargs).learn(2).save(tmp_path / "cached.zip")
    model = OnlineDTFM.load(tmp_path / "cached.zip", make_venv(), dataset=cheetah_buffer, **ONLINE)
    seen = []
    predict = model.policy.predict
    model.policy.predict = lambda observation, state, *args: (seen.append(state), predict(observation, state, *args))[1]
    model.learn(40)
    sizes = [0 if state is None else Context(*state).keys_values.shape[1] for state in seen]
    begins = [i for i, size in enumerate(sizes) if size == 0]
    assert begins[0] == 0
    assert len(begins) > 1


def test_own_episodes_on_another_device_are_joined(cheetah_buffer):
    """As a GPU's buffer is in the second round; "meta" is a device that every machine has."""
    joined = TrajectoryBuffer.join([cheetah_buffer.to("meta"), cheetah_buffer], [1.0, 1.0])
    assert joined.observations.device.type == "meta"
    assert joined.n_episodes == 2 * cheetah_buffer.n_episodes


def test_own_episodes_of_double_precision_are_taken_up(tmp_path):
    offline, demonstrations = small_flow_of_two_sides(n_steps=2)
    offline.save(tmp_path / "offline.zip")

    class Double(Sides):
        action_space = spaces.Box(-1.0, 1.0, (1,), np.float64)

    venv = make_vec_env(Double, 2, wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=1.0))
    model = OnlineDTFM.load(tmp_path / "offline.zip", venv, dataset=demonstrations, **ONLINE).learn(8)
    model.save_replay_buffer(tmp_path / "own.npz")
    model.load_replay_buffer(tmp_path / "own.npz")
    n_before = model.replay_buffer.n_episodes
    assert model.learn(8).replay_buffer.n_episodes > n_before


def test_a_learning_rate_that_no_file_holds_is_asked_for_again(cheetah_buffer, tmp_path):
    def rate(remaining: float) -> float:
        return 1e-3

    make_model(DTFM, cheetah_buffer, learning_rate=rate).learn(2).save(tmp_path / "offline.zip")
    with pytest.raises(ValueError, match="learning_rate was the function rate"):
        OnlineDTFM.load(tmp_path / "offline.zip", make_venv(), dataset=cheetah_buffer, **ONLINE).learn(10)


@pytest.mark.slow
def test_what_is_rewarded_is_done_more_often(tmp_path):
    offline, demonstrations = small_flow_of_two_sides()
    offline.save(tmp_path / "offline.zip")
    make = dict(wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=1.0))
    venv, evaluated = (make_vec_env(Sides, 4, seed=seed, **make) for seed in (0, 1))
    settings = dict(n_episodes=50, gradient_steps=50, learning_rate_schedule="constant", seed=0, device="cpu")
    model = OnlineDTFM.load(tmp_path / "offline.zip", venv, dataset=demonstrations, **settings).learn(1500)
    before, _ = evaluate_policy(offline, evaluated, n_eval_episodes=100)
    after, _ = evaluate_policy(model, evaluated, n_eval_episodes=100)
    assert before < 0.7
    assert after > before + 0.2
