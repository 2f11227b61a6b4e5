"""Every argument is checked by name, before anything is learned: at construction, and where `load` changes it."""

import inspect
import re

import numpy as np
import pytest
import torch as th

from sb3_dtfm import DT, DTFM
from sb3_dtfm.algorithms.offline import OfflineAlgorithm
from sb3_dtfm.algorithms.options import TrainingOptions
from tests.algorithms.small import make_model
from tests.conftest import make_env

NAN = float("nan")
# For each argument what is refused.
REFUSED = {
    "batch_size": (0, -1, 2.5, True, "16"),
    "context_length": (0, 2.5, True),
    "max_grad_norm": (-1, NAN),
    "warmup_steps": (-5, 2.5),
    "weight_decay": (-1, NAN),
    "learning_rate": (0, -1, NAN),
    "ema_decay": (1.0, -0.1, NAN),
    "return_weighting": (-1.0, float("inf"), NAN),
    "precision": ("float8",),
    "learning_rate_schedule": ("step",),
    "compile": ("yes", 1),
    "seed": (-1, 2.5),
}
REFUSED_OF_THE_POLICY = {
    "embed_dim": (0, 2.5),
    "n_layers": (0, 2.5),
    "n_heads": (0, 2.5),
    "dropout": (1.0, -0.1, NAN),
    "timestep_embedding": ("no", 0),
    "tokens_per_step": (0, 2, 1.0, True),
    "chunk_size": (0, 2.5),
    "n_action_steps": (0, 2, 1.5),
    "clip_return_to_go": ("no", None),
    "return_scaling": ("mean", 1),
    "return_conditioning": ("no", 1),
    "film_return_to_go": ("no", None),
    "observation_scaling": ("mean", True),
    "kv_cache": ("no", 1),
    "expected_return_steps": (-1, 2.5),
}
REFUSED_OF_THE_FLOW = {
    "flow_hidden_dim": (0, 2.5),
    "flow_n_layers": (0, 2.5),
    "flow_steps": (-1, 2.5),
    "flow_tau_exponent": (0, NAN),
    "flow_prediction": ("noise",),
    "flow_solver": ("leapfrog",),
    "regression_coef": (-1, NAN),
    "one_step_policy": ("no", 0),
}
# Options that take one of a few words, which the refusal lists.
CHOICES = {
    "precision": ("auto", "float32", "bfloat16"),
    "learning_rate_schedule": ("constant", "linear", "cosine"),
    "flow_prediction": ("velocity", "action"),
    "flow_solver": ("euler", "midpoint", "heun", "rk4", "one_step"),
}


def pairs(refused):
    return [pytest.param(name, value, id=f"{name}={value}") for name, values in refused.items() for value in values]


def check_refusal(message: str, name: str, value) -> None:
    """The message names the argument, what would be accepted and what was given."""
    assert re.search(rf"\b{name} must .+\bgot {re.escape(repr(value))}", message), message
    assert all(choice in message for choice in CHOICES.get(name, ()))


@pytest.fixture(scope="module")
def saved(cheetah_buffer, tmp_path_factory):
    """A saved model by its algorithm."""
    folder = tmp_path_factory.mktemp("saved")
    for algorithm in (DT, DTFM):
        make_model(algorithm, cheetah_buffer).save(folder / algorithm.__name__)
    return folder


@pytest.mark.parametrize("algorithm", [DT, DTFM])
@pytest.mark.parametrize(("name", "value"), pairs(REFUSED))
def test_an_argument_out_of_range_is_refused(name, value, algorithm, cheetah_buffer):
    with pytest.raises(ValueError, match=name) as refusal:
        make_model(algorithm, cheetah_buffer, **{name: value})
    check_refusal(str(refusal.value), name, value)


@pytest.mark.parametrize(("name", "value"), [pair for pair in pairs(REFUSED) if pair.values != ("learning_rate", 0)])
def test_an_argument_out_of_range_is_refused_at_load(name, value, cheetah_buffer, saved):
    """Also without data, since a model that cannot learn later should say so at once."""
    for kwargs in ({"dataset": cheetah_buffer}, {}):
        with pytest.raises(ValueError, match=name) as refusal:
            DT.load(saved / "DT", **{name: value}, **kwargs)
        check_refusal(str(refusal.value), name, value)


def test_who_only_acts_may_load_a_learning_rate_of_0(cheetah_buffer, saved):
    """As RL-Zoo's enjoy does; nothing can be learned with it."""
    loaded = DT.load(saved / "DT", learning_rate=0, dataset=cheetah_buffer)
    assert np.isfinite(first_action(loaded)).all()
    with pytest.raises(ValueError, match="learning_rate") as refusal:
        loaded.learn(1)
    check_refusal(str(refusal.value), "learning_rate", 0)


def test_an_argument_that_was_changed_by_hand_is_refused_by_learn(cheetah_buffer):
    model = make_model(DT, cheetah_buffer)
    model.batch_size = 0
    with pytest.raises(ValueError, match="batch_size") as refusal:
        model.learn(1)
    check_refusal(str(refusal.value), "batch_size", 0)


@pytest.mark.parametrize(("name", "value"), pairs(REFUSED_OF_THE_POLICY))
def test_an_argument_of_the_policy_out_of_range_is_refused(name, value, cheetah_buffer):
    for algorithm in (DT, DTFM):
        with pytest.raises(ValueError, match=name) as refusal:
            make_model(algorithm, cheetah_buffer, policy_kwargs={name: value})
        check_refusal(str(refusal.value), name, value)


@pytest.mark.parametrize(("name", "value"), pairs(REFUSED_OF_THE_FLOW))
def test_an_argument_of_the_flow_out_of_range_is_refused(name, value, cheetah_buffer):
    with pytest.raises(ValueError, match=name) as refusal:
        make_model(DTFM, cheetah_buffer, policy_kwargs={name: value})
    check_refusal(str(refusal.value), name, value)


@pytest.mark.parametrize(("algorithm", "name"), [(DT, "embed_dims"), (DTFM, "flow_hidden"), (DT, "flow_hidden_dim")])
def test_an_unknown_argument_of_the_policy_is_refused_with_those_accepted(algorithm, name, cheetah_buffer):
    """An option of DTFM alone is unknown to DT."""
    with pytest.raises(ValueError, match=rf"policy_kwargs.*\b{name}\b") as refusal:
        make_model(algorithm, cheetah_buffer, policy_kwargs={name: 64})
    assert ("embed_dims (did you mean embed_dim?) is unknown" in str(refusal.value)) == (name == "embed_dims")
    own = {
        "embed_dim",
        "n_layers",
        "n_heads",
        "dropout",
        "timestep_embedding",
        "tokens_per_step",
        "chunk_size",
        "n_action_steps",
        "return_scaling",
        "return_conditioning",
        "film_return_to_go",
        "observation_scaling",
    }
    flow = {"flow_hidden_dim", "flow_n_layers", "flow_prediction", "flow_solver", "flow_steps", "regression_coef"}
    words = re.findall(r"\w+", str(refusal.value).partition("accepted")[2])
    assert own <= set(words)
    assert flow <= set(words) if algorithm is DTFM else not flow & set(words)


NUMPY = dict(
    batch_size=np.int64(8), context_length=np.int32(4), learning_rate=np.float32(1e-3), weight_decay=np.float64(0.01),
    warmup_steps=np.int64(2), max_grad_norm=np.float32(0.5), ema_decay=np.float64(0.9),
    return_weighting=np.float32(5.0),
)  # fmt: skip
NUMPY_POLICY = dict(
    embed_dim=np.int64(16), n_layers=np.int64(1), n_heads=np.int32(2), dropout=np.float32(0.1),
    timestep_embedding=np.False_, tokens_per_step=np.int64(1), kv_cache=np.True_,
    chunk_size=np.int64(3), n_action_steps=np.int64(2), return_conditioning=np.True_, film_return_to_go=np.True_,
    observation_scaling=np.str_("robust"),
)  # fmt: skip
NUMPY_FLOW = dict(
    flow_hidden_dim=np.int64(16), flow_n_layers=np.int64(1), flow_tau_exponent=np.float32(1.5), flow_steps=np.int64(3),
    regression_coef=np.float64(0.5),
)  # fmt: skip


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_numbers_of_numpy_are_numbers(algorithm, cheetah_buffer, tmp_path):
    """As a search or a grid made with NumPy gives them; the model can be saved, and loaded is what it was."""
    policy_kwargs = NUMPY_POLICY if algorithm is DT else {**NUMPY_POLICY, **NUMPY_FLOW}
    model = make_model(algorithm, cheetah_buffer, **NUMPY, policy_kwargs=policy_kwargs).learn(2)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", dataset=cheetah_buffer)
    for name, value in NUMPY.items():
        assert getattr(loaded, name) == value, name
    assert th.equal(weights(loaded), weights(model))
    assert loaded.learn(1).num_timesteps == 1
    model.policy.save(str(tmp_path / "policy"))
    assert np.array_equal(
        *(first_action(each) for each in (model.policy, type(model.policy).load(str(tmp_path / "policy"))))
    )


@pytest.mark.parametrize("steps", [2.0, np.float64(2), np.int32(2)])
def test_a_number_of_steps_may_be_written_as_a_float(steps, cheetah_buffer, tmp_path):
    """As 1e5, which Stable-Baselines3 takes, too; the model can be loaded."""
    model = make_model(DT, cheetah_buffer).learn(steps)
    model.save(tmp_path / "model")
    assert DT.load(tmp_path / "model").num_timesteps == 2


@pytest.mark.parametrize("steps", [2.5, float("nan"), float("inf"), -1, "2", None, True])
def test_a_number_of_steps_that_is_none_is_refused(steps, cheetah_buffer):
    with pytest.raises(ValueError, match="total_timesteps must be a whole number of at least 0, got"):
        make_model(DT, cheetah_buffer).learn(steps)


def first_action(policy) -> np.ndarray:
    observation, _ = make_env().reset(seed=0)
    return policy.predict(observation, deterministic=True)[0]


def weights(model):
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


@pytest.mark.parametrize("off", [0, 0.0])
def test_no_gradient_norm_is_off(off, cheetah_buffer):
    """Neither clipped to nothing nor turned round: what is learned is what None learns, and not what a bound gives."""
    without, given, clipped = (make_model(DT, cheetah_buffer, max_grad_norm=norm).learn(3) for norm in (None, off, 1e-12))
    assert th.equal(weights(given), weights(without))
    assert not th.equal(weights(clipped), weights(without))


def test_no_warm_up_is_off(cheetah_buffer):
    """The first step already has the whole learning rate."""
    rates = []
    model = make_model(DT, cheetah_buffer, warmup_steps=0, learning_rate=0.5e-3)
    model.learn(1, callback=lambda *_: rates.append(model.policy.optimizer.param_groups[0]["lr"]) is None)
    assert rates == [0.5e-3]


def test_a_schedule_is_a_learning_rate(cheetah_buffer, saved):
    for model in (
        make_model(DT, cheetah_buffer, learning_rate=lambda remaining: 1e-3 * remaining),
        DT.load(saved / "DT", dataset=cheetah_buffer, learning_rate=lambda remaining: 1e-3 * remaining),
    ):
        rates = []
        model.learn(2, callback=lambda *_: rates.append(model.policy.optimizer.param_groups[0]["lr"]) is None)  # noqa: B023
        assert rates == pytest.approx([1e-3, 0.5e-3])


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_help_lists_every_parameter_those_of_policy_and_head_too(algorithm):
    listed = re.findall(r"^:param (\w+): \S", inspect.getdoc(algorithm), re.MULTILINE)
    constructor = set(inspect.signature(algorithm).parameters)
    options = algorithm.policy_aliases["MultiInputPolicy"].parameter_names()
    assert sorted(listed) == sorted([*constructor, *options])
    entries = re.split(r"^:param ", inspect.getdoc(algorithm), flags=re.MULTILINE)
    defaults = {
        entry.partition(":")[0] for entry in entries if re.search(r"\(default: .+\)\s*$", entry.partition("\n\n")[0])
    }
    assert defaults == {*TrainingOptions.defaults(), *options}


def test_the_constructor_takes_each_option_of_training_with_its_default(cheetah_buffer):
    taken = {name: parameter.default for name, parameter in inspect.signature(OfflineAlgorithm).parameters.items()}
    defaults = TrainingOptions.defaults()
    assert [(name, default) for name, default in taken.items() if name in defaults] == list(defaults.items()), "in order"
    given = {name: {int: 2, float: 0.5}.get(type(default), default) for name, default in defaults.items()}
    model = make_model(DT, cheetah_buffer, **given | {"batch_size": 8})
    assert TrainingOptions.of(vars(model)) == TrainingOptions(**given | {"batch_size": 8, "return_weighting": 0.0})


def test_a_misspelt_attribute_is_refused_at_load(saved):
    """Else a model would learn by what the file says, without a word."""
    with pytest.raises(ValueError, match=r"load: bach_size \(did you mean batch_size\?\): no attribute of DT"):
        DT.load(saved / "DT", bach_size=8)
    assert DT.load(saved / "DT", batch_size=8, dataset=None).batch_size == 8
