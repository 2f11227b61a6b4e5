"""Values of a chain that are known, and the choice of the better of two ways."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.files import ModelFileError
from sb3_dtfm.policies.context import Context
from sb3_dtfm.policies.critic import SAMPLE_STRIDE, Critic
from sb3_dtfm.policies.options import PolicyOptions
from tests.algorithms.small import make_model, record_curves

SPACE = spaces.Box(-1.0, 1.0, (1,), np.float32)
N_STATES, GAMMA = 4, 0.8


def chain() -> TrajectoryBuffer:
    """
    From state 0 to 3: going on costs nothing and is worth 1 at the end; giving up is worth 0.3, and ends it.

    People go on three times of four, from any state.
    """
    random = np.random.default_rng(0)
    episodes = []
    for number in range(400):
        states, actions, rewards = [number % N_STATES], [], []
        while len(rewards) == 0 or rewards[-1] == 0:
            goes_on = random.uniform() < 0.75
            actions.append([0.5 if goes_on else -0.5])
            rewards.append(float(states[-1] == N_STATES - 1) if goes_on else 0.3)
            states.append(states[-1] + 1)
        observations = np.eye(N_STATES)[states[:-1]]
        episodes.append(Trajectory(observations, np.array(actions), np.array(rewards), terminated=True))
    return TrajectoryBuffer.from_trajectories(episodes, SPACE)


def values(critic: Critic) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In each state: of going on, of giving up, and V; in units of reward."""
    states = th.eye(N_STATES)
    with th.no_grad():
        on, up = (critic(states, th.full((N_STATES, 1), action)) for action in (0.5, -0.5))
        return tuple((each / critic.reward_scale).numpy() for each in (on, up, critic.value(states).squeeze(1)))


@pytest.mark.parametrize("expectile", [0.5, 0.95])
def test_values_of_a_chain(expectile):
    buffer = chain()
    th.manual_seed(0)
    critic = Critic(N_STATES, 1, hidden_dim=32, expectile=expectile)
    critic.optimizer.param_groups[0]["lr"] = 3e-3
    critic.set_scale(buffer.largest_discounted_return(GAMMA))
    generator = th.Generator().manual_seed(0)
    for _ in range(1_500):
        critic.learn(buffer.sample_transitions(64, 1, GAMMA, generator))
    expected = np.zeros(N_STATES + 1)  # V, from the end on
    for state in reversed(range(N_STATES)):
        on = 1.0 if state == N_STATES - 1 else GAMMA * expected[state + 1]
        expected[state] = weighed(on, 0.3, expectile)
    going_on = np.append(GAMMA * expected[1:N_STATES], 1.0)
    on, up, value = values(critic)
    np.testing.assert_allclose(on, going_on, atol=0.05)
    np.testing.assert_allclose(up, 0.3, atol=0.05)
    np.testing.assert_allclose(value, expected[:N_STATES], atol=0.05)


def test_a_step_whose_loss_is_not_finite_is_not_learned_from():
    """Not even by the spread, which a file with NaN in it would be refused for."""
    buffer = chain()
    th.manual_seed(0)
    critic = Critic(N_STATES, 1, hidden_dim=8)
    batch = buffer.sample_transitions(8, 1, GAMMA, th.Generator().manual_seed(0))
    before = {name: tensor.clone() for name, tensor in critic.state_dict().items()}
    parts = critic.learn(batch._replace(rewards=batch.rewards * np.inf))
    assert not np.isfinite(float(parts["critic_loss"]))
    for name, tensor in critic.state_dict().items():
        assert th.equal(tensor, before[name]), name
    critic.learn(batch)
    assert not th.equal(critic.advantage_std, before["advantage_std"])
    assert not th.equal(critic.value[0].weight, before["value.0.weight"])


def weighed(on: float, up: float, expectile: float) -> float:
    """The expectile v of two values, three times of four the first: sum of p |tau - 1(q < v)| (q - v) = 0."""
    best, worst, p = (on, up, 0.75) if on > up else (up, on, 0.25)
    high, low = p * expectile, (1 - p) * (1 - expectile)
    return (high * best + low * worst) / (high + low)


@pytest.fixture(scope="module")
def two_ways() -> TrajectoryBuffer:
    """Left or right as a coin decides, whatever is seen; right is worth 1."""
    random = np.random.default_rng(0)
    sides = random.choice((-1, 1), 400)
    seen = random.normal(size=(400, 3))
    return TrajectoryBuffer.from_trajectories(
        [
            Trajectory(seen[i : i + 1], np.full((1, 1), 0.6 * side), np.array([side > 0], float), terminated=True)
            for i, side in enumerate(sides)
        ],
        SPACE,
    )


SETTINGS = dict(context_length=1, batch_size=64, learning_rate=1e-2)


def with_critic(buffer: TrajectoryBuffer, **policy_kwargs) -> DTFM:
    kwargs = dict(
        critic_steps=1, dropout=0.0, flow_prediction="action", one_step_policy=False, flow_steps=8, **policy_kwargs
    )
    return make_model(DTFM, buffer, policy_kwargs=kwargs, **SETTINGS)


def went_right(model: DTFM, deterministic: bool = True) -> float:
    """Share of 200 starts; the target return is the mean of both ways."""
    random = np.random.default_rng(1)
    observations = {
        "observation": random.normal(size=(200, 3)).astype(np.float32),
        "return_to_go": np.full((200, 1), 0.5, np.float32),
        "timestep": np.zeros((200, 1), np.int64),
    }
    actions, _ = model.predict(observations, deterministic=deterministic)
    return float((actions > 0).mean())


@pytest.fixture(scope="module")
def decided(two_ways) -> DTFM:
    """Returns-to-go tell the ways apart, so the policy is to see none."""
    blind = TrajectoryBuffer(
        {name: getattr(two_ways, name).clone() for name in ("observations", "actions", "rewards", "returns_to_go")},
        two_ways.episodes,
        two_ways.observation_space,
        two_ways.action_space,
        "two ways",
    )
    blind.returns_to_go.fill_(0.5)
    return with_critic(blind).learn(600, log_interval=None)


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_critic_takes_the_better_of_two_ways(decided, deterministic):
    decided.policy.set_acting(n_action_samples=1)
    assert 0.3 < went_right(decided, deterministic) < 0.7
    decided.policy.set_acting(n_action_samples=8, temperature=0.0)
    assert went_right(decided, deterministic) > 0.95
    decided.policy.set_acting(temperature=1e6)  # chance alone
    assert 0.3 < went_right(decided, deterministic) < 0.7


def test_a_choice_repeats_and_is_saved(decided, tmp_path):
    decided.policy.set_acting(n_action_samples=4, temperature=0.1)
    decided.save(tmp_path / "model.zip")
    loaded = DTFM.load(tmp_path / "model.zip")
    assert loaded.policy.acting_settings() == decided.policy.acting_settings()
    assert went_right(loaded) == went_right(decided) == went_right(decided)


@pytest.mark.parametrize("flow_solver", ["euler", "one_step"])
def test_of_the_draws_the_most_valuable_one_is_taken(cheetah_buffer, flow_solver):
    model = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=3, chunk_size=3)).learn(4)
    assert {int(state["step"]) for state in model.policy.critic.optimizer.state.values()} == {3 * 4}
    random = np.random.default_rng(2)
    observation = cheetah_buffer.observations[random.integers(len(cheetah_buffer.observations), size=50)]
    observations = {
        "observation": observation.numpy(),
        "return_to_go": np.full((50, 1), 10.0, np.float32),
        "timestep": np.zeros((50, 1), np.int64),
    }
    first, gains = None, {}
    seen = model.policy.normalization.scale_observation(observation)
    for n_action_samples in (1, 8, 32):
        model.policy.set_acting(flow_solver=flow_solver, n_action_samples=n_action_samples)
        _, state = model.predict(observations, deterministic=True, episode_start=np.ones(50, bool))
        context = Context(*state)
        planned = np.concatenate([context.actions[:, -1:], context.plan], axis=1)[:, : model.policy.critic_horizon].reshape(
            50, -1
        )
        first = planned if first is None else first
        with th.no_grad():
            both = th.from_numpy(np.stack([first, planned], axis=1))
            gains[n_action_samples] = model.policy.critic.gains(seen, both)[:, 1].numpy()
    assert (gains[8] >= -1e-6).all()
    assert (gains[32] >= gains[8] - 1e-6).all()
    assert (gains[32] > 1e-4).mean() > 0.5


def test_another_action_is_worth_more_where_both_values_say_so():
    critic = Critic(1, 1)
    for q, slope in zip(critic.q_target, (1.0, 3.0), strict=True):
        q.forward = lambda pairs, slope=slope: 100.0 * pairs[..., :1] + slope * pairs[..., 1:]
    seen, actions = th.tensor([[5.0], [-5.0]]), th.tensor([[0.2], [0.5], [0.1]]).expand(2, 3, 1)
    th.testing.assert_close(critic.gains(seen, actions), th.tensor([[0.0, 0.3, -0.3]]).expand(2, 3), atol=1e-4, rtol=0)
    critic.q_target[1].forward = lambda pairs: -pairs[..., 1:]  # disagrees about all of them
    assert critic.choose(critic.gains(seen, actions), 0.0, th.full((2, 3), 0.5)).tolist() == [0, 0]


@pytest.mark.parametrize("sample_noise_std", [1.0, 1.5])
def test_samples_start_from_noise_of_sample_noise_std(cheetah_buffer, sample_noise_std):
    policy = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=1)).policy
    policy.set_training_mode(False)
    policy.set_acting(n_action_samples=4, sample_noise_std=sample_noise_std)
    hidden = th.randn(5, policy.network.trunk.embed_dim, generator=th.Generator().manual_seed(0))
    rows = np.arange(5)
    with th.no_grad():
        samples, _ = policy._best_of_n(hidden, cheetah_buffer.observations[:5], rows, deterministic=True)
        for turn in range(4):
            noise = policy.noise_table[th.from_numpy(rows + SAMPLE_STRIDE * turn) % len(policy.noise_table)]
            width = sample_noise_std if turn else 1.0  # the first is the action without a critic
            th.testing.assert_close(samples[:, turn], policy.network.decode(hidden, width * noise))
    with pytest.raises(ValueError, match="sample_noise_std"):
        policy.set_acting(sample_noise_std=0.0)


def test_what_chooses_by_value_is_not_exported(cheetah_buffer, tmp_path):
    model = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=1, n_action_samples=4))
    with pytest.raises(ValueError, match="n_action_samples=4: a choice by the critic is not exported"):
        model.export(tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_transformer_and_flow_learn_as_without(cheetah_buffer):
    plain, critic = (
        make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=n, chunk_size=3)).learn(5) for n in (0, 2)
    )
    for name, weight in plain.policy.network.state_dict().items():
        assert th.equal(critic.policy.network.state_dict()[name], weight), name


def test_going_on_is_the_same_to_the_bit(cheetah_buffer, tmp_path):
    def make() -> DTFM:
        return make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=1, chunk_size=3))

    straight = make().learn(8)
    half = make()
    half.learn(4).save(tmp_path / "half.zip")
    resumed = DTFM.load(tmp_path / "half.zip", dataset=cheetah_buffer).learn(4, reset_num_timesteps=False)
    for name, weight in straight.policy.state_dict().items():
        assert th.equal(resumed.policy.state_dict()[name], weight), name
    ours, theirs = (model.policy.critic.optimizer.state_dict()["state"] for model in (resumed, straight))
    assert all(th.equal(ours[i][name], theirs[i][name]) for i in theirs for name in theirs[i])


def test_values_are_logged(cheetah_buffer):
    model = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=1, n_action_samples=4))
    curves = record_curves(model)
    model.learn(4, log_interval=2)
    for name in ("critic_loss", "value_loss", "q_value", "best_of_n_share"):
        points = curves.points[f"train/{name}"]
        assert [step for step, _ in points] == [2, 4]
        assert np.isfinite([value for _, value in points]).all()
    assert 0 <= curves.points["train/best_of_n_share"][-1][1] <= 1


def test_what_cannot_choose_says_why(cheetah_buffer):
    with pytest.raises(ValueError, match="critic_steps=1: the critic has nothing to choose among: DT predicts one action"):
        make_model(DT, cheetah_buffer, policy_kwargs=dict(critic_steps=1))
    with pytest.raises(
        ValueError, match=r"n_action_samples=4 needs a model that was trained with policy_kwargs=dict\(critic_steps="
    ):
        make_model(DTFM, cheetah_buffer, policy_kwargs=dict(n_action_samples=4))
    model = make_model(DTFM, cheetah_buffer)
    with pytest.raises(ValueError, match="n_action_samples=2 needs"):
        model.policy.set_acting(n_action_samples=2)


def test_a_file_without_its_critic_is_refused(cheetah_buffer, tmp_path):
    make_model(DTFM, cheetah_buffer, policy_kwargs=dict(critic_steps=1)).learn(1).save(tmp_path / "critic.zip")
    plain = make_model(DTFM, cheetah_buffer).learn(1)
    with pytest.raises(ModelFileError, match="critic"):
        plain.set_parameters(str(tmp_path / "critic.zip"))


@pytest.mark.parametrize(
    ("given", "n_samples"), [({}, 1), ({"critic_steps": 1}, 8), ({"critic_steps": 1, "n_action_samples": 1}, 1)]
)
def test_a_critic_chooses_among_eight_samples_unless_told_otherwise(given, n_samples):
    assert PolicyOptions(**given).n_action_samples == n_samples
