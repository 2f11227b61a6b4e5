"""`predict`: full context in every way of calling it, repeatable, and safe against the wrong input."""

import itertools

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dtfm import DT, DTFM
from sb3_dtfm.heads import FlowHead
from sb3_dtfm.policies import DTFMPolicy
from tests.conftest import TINY_FLOW_POLICY, TINY_POLICY, make_env
from tests.timing import takes_less

ALGORITHMS = [(DT, TINY_POLICY), (DTFM, TINY_FLOW_POLICY)]
ONE_TOKEN_OPTIONS = {"tokens_per_step": 1, "film_return_to_go": True, "return_scaling": "timestep"}
ONE_TOKEN = [(algorithm, {**policy_kwargs, **ONE_TOKEN_OPTIONS}) for algorithm, policy_kwargs in ALGORITHMS]
CHUNKS = [(algorithm, {**policy_kwargs, "chunk_size": 4, "n_action_steps": 3}) for algorithm, policy_kwargs in ONE_TOKEN]
ONE_SAMPLE = {"n_action_samples": 1, "sample_noise_std": 1.0, "temperature": 0.0}
IDS = [f"{algorithm}{variant}" for variant in ("", ", one token", ", chunks") for algorithm in ("dt", "dtfm")]


@pytest.fixture(params=ALGORITHMS + ONE_TOKEN + CHUNKS, ids=IDS)
def model(request, cheetah_buffer):
    algorithm, policy_kwargs = request.param
    return algorithm(
        "MultiInputPolicy", dataset=cheetah_buffer, context_length=5, policy_kwargs=policy_kwargs, batch_size=16, seed=0
    ).learn(20)


def roll_plain(model, n_steps, seed=0):
    env = make_env()
    observation, _ = env.reset(seed=seed)
    actions = []
    for _ in range(n_steps):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, truncated, _ = env.step(action)
        actions.append(action)
        if truncated:
            observation, _ = env.reset(seed=seed + 1)
    return np.array(actions)


def roll_with_state(model, n_steps, seed=0):
    env = make_env()
    observation, _ = env.reset(seed=seed)
    actions, state, episode_start = [], None, np.array([True])
    for _ in range(n_steps):
        action, state = model.predict(observation, state=state, episode_start=episode_start, deterministic=True)
        observation, _, _, truncated, _ = env.step(action)
        actions.append(action)
        episode_start = np.array([truncated])
        if truncated:
            observation, _ = env.reset(seed=seed + 1)
    return np.array(actions)


def test_a_plain_loop_and_explicit_state_give_the_same_actions_to_the_bit(model):
    assert np.array_equal(roll_plain(model, 45), roll_with_state(model, 45))


def test_deterministic_actions_repeat_to_the_bit(model):
    assert np.array_equal(roll_plain(model, 12), roll_plain(model, 12))


def test_the_past_matters(model):
    """The same observation after different pasts gives different actions: the context is really used."""
    env = make_env()
    observation, _ = env.reset(seed=0)
    with_past, state = model.predict(observation, deterministic=True)
    following = {**observation, "timestep": np.array([1])}
    with_past, _ = model.predict(following, state=state, episode_start=np.array([False]), deterministic=True)
    alone, _ = model.predict(following, state=state, episode_start=np.array([True]), deterministic=True)
    assert not np.allclose(with_past, alone)


def test_predict_with_state_is_a_pure_function(model):
    observation, _ = make_env().reset(seed=0)
    _, state = model.predict(observation, deterministic=True)
    copies = [array.copy() for array in state]
    following = {**observation, "timestep": np.array([1])}
    first, _ = model.predict(following, state=state, deterministic=True)
    model.predict({**observation, "observation": observation["observation"] + 1}, deterministic=True)
    second, _ = model.predict(following, state=state, deterministic=True)
    assert np.array_equal(first, second)
    assert all(np.array_equal(array, copy) for array, copy in zip(state, copies, strict=True))


def test_parallel_environments_act_as_they_would_alone(model):
    """Rows do not see each other, also when one is reset in between."""
    vec_env = DummyVecEnv([make_env, make_env])
    vec_env.seed(3)
    observations = vec_env.reset()
    rows, alone_actions, together_actions = [None, None], [], []
    state, starts = None, np.ones(2, bool)
    for t in range(12):
        if t == 7:
            observations["timestep"][1] = 0
            starts = np.array([False, True])
        together, state = model.predict(observations, state=state, episode_start=starts, deterministic=True)
        alone = []
        for row in range(2):
            single = {key: value[row] for key, value in observations.items()}
            action, rows[row] = model.predict(single, rows[row], starts[row : row + 1], deterministic=True)
            alone.append(action)
        together_actions.append(together)
        alone_actions.append(alone)
        starts = np.zeros(2, bool)
        timesteps = observations["timestep"] + 1
        observations, _, _, _ = vec_env.step(together)
        observations["timestep"] = timesteps
    assert np.allclose(together_actions, alone_actions, atol=1e-5)


def test_actions_lie_in_the_environments_range_with_its_shape(model):
    observation, _ = make_env().reset(seed=0)
    action, _ = model.predict(observation)
    assert action.shape == (6,)
    assert model.action_space.contains(action)
    batch = {key: np.stack([value] * 3) for key, value in observation.items()}
    actions, state = model.predict(batch)
    assert actions.shape == (3, 6)
    assert all(len(array) == 3 for array in state)


def test_fresh_noise_differs_and_deterministic_noise_is_not_zero(cheetah_buffer):
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=TINY_FLOW_POLICY, seed=0)
    observation, _ = make_env().reset(seed=0)
    drawn = [model.predict(observation, deterministic=False)[0] for _ in range(2)]
    assert not np.allclose(*drawn)
    rows = np.array([5, 6, 12])
    noise = model.policy._acting_noise(rows, deterministic=True)
    assert noise.abs().min() > 0
    assert len(noise.unique(dim=0)) == 3
    assert th.equal(noise, model.policy._acting_noise(rows, deterministic=True))


def test_episodes_that_start_elsewhere_have_another_deterministic_noise(cheetah_buffer, monkeypatch):
    drawn = []
    forward = FlowHead.forward
    monkeypatch.setattr(FlowHead, "forward", lambda self, hidden, noise: drawn.append(noise) or forward(self, hidden, noise))
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=TINY_FLOW_POLICY, seed=0)
    starts = np.random.default_rng(0).normal(size=(50, 17)).astype(np.float32)
    starts[1] = starts[0]
    state = None
    for t in range(3):
        observation = dict(observation=starts + t, return_to_go=np.zeros((50, 1)), timestep=np.full((50, 1), t))
        _, state = model.predict(observation, state, np.full(50, t == 0), deterministic=True)
    for noise in drawn:
        assert th.equal(noise[0], noise[1])
        assert len(noise.unique(dim=0)) > 40  # 49 draws of 1,024 rows: about 48
    # Within an episode the rows of the table follow each other, whatever is observed.
    row = (model.policy.noise_table == drawn[0][2]).all(dim=1).nonzero().item()
    assert th.equal(model.policy.noise_table.roll(-row - 1, 0)[:2], th.stack([drawn[1][2], drawn[2][2]]))


def test_normalisation_is_the_datasets(model, cheetah_buffer):
    observations = cheetah_buffer.observations.numpy()
    assert np.allclose(model.policy.normalization.observation_mean, observations.mean(0), atol=1e-4)
    assert np.allclose(model.policy.normalization.observation_std, observations.std(0), rtol=1e-3)
    assert model.policy.normalization.return_scale == cheetah_buffer.returns_to_go.abs().max()


def test_weight_decay_spares_biases_norms_and_embeddings(model):
    decayed, spared = model.policy.optimizer.param_groups
    assert decayed["weight_decay"] == 1e-3
    assert spared["weight_decay"] == 0.0
    names = {id(parameter): name for name, parameter in model.policy.network.named_parameters()}
    assert all("weight" in names[id(p)] and "norm" not in names[id(p)] for p in decayed["params"])
    assert all("bias" in names[id(p)] or "norm" in names[id(p)] or "timestep" in names[id(p)] for p in spared["params"])
    assert len(decayed["params"]) + len(spared["params"]) == len(names)


def test_a_policy_saves_and_loads_alone(model, tmp_path):
    model.policy.save(str(tmp_path / "policy.pt"))
    loaded = type(model.policy).load(str(tmp_path / "policy.pt"))
    assert np.array_equal(roll_plain(loaded, 8), roll_plain(model, 8))


def test_a_policy_alone_acts_and_values_as_it_did(cheetah_buffer, tmp_path):
    """How many actions are carried out may have been changed since the critic learned to value so many."""
    kwargs = dict(TINY_FLOW_POLICY, chunk_size=4, critic_steps=1)
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=kwargs)
    model.policy.set_acting(n_action_steps=1, n_action_samples=3)
    model.policy.save(str(tmp_path / "policy.pt"))
    loaded = DTFMPolicy.load(str(tmp_path / "policy.pt"))
    assert loaded.acting_settings() == model.policy.acting_settings()
    assert loaded.critic_horizon == model.policy.critic_horizon == 2


def test_solver_can_be_changed_after_training(cheetah_buffer):
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=TINY_FLOW_POLICY, seed=0, ema_decay=0.9)
    assert isinstance(model.policy, DTFMPolicy)
    observation, _ = make_env().reset(seed=0)
    coarse, _ = model.predict(observation, deterministic=True)
    model.policy.set_acting(flow_solver="rk4", flow_steps=100)
    fine, _ = model.predict(observation, deterministic=True)
    model.policy.set_acting(flow_solver="heun", flow_steps=400)
    finest, _ = model.predict(observation, deterministic=True)
    assert not np.array_equal(coarse, fine)
    assert np.allclose(fine, finest, atol=1e-3)
    with pytest.raises(ValueError, match="flow_solver must be one of"):
        model.policy.set_acting(flow_solver="leapfrog", flow_steps=3)


def test_ten_thousand_rows_are_acted_on_in_two_seconds(cheetah_buffer):
    """At the default size, which draws by the flow for demonstrations."""
    acting = dict(flow_steps=10, chunk_size=8, return_conditioning=False, regression_coef=0.0)
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=acting, seed=0, device="cpu")
    random = np.random.default_rng(0)
    rows = {
        "observation": random.normal(size=(10_000, *cheetah_buffer.observation_space.shape)).astype(np.float32),
        "return_to_go": np.full((10_000, 1), 10.0, np.float32),
        "timestep": np.zeros((10_000, 1), np.int64),
    }
    assert takes_less(2.0, lambda: model.predict(rows, episode_start=np.ones(10_000, bool)))


def test_an_observation_without_return_to_go_is_refused(model):
    with pytest.raises(ValueError, match="ReturnToGoWrapper"):
        model.predict(np.zeros(17, np.float32))
    observation, _ = make_env().reset(seed=0)
    with pytest.raises(ValueError, match=r"\(16,\).*\(17,\)"):
        model.predict({**observation, "observation": observation["observation"][:16]})
    for name in ("return_to_go", "timestep"):
        with pytest.raises(ValueError, match=rf"{name}.*\(2,\).*\(1, 1\)"):
            model.predict({**observation, name: np.zeros(2)})


def test_a_state_of_other_environments_is_refused(model):
    observation, _ = make_env().reset(seed=0)
    _, state = model.predict(observation)
    batch = {key: np.stack([value] * 3) for key, value in observation.items()}
    with pytest.raises(ValueError, match=r"\(1, 5, 17\).*\(3, 5, 17\)"):
        model.predict(batch, state=state)


def test_a_cache_gives_the_same_actions_until_the_window_slides(model):
    exact = roll_plain(model, 12)
    model.policy.set_acting(kv_cache=True)
    cached = roll_plain(model, 12)
    assert np.allclose(cached[:5], exact[:5], atol=1e-4)
    assert not np.allclose(cached[5:], exact[5:], rtol=0, atol=5e-6)
    assert np.array_equal(roll_plain(model, 45), roll_with_state(model, 45))


def test_a_call_that_fails_leaves_the_cache_as_it_was(model, monkeypatch):
    model.policy.set_acting(kv_cache=True, n_action_steps=1)
    observation, _ = make_env().reset(seed=0)
    _, state = model.predict(observation, deterministic=True)
    following = {**observation, "timestep": np.array([1])}

    def fail(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sb3_dtfm.networks.cache.extend", fail)
        with pytest.raises(KeyboardInterrupt):
            model.predict(following, state=state, deterministic=True)
    after, _ = model.predict(following, state=state, deterministic=True)
    copied = tuple(array.copy() for array in state)
    assert np.array_equal(after, model.predict(following, state=copied, deterministic=True)[0])


def test_a_cache_that_starts_in_mid_episode_is_filled_from_the_window(model):
    """Also for rows whose episodes are of different ages."""
    env = make_env()
    observation, _ = env.reset(seed=0)
    observations = {key: np.stack([value] * 2) for key, value in observation.items()}
    states, actions = [], []
    for kv_cache in (True, False):
        model.policy.set_acting(kv_cache=kv_cache)
        state = None
        for t in range(4):
            observations["timestep"][:] = [[t], [max(0, t - 2)]]
            _, state = model.predict(observations, state=state, episode_start=np.array([t == 0, t <= 2]), deterministic=True)
        states.append(state)
    model.policy.set_acting(kv_cache=True, n_action_steps=1)
    observations["timestep"][:] = [[4], [2]]
    for state in states:
        actions.append(model.predict(observations, state=state, episode_start=np.zeros(2, bool), deterministic=True)[0])
    assert np.allclose(*actions, atol=1e-4)


def test_what_is_kept_is_not_copied_at_every_step(model):
    """Whoever goes on from the newest state appends to what it keeps; an older state is copied first, and stays."""
    model.policy.set_acting(kv_cache=True)
    observation, _ = make_env().reset(seed=0)
    kept = []
    state = None
    for t in range(50):
        _, state = model.predict({**observation, "timestep": np.array([t])}, state, np.array([t == 0]), deterministic=True)
        kept.append(state[-1])
    shared = [np.shares_memory(before, after) for before, after in itertools.pairwise(kept)]
    assert sum(shared) > 40
    assert not all(shared)  # at some step there is no more room
    _, other = model.predict({**observation, "timestep": np.array([50])}, state, deterministic=True)
    _, again = model.predict({**observation, "timestep": np.array([50])}, state, deterministic=True)
    assert not np.shares_memory(other[-1], again[-1])
    assert np.array_equal(other[-1], again[-1])


def test_predict_with_a_cache_is_a_pure_function(model):
    """Also over many steps, and when an old state is taken up again: what one call appends, another never sees."""
    model.policy.set_acting(kv_cache=True)
    observation, _ = make_env().reset(seed=0)

    def go_on(state, first, n_steps, shift):
        actions = []
        for t in range(first, first + n_steps):
            moved = {**observation, "observation": observation["observation"] + shift, "timestep": np.array([t])}
            action, state = model.predict(moved, state=state, deterministic=True)
            actions.append(action)
        return np.array(actions), state

    _, state = go_on(None, 0, 7, 0.0)
    copies = [array.copy() for array in state]
    once, _ = go_on(state, 7, 50, 0.0)
    other, _ = go_on(state, 7, 50, 0.5)
    again, _ = go_on(state, 7, 50, 0.0)
    assert np.array_equal(once, again)
    assert not np.allclose(once, other)
    assert all(np.array_equal(array, copy) for array, copy in zip(state, copies, strict=True))


def test_parallel_environments_with_a_cache_act_as_they_would_alone(model):
    model.policy.set_acting(kv_cache=True)
    test_parallel_environments_act_as_they_would_alone(model)


def test_one_step_acting_is_one_evaluation_saved_with_the_model(cheetah_buffer, tmp_path):
    policy_kwargs = {**TINY_FLOW_POLICY, "flow_solver": "one_step", "kv_cache": True}
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=policy_kwargs, batch_size=16, seed=0).learn(5)
    model.save(tmp_path / "model.zip")
    loaded = DTFM.load(tmp_path / "model.zip")
    settings = {"flow_solver": "one_step", "flow_steps": 4, "kv_cache": True, "n_action_steps": 1, **ONE_SAMPLE}
    assert loaded.policy.acting_settings() == settings
    assert np.array_equal(roll_plain(model, 8), roll_plain(loaded, 8))
    model.policy.set_acting(flow_solver="euler", flow_steps=10)
    assert not np.allclose(roll_plain(model, 8), roll_plain(loaded, 8))


def test_a_way_of_acting_that_was_chosen_after_training_is_saved(cheetah_buffer, tmp_path):
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=TINY_FLOW_POLICY, seed=0)
    model.policy.set_acting(flow_solver="heun", flow_steps=3)
    model.policy.set_acting(kv_cache=True)
    model.save(tmp_path / "model.zip")
    loaded = DTFM.load(tmp_path / "model.zip")
    settings = {"flow_solver": "heun", "flow_steps": 3, "kv_cache": True, "n_action_steps": 1, **ONE_SAMPLE}
    assert loaded.policy.acting_settings() == settings
    assert np.array_equal(roll_plain(model, 8), roll_plain(loaded, 8))


def test_one_step_acting_needs_a_model_that_learned_it(cheetah_buffer):
    policy_kwargs = {**TINY_FLOW_POLICY, "one_step_policy": False}
    model = DTFM("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=policy_kwargs, seed=0)
    with pytest.raises(ValueError, match="one_step_policy=True"):
        model.policy.set_acting(flow_solver="one_step")


def test_the_one_step_network_changes_nothing_else(cheetah_buffer):
    weights = []
    for one_step_policy in (True, False):
        policy_kwargs = {**TINY_FLOW_POLICY, "one_step_policy": one_step_policy, "dropout": 0.0}
        model = DTFM(
            "MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=policy_kwargs, batch_size=8, max_grad_norm=0.5, seed=0
        ).learn(5)
        weights.append(
            {name: p for name, p in model.policy.network.named_parameters() if "head.one_step_policy" not in name}
        )
    with_it, without_it = weights
    assert with_it.keys() == without_it.keys()
    assert all(th.equal(with_it[name], without_it[name]) for name in with_it)


@pytest.mark.parametrize("kv_cache", [False, True])
@pytest.mark.parametrize(("algorithm", "policy_kwargs"), ALGORITHMS, ids=["dt", "dtfm"])
def test_a_clipped_return_to_go_stays_within_the_data(algorithm, policy_kwargs, kv_cache, cheetah_buffer, tmp_path):
    kwargs = {**policy_kwargs, "clip_return_to_go": True, "kv_cache": kv_cache}
    model = algorithm("MultiInputPolicy", dataset=cheetah_buffer, context_length=3, policy_kwargs=kwargs, seed=0).learn(5)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    low, high = cheetah_buffer.return_to_go_range()
    assert (low < high).all()

    def actions(*returns_to_go):
        """Actions in the first steps of an episode with these returns-to-go."""
        state, found = None, []
        for t, return_to_go in enumerate(returns_to_go):
            observation = dict(observation=np.full(17, 0.1), return_to_go=np.array([return_to_go]), timestep=np.array([t]))
            action, state = loaded.predict(observation, state, np.array([t == 0]), deterministic=True)
            found.append(action)
        return np.array(found)

    assert np.array_equal(actions(1e6, 1e6), actions(*high[:2].tolist()))
    assert np.array_equal(actions(-1e6, -1e6), actions(*low[:2].tolist()))
    assert not np.array_equal(actions(*high[:2].tolist()), actions(*low[:2].tolist()))
    beyond = dict(observation=np.full(17, 0.1), return_to_go=np.array([0.0]), timestep=np.array([10**6]))
    assert np.isfinite(loaded.predict(beyond)[0]).all()
