"""Which steps the Transformer may see, and that padding changes nothing."""

import pytest
import torch as th

from sb3_dtfm.networks.cache import extend
from sb3_dtfm.networks.trunk import SequenceTrunk, TransformerBlock, causal_mask

B, K, OBSERVATION_DIM, A = 3, 6, 5, 2


def make_trunk(tokens_per_step: int, timestep_embedding: bool, film_return_to_go: bool = False) -> SequenceTrunk:
    th.manual_seed(0)
    sizes = dict(max_timestep=50, embed_dim=16, n_layers=2, n_heads=2, dropout=0.0)
    options = dict(tokens_per_step=tokens_per_step, timestep_embedding=timestep_embedding)
    return SequenceTrunk(OBSERVATION_DIM, A, **sizes, **options, film_return_to_go=film_return_to_go)


@pytest.fixture(params=[3, 1], ids=["3 tokens", "1 token"])
def tokens_per_step(request) -> int:
    return request.param


@pytest.fixture(params=[(True, False), (False, False), (False, True)], ids=["timesteps", "no timesteps", "film"])
def trunk(request, tokens_per_step) -> SequenceTrunk:
    return make_trunk(tokens_per_step, *request.param)


@pytest.fixture
def window() -> dict[str, th.Tensor]:
    generator = th.Generator().manual_seed(1)
    return dict(
        observations=th.randn(B, K, OBSERVATION_DIM, generator=generator),
        actions=th.rand(B, K, A, generator=generator),
        returns_to_go=th.randn(B, K, generator=generator),
        timesteps=th.arange(K).repeat(B, 1),
        mask=th.ones(B, K, dtype=th.bool),
    )


def changed_steps(trunk, window, name, step):
    """Steps whose hidden state changes with the given input."""
    before = trunk(**window)
    moved = {key: value.clone() for key, value in window.items()}
    moved[name][:, step] += 1
    return [k for k in range(K) if not th.allclose(before[:, k], trunk(**moved)[:, k], atol=1e-6)]


@pytest.mark.parametrize("name", ["observations", "returns_to_go"])
def test_a_hidden_state_sees_its_own_step_and_everything_before(trunk, window, name):
    assert changed_steps(trunk, window, name, 2) == [2, 3, 4, 5]


@pytest.mark.parametrize(("timestep_embedding", "changed"), [(True, [2, 3, 4, 5]), (False, [])])
def test_time_steps_are_seen_where_they_have_embeddings(timestep_embedding, changed, tokens_per_step, window):
    assert changed_steps(make_trunk(tokens_per_step, timestep_embedding), window, "timesteps", 2) == changed


def test_an_action_is_seen_from_the_next_step_on(trunk, window):
    assert changed_steps(trunk, window, "actions", 2) == [3, 4, 5]
    assert changed_steps(trunk, window, "actions", K - 1) == []


def test_a_step_is_one_token_of_its_return_to_go_its_observation_and_the_action_before_it(window):
    """No action is known before the oldest step: its token lacks the summand, and not even the bias is in it."""
    trunk = make_trunk(1, timestep_embedding=True)
    th.nn.init.normal_(trunk.embed_action.bias)
    window["mask"] = th.arange(K).repeat(B, 1) >= th.tensor([[0], [2], [K - 1]])
    tokens = trunk.embed(**window)
    assert tokens.shape == (B, K, 16)
    for row, step in window["mask"].nonzero().tolist():
        expected = trunk.embed_return_to_go(window["returns_to_go"][row, step].reshape(1))
        expected = expected + trunk.embed_observation(window["observations"][row, step]) + trunk.embed_timestep.weight[step]
        if step > 0 and window["mask"][row, step - 1]:
            expected = expected + trunk.embed_action(window["actions"][row, step - 1])
        th.testing.assert_close(tokens[row, step], expected)


def test_a_window_has_as_many_tokens_as_it_says(trunk, window):
    assert [trunk.n_tokens(K), trunk.n_tokens(1)] == ([K, 1] if trunk.tokens_per_step == 1 else [3 * K - 1, 2])
    assert trunk.embed(**window).shape[1] == trunk.n_tokens(K)


def test_padding_on_the_left_changes_no_hidden_state(trunk, window):
    short = {key: value[:, -4:] for key, value in window.items()}
    padded = {key: value.clone() for key, value in window.items()}
    for key, value in padded.items():
        value[:, :2] = False if key == "mask" else 7
    assert th.allclose(trunk(**padded)[:, -4:], trunk(**short), atol=1e-6)


def test_a_fully_padded_row_stays_finite(trunk, window):
    window["mask"] = window["mask"].clone()
    window["mask"][0, :-1] = False
    hidden = trunk(**window)
    hidden.sum().backward()
    assert hidden.isfinite().all()
    assert all(parameter.grad is None or parameter.grad.isfinite().all() for parameter in trunk.parameters())


def test_causal_mask_by_hand():
    allowed = causal_mask(th.tensor([[False, True, True]]))[0, 0]
    assert allowed.tolist() == [[True, False, False], [False, True, False], [False, True, True]]


def test_a_return_far_beyond_the_data_leaves_ten_blocks_finite():
    th.manual_seed(0)
    trunk = SequenceTrunk(OBSERVATION_DIM, A, max_timestep=K, embed_dim=256, film_return_to_go=True)
    asked = th.full((1, K), 1e3)  # as much as a policy passes on
    rest = th.randn(1, K, OBSERVATION_DIM), th.zeros(1, K, A)
    assert trunk(*rest, asked, th.arange(K).view(1, K), th.ones(1, K, dtype=th.bool)).isfinite().all()


def test_time_steps_beyond_the_longest_share_the_last_embedding(trunk, window):
    late, later = dict(window), dict(window)
    late["timesteps"] = th.full_like(window["timesteps"], 49)
    later["timesteps"] = th.full_like(window["timesteps"], 4000)
    assert th.equal(trunk(**late), trunk(**later))


def test_every_parameter_gets_a_gradient(trunk, window):
    trunk(**window).square().sum().backward()
    assert [name for name, parameter in trunk.named_parameters() if parameter.grad is None] == []


def test_width_must_be_a_multiple_of_the_heads():
    with pytest.raises(ValueError, match="embed_dim=30 and n_heads=4"):
        SequenceTrunk(OBSERVATION_DIM, A, 10, embed_dim=30, n_heads=4)


def test_the_last_hidden_state_alone_is_the_same(trunk, window):
    window["mask"] = window["mask"].clone()
    window["mask"][0, :3] = False
    assert th.allclose(trunk(**window, last_only=True), trunk(**window)[:, -1:], atol=1e-6)


def test_a_block_gives_each_query_what_it_gives_it_among_all(trunk, window):
    block = trunk.blocks[0]
    tokens, mask = th.randn(B, 7, 16), causal_mask(th.ones(B, 7, dtype=th.bool))
    assert th.allclose(block(tokens, mask, slice(1, None, 3)), block(tokens, mask)[:, 1::3], atol=1e-6)


def keep_extending(trunk, window, n_steps):
    """Hidden states of an episode's steps, each from the tokens that it adds, with a window of K steps."""
    trunk.requires_grad_(False)
    n_new = trunk.tokens_per_step
    kept = th.zeros(len(window["mask"]), trunk.n_layers, 2, trunk.n_tokens(K) - n_new, trunk.embed_dim)
    hidden_states = []
    for step in range(n_steps):
        first = max(0, step + 1 - K)
        pad = K - (step + 1 - first)
        seen = {key: value[:, first : step + 1] for key, value in window.items()}
        padded = {
            key: th.cat((th.zeros_like(value[:, :1].expand(-1, pad, *value.shape[2:])), value), 1)
            for key, value in seen.items()
        }
        keys_values = th.nn.functional.pad(kept, (0, 0, 0, n_new))
        hidden, _ = extend(trunk, **padded, keys_values=keys_values)
        kept = keys_values[:, :, :, n_new:]
        hidden_states.append(hidden)
    return th.stack(hidden_states, dim=1)


def test_kept_keys_and_values_change_nothing_until_the_window_slides(trunk, window):
    assert th.allclose(keep_extending(trunk, window, K), trunk(**window), atol=1e-5)


def test_kept_keys_and_values_are_attention_with_a_band_once_the_window_slides(trunk, monkeypatch):
    """The same as one pass over the whole episode in which each token attends to the last K steps."""
    length = 3 * K
    generator = th.Generator().manual_seed(2)
    episode = dict(
        observations=th.randn(B, length, OBSERVATION_DIM, generator=generator),
        actions=th.rand(B, length, A, generator=generator),
        returns_to_go=th.randn(B, length, generator=generator),
        timesteps=th.arange(length).repeat(B, 1),
        mask=th.ones(B, length, dtype=th.bool),
    )
    extended = keep_extending(trunk, episode, length)
    token = th.arange(trunk.n_tokens(length))
    step, kind = token // trunk.tokens_per_step, token % trunk.tokens_per_step
    reader = step + (kind == 2)  # an action is first read, and computed, with the step after it
    band = (step[None] > reader[:, None] - K).unsqueeze(0).unsqueeze(0)
    plain = causal_mask
    monkeypatch.setattr("sb3_dtfm.networks.trunk.causal_mask", lambda valid: plain(valid) & band)
    assert th.allclose(extended, trunk(**episode), atol=1e-5)


def test_a_single_token_attends_to_itself():
    """The shortcut for one token changes neither the hidden state nor a gradient."""
    block = TransformerBlock(8, 2, 0.0)
    tokens, bias = th.randn(4, 1, 8), th.zeros(4, 2, 1, 1)
    short = block(tokens, None)
    query, key, value = block.attention_in(block.attention_norm(tokens)).split(8, dim=-1)
    full = block.finish(tokens, block.attend(query, key, value, bias))
    assert th.allclose(short, full, atol=1e-6)
    grads = [th.autograd.grad(each.square().sum(), list(block.parameters())) for each in (short, full)]
    for mine, theirs in zip(*grads, strict=True):
        assert th.allclose(mine, theirs, atol=1e-6)


def test_dropout_of_a_single_token_drops_whole_heads():
    block = TransformerBlock(8, 2, 0.5).train()
    heads = block._drop_heads(th.ones(64, 1, 8)).unflatten(-1, (2, -1))
    assert set(heads.flatten().tolist()) == {0.0, 2.0}
    assert th.equal(heads.amin(dim=-1), heads.amax(dim=-1))
