"""Whatever comes in: finite actions inside the space, or an error that names key and row and has changed nothing."""

import numpy as np
import pytest

from sb3_dtfm import DT, DTFM
from sb3_dtfm.policies.context import Context
from tests.algorithms.small import make_model

N_ROWS, SICK = 3, 1
WAYS = [dict(), dict(kv_cache=True), dict(kv_cache=True, tokens_per_step=1, chunk_size=4, n_action_steps=3)]


@pytest.fixture(params=WAYS, ids=["window", "kv-cache", "kv-cache-of-one-token-and-chunks"])
def model(request, cheetah_buffer):
    return make_model(DT, cheetah_buffer, policy_kwargs=request.param)


def observe(t: int, n_rows: int = N_ROWS) -> dict[str, np.ndarray]:
    """Observations of `n_rows` environments at a time step."""
    return {
        "observation": np.random.default_rng(t).normal(size=(n_rows, 17)).astype(np.float32),
        "return_to_go": np.full((n_rows, 1), 5.0 - t, np.float32),
        "timestep": np.full((n_rows, 1), t),
    }


def spoil(observation, key: str, value, dtype=None) -> dict[str, np.ndarray]:
    """The same with another number in one row."""
    array = observation[key].astype(dtype or np.result_type(observation[key], type(value)))
    array[SICK, -1] = value
    return {**observation, key: array}


UNFIT = [
    ("observation", np.nan, np.float32, "finite"),
    ("observation", -np.inf, np.float64, "finite"),
    ("observation", 1e300, np.float64, "finite"),
    ("return_to_go", np.nan, np.float32, "finite"),
    ("return_to_go", np.inf, np.float32, "finite"),
    ("timestep", np.nan, np.float64, "whole"),
    ("timestep", np.inf, np.float32, "whole"),
    ("timestep", 2.5, np.float64, "whole"),
    ("timestep", -1, np.int64, "whole"),
    ("timestep", 10**18, np.int64, "whole"),
    ("timestep", np.iinfo(np.int64).max, np.int64, "whole"),
    ("timestep", 2**64 - 1, np.uint64, "whole"),
    ("timestep", 1e18, np.float64, "whole"),
]


@pytest.mark.filterwarnings("error")
def test_an_unfit_number_is_refused_by_key_and_row(model):
    for key, value, dtype, accepted in UNFIT:
        with pytest.raises(ValueError, match=rf"{key}'\] .*{accepted}.*row {SICK} holds"):
            model.predict(spoil(observe(0), key, value, dtype))


@pytest.mark.parametrize("key", ["observation", "return_to_go", "timestep"])
@pytest.mark.parametrize("passes_state", [True, False])
def test_a_question_that_was_refused_has_changed_nothing(key, passes_state, model):
    """The caller mends the row and asks again: all rows act as if the first question had never been asked."""

    def act(is_sick: bool) -> np.ndarray:
        actions, state = [], None
        model.policy.reset()
        for t in range(8):
            given = dict(state=state, episode_start=np.full(N_ROWS, t == 0)) if passes_state else {}
            if is_sick and t in (0, 5):
                with pytest.raises(ValueError, match=f"row {SICK} "):
                    model.predict(spoil(observe(t), key, np.nan, np.float32), deterministic=True, **given)
            action, state = model.predict(observe(t), deterministic=True, **given)
            actions.append(action)
        return np.array(actions)

    assert np.array_equal(act(is_sick=True), act(is_sick=False))


@pytest.mark.parametrize("key", ["observation", "return_to_go", "timestep"])
@pytest.mark.parametrize(
    "unfit", [np.full((N_ROWS, 1), "1.0"), np.full((N_ROWS, 1), None), np.full((N_ROWS, 1), 1j), [[1.0], [1.0, 2.0]], "1"]
)
def test_what_is_no_array_of_numbers_is_refused_by_key(key, unfit, model):
    with pytest.raises(ValueError, match=rf"observation\['{key}'\] must be an array of numbers"):
        model.predict({**observe(0), key: unfit})


def test_many_unfit_rows_are_counted(model):
    observation = observe(0, 9)
    observation["observation"][2:] = np.nan
    with pytest.raises(ValueError, match=r"row 2 holds nan at \[0\].*row 6 holds.*and 2 more rows"):
        model.predict(observation)


@pytest.mark.parametrize("key", ["observation", "return_to_go", "timestep"])
def test_numbers_of_any_type_are_the_same_numbers(key, model):
    whole = {name: np.ones_like(array) for name, array in observe(0).items()}
    expected, _ = model.predict(whole, episode_start=np.ones(N_ROWS, bool), deterministic=True)
    for given in (whole[key].astype(dtype) for dtype in (bool, np.uint8, np.int32, np.float16, np.float64, ">f4")):
        action, _ = model.predict({**whole, key: given}, episode_start=np.ones(N_ROWS, bool), deterministic=True)
        assert np.array_equal(action, expected)


@pytest.mark.parametrize("algorithm", [DT, DTFM])
@pytest.mark.parametrize(
    "policy_kwargs", [dict(), dict(return_scaling="timestep", film_return_to_go=True, tokens_per_step=1)]
)
def test_huge_numbers_have_finite_actions_inside_the_space(algorithm, policy_kwargs, cheetah_buffer):
    model = make_model(algorithm, cheetah_buffer, policy_kwargs=policy_kwargs)
    largest = np.finfo(np.float32).max
    for kv_cache in (False, True):
        model.policy.set_acting(kv_cache=kv_cache)
        state = None
        for t, (value, return_to_go) in enumerate([(1e30, 5), (0, 1e30), (largest, largest), (-largest, -largest), (0, 5)]):
            observation = {**observe(t), "return_to_go": np.full((N_ROWS, 1), return_to_go)}
            actions, state = model.predict(spoil(observation, "observation", value), state, np.full(N_ROWS, t == 0))
            assert all(model.action_space.contains(action) for action in actions)
    last = {
        **observe(0),
        "timestep": np.full((N_ROWS, 1), np.iinfo(np.int32).max),
        "return_to_go": np.full((N_ROWS, 1), 1e30),
    }
    assert np.isfinite(model.predict(last, episode_start=np.ones(N_ROWS, bool))[0]).all()


@pytest.mark.parametrize("field", ["observations", "actions", "returns_to_go", "plan", "keys_values"])
@pytest.mark.parametrize("restarts_by", ["episode_start", "timestep"])
def test_a_row_that_restarts_drops_whatever_it_held(field, restarts_by, model):
    """Also NaN, which a mask does not hide. The other rows go on as they would have, and the state stays as it was."""
    state = None
    for t in range(4):
        _, state = model.predict(observe(t), state, np.full(N_ROWS, t == 0), deterministic=True)
    held = {name: array.copy() for name, array in zip(Context._fields, state, strict=True)}
    if held[field].size == 0:
        pytest.skip("This way of acting keeps none.")
    held[field][SICK] = np.nan
    copies = [array.copy() for array in held.values()]

    def go_on(state) -> np.ndarray:
        actions = []
        for t in range(4, 12):
            observation, episode_start = observe(t), np.zeros(N_ROWS, bool)
            if restarts_by == "timestep":
                observation["timestep"][SICK] -= 4
            else:
                episode_start[SICK] = t == 4
            action, state = model.predict(observation, state, episode_start, deterministic=True)
            actions.append(action)
        return np.array(actions)

    expected = go_on(state)
    assert np.isfinite(expected).all()
    assert np.array_equal(go_on(tuple(held.values())), expected)
    assert all(np.array_equal(array, copy, equal_nan=True) for array, copy in zip(held.values(), copies, strict=True))


def test_padding_is_zero_after_a_restart_too(cheetah_buffer):
    model = make_model(DT, cheetah_buffer)
    state = None
    for t in range(4):
        _, state = model.predict(observe(t), state, np.full(N_ROWS, t in (0, 3)))
    padded = ~Context(*state).mask
    assert padded.sum() == N_ROWS * 4
    assert all(not array[padded].any() for array in state[:4])


@pytest.mark.parametrize("field", ["observations", "actions", "returns_to_go", "keys_values"])
def test_a_state_that_holds_no_finite_numbers_is_refused_by_row(field, cheetah_buffer):
    model = make_model(DT, cheetah_buffer, policy_kwargs=dict(kv_cache=field == "keys_values"))
    _, state = model.predict(observe(0), episode_start=np.ones(N_ROWS, bool))
    held = Context(*(array.copy() for array in state))
    getattr(held, field)[SICK] = np.nan
    with pytest.raises(ValueError, match=f"row {SICK}: state holds NaN or infinity in {field}.*episode_start"):
        model.predict(observe(1), tuple(held), deterministic=True)


def test_weights_that_give_no_finite_action_are_named(cheetah_buffer):
    model = make_model(DT, cheetah_buffer)
    model.policy.network.head.linear.bias.data[0] = float("nan")
    with pytest.raises(ValueError, match=r"row 0, 1, 2: the policy's weights give none"):
        model.predict(observe(0))


def test_what_is_no_state_is_refused_by_its_part(model):
    observation = observe(1)
    _, state = model.predict(observe(0), episode_start=np.ones(N_ROWS, bool))
    named = Context(*state)
    unfit = {
        "9 arrays; got a tuple of 2": state[:2],
        "9 arrays; got a ndarray": state[0],
        "observations of type NoneType": named._replace(observations=None),
        "keys_values of type NoneType": named._replace(keys_values=None),
        "actions of type float64; an array of float32": named._replace(actions=named.actions.astype(np.float64)),
        r"observations of shape \(3, 5, 16\); \(3, 5, 17\)": named._replace(observations=named.observations[..., 1:]),
        r"actions of shape \(3, 4, 6\); \(3, 5, 6\)": named._replace(actions=named.actions[:, 1:]),
        r"mask of shape \(2, 5\); \(3, 5\)": named._replace(mask=named.mask[:2]),
        r"plan of shape \(2,": named._replace(plan=named.plan[:2]),
        r"keys_values of shape \(1,": named._replace(keys_values=named.keys_values[:1]),
    }
    for message, given in unfit.items():
        with pytest.raises(ValueError, match=f"state .*{message}"):
            model.predict(observation, given)
    with pytest.raises(ValueError, match=r"episode_start has shape \(2,\); \(3,\) is expected"):
        model.predict(observation, state, np.zeros(2, bool))
    with pytest.raises(ValueError, match=r"\(0, 17\).*\(n_envs, 17\)"):
        model.predict({key: array[:0] for key, array in observation.items()})
