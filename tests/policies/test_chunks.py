"""Several actions from one hidden state: what is learned, and when the policy looks again."""

import numpy as np
import pytest
import torch as th

from sb3_dtfm import DT, DTFM
from tests.algorithms.small import make_model
from tests.conftest import make_env

H, N = 4, 3  # actions in a chunk, and of these carried out
CHUNKS = dict(chunk_size=H, n_action_steps=N)


@pytest.fixture(params=[DT, DTFM])
def model(request, cheetah_buffer):
    return make_model(request.param, cheetah_buffer, policy_kwargs=CHUNKS).learn(5)


def observations(n_steps, n_rows, seed=0):
    """Observations of `n_rows` environments, (n_rows, ...) at each step."""
    rng = np.random.default_rng(seed)
    for t in range(n_steps):
        yield {
            "observation": rng.normal(size=(n_rows, 17)).astype(np.float32),
            "return_to_go": np.ones((n_rows, 1), np.float32),
            "timestep": np.full((n_rows, 1), t),
        }


@pytest.fixture
def asked(model, monkeypatch):
    """Rows of hidden states that the head is given, call by call, and the chunks that it makes of them."""
    head, calls = model.policy.acting_network.head, []
    forward = head.forward

    def watched(hidden, noise):
        calls.append(forward(hidden, noise))
        return calls[-1]

    monkeypatch.setattr(head, "forward", watched)
    return calls


def test_the_loss_is_that_of_the_actions_from_each_step_on(cheetah_buffer):
    model = make_model(DT, cheetah_buffer, policy_kwargs=CHUNKS)
    policy = model.policy
    policy.set_training_mode(False)
    ends = th.tensor([40, 41, 2, len(model.buffer) - 2])
    batch = model.buffer.windows(ends, 5, H - 1)
    loss, _ = model.compute_loss(batch)
    plain = model.buffer.windows(ends, 5)
    hidden = policy.network.trunk(**policy.normalization.scale_batch(plain)._asdict())
    predicted = policy.network.head(hidden).view(4, 5, H, 6)
    errors = []
    for row, end in enumerate(ends.tolist()):
        episode_end = next(stop for stop in np.cumsum(model.buffer.episode_lengths) if stop > end) - 1
        for step in range(5):
            if batch.mask[row, step]:
                for ahead in range(H):
                    position = min(end - 4 + step + ahead, episode_end)
                    action = policy.normalization.scale_action(model.buffer.actions[position])
                    errors.append((predicted[row, step, ahead] - action).square().mean())
    th.testing.assert_close(loss, th.stack(errors).mean())


@pytest.mark.parametrize("kv_cache", [False, True])
def test_a_chunk_is_carried_out_before_the_policy_looks_again(model, asked, kv_cache):
    model.policy.set_acting(kv_cache=kv_cache)
    actions, state = [], None
    for t, observation in enumerate(observations(3 * N, 2)):
        action, state = model.predict(observation, state, np.full(2, t == 0), deterministic=True)
        actions.append(action)
    assert len(asked) == 3
    chunks = th.stack(asked).view(3, 2, H, 6)[:, :, :N].clamp(-1, 1)
    np.testing.assert_allclose(np.array(actions), chunks.transpose(1, 2).flatten(0, 1).numpy(), atol=1e-6)


@pytest.mark.parametrize("kv_cache", [False, True])
def test_rows_at_different_places_in_their_chunks_act_as_they_would_alone(model, asked, kv_cache):
    """The second environment is reset at step 4, in the midst of its second chunk."""
    model.policy.set_acting(kv_cache=kv_cache)
    together, alone = [], []
    steps = list(observations(11, 2))
    for row in (None, 0, 1):
        state = None
        for t, observation in enumerate(steps):
            observation = {key: value.copy() for key, value in observation.items()}
            observation["timestep"][1] = t if t < 4 else t - 4
            start = np.array([t == 0, t in (0, 4)])
            if row is not None:
                observation, start = {key: value[[row]] for key, value in observation.items()}, start[[row]]
            action, state = model.predict(observation, state, start, deterministic=True)
            (together if row is None else alone).append(action)
    alone = np.concatenate([np.array(alone[:11]), np.array(alone[11:])], axis=1)
    np.testing.assert_allclose(np.array(together), alone, atol=1e-5)
    assert sorted({len(chunk) for chunk in asked}) == [1, 2]


def test_half_of_a_chunk_is_carried_out_unless_told_otherwise_and_it_is_saved(cheetah_buffer, tmp_path):
    model = make_model(DTFM, cheetah_buffer, policy_kwargs=dict(chunk_size=5)).learn(2)
    assert model.policy.acting_settings()["n_action_steps"] == 3
    model.policy.set_acting(n_action_steps=5)
    model.save(tmp_path / "model")
    loaded = DTFM.load(tmp_path / "model")
    assert (loaded.policy.options.chunk_size, loaded.policy.acting_settings()["n_action_steps"]) == (5, 5)
    observation, _ = make_env().reset(seed=0)
    assert np.array_equal(*(each.predict(observation, deterministic=True)[0] for each in (model, loaded)))
    with pytest.raises(ValueError, match=r"n_action_steps must be a whole number in \[1, 5\], got 6"):
        model.policy.set_acting(n_action_steps=6)
    with pytest.raises(ValueError, match=r"n_action_steps must be a whole number in \[1, 2\], got 3"):
        make_model(DT, cheetah_buffer, policy_kwargs=dict(chunk_size=2, n_action_steps=3))


def test_another_number_of_steps_in_mid_episode_begins_a_new_plan(model, asked):
    state = None
    for t, observation in enumerate(observations(4, 2)):
        model.policy.set_acting(n_action_steps=N if t < 2 else 2)
        _, state = model.predict(observation, state, np.full(2, t == 0), deterministic=True)
    assert len(asked) == 2


def test_without_state_too_when_one_row_asks_again(model):
    """Rows of the contexts before and after the last call, whose plans were of different lengths."""
    first, second = observations(2, 2)
    model.predict(first, deterministic=True)
    model.policy.set_acting(n_action_steps=1)
    model.predict(second, deterministic=True)
    third = {key: np.stack([second[key][0], first[key][1]]) for key in first}
    third["timestep"] = np.array([[1], [2]])
    again, _ = model.predict(third, deterministic=True)
    assert np.isfinite(again).all()


def test_a_question_that_is_asked_again_has_the_same_answer(model):
    """Without `state`, at each place in a chunk."""
    model.policy.reset()
    for observation in observations(2 * N, 2):
        first, again = (model.predict(observation, deterministic=True)[0] for _ in range(2))
        assert np.array_equal(first, again)
