"""A model's file: what is in it comes back, and what does not belong there is refused by name, at once, and never run."""

import hashlib
import io
import json
import pickle
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch as th
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from stable_baselines3 import SAC
from stable_baselines3.common.save_util import save_to_zip_file
from stable_baselines3.common.utils import LinearSchedule

from sb3_dtfm import DT, DTFM
from sb3_dtfm.algorithms.loading import SAVED
from sb3_dtfm.algorithms.model import ACCEPTED
from sb3_dtfm.algorithms.options import TrainingOptions
from sb3_dtfm.algorithms.saved_options import STRUCTURED
from sb3_dtfm.files import ModelFileError
from sb3_dtfm.finetuning import FinetunedDTFM
from tests.algorithms.small import make_model
from tests.conftest import make_env
from tests.timing import takes_less

RAN = []


def ran():
    """Code that a pickle would run."""
    RAN.append(True)


class RunsCode:
    def __reduce__(self):
        return ran, ()


@pytest.fixture(scope="module")
def saved(cheetah_buffer, tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    make_model(DTFM, cheetah_buffer, ema_decay=0.9, policy_kwargs={"clip_return_to_go": True}).learn(2).save(path)
    return path.read_bytes()


def members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(parts: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, part in parts.items():
            archive.writestr(name, part)
    return buffer.getvalue()


def forged(content: bytes, change, tensors=None, group="policy") -> bytes:
    """
    A file whose author takes care of the digests.

    :param change: of the configuration, in place
    :param tensors: of a group's tensors, in place
    """
    parts = members(content)
    configuration = json.loads(parts["model.json"])
    if tensors is not None:
        values = load_tensors(parts[f"{group}.safetensors"])
        tensors(values)
        parts[f"{group}.safetensors"] = save_tensors(values)
    for name, about in configuration["members"].items():
        about.update(bytes=len(parts[name]), sha256=hashlib.sha256(parts[name]).hexdigest())
    change(configuration)
    parts["model.json"] = json.dumps(configuration).encode()
    return packed(parts)


def refused(content: bytes, tmp_path: Path) -> str:
    """Error that a user reads; soon, and without more memory than some times the file's."""
    path = tmp_path / "model.zip"
    path.write_bytes(content)
    errors = []

    def load() -> None:
        with pytest.raises(ModelFileError) as error:
            DTFM.load(path)
        errors.append(str(error.value))

    assert takes_less(1.0, load)  # before the tracing of memory, which takes longer than the loading
    tracemalloc.start()
    try:
        load()
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()
    assert str(path) in errors[0]
    assert len(set(errors)) == 1
    return errors[0]


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_all_that_training_changes_comes_back(algorithm, cheetah_buffer, tmp_path):
    model = make_model(algorithm, cheetah_buffer, ema_decay=0.9, learning_rate=LinearSchedule(1e-3, 1e-4, 0.5))
    model.learn(3).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    ours, theirs = (each.get_parameters()["policy"] for each in (model, loaded))
    assert ours.keys() == theirs.keys()
    assert all(th.equal(ours[name], theirs[name]) for name in ours)
    ours, theirs = (each.policy.optimizer.state_dict() for each in (model, loaded))
    assert ours["state"].keys() == theirs["state"].keys()
    assert all(th.equal(value, theirs["state"][i][name]) for i in ours["state"] for name, value in ours["state"][i].items())
    assert (loaded.observation_space, loaded.action_space) == (model.observation_space, model.action_space)
    assert (loaded.num_timesteps, loaded._n_updates) == (3, 3)
    assert [loaded.lr_schedule(x) for x in (1.0, 0.9, 0.2)] == [model.lr_schedule(x) for x in (1.0, 0.9, 0.2)]
    assert vars(loaded).keys() == vars(model).keys() - {"_logger"}


def test_a_file_object_is_as_good_as_a_path(cheetah_buffer, tmp_path):
    model = make_model(DT, cheetah_buffer)
    buffer = io.BytesIO()
    model.save(buffer)
    observation, _ = make_env().reset(seed=1)
    assert np.array_equal(DT.load(buffer).predict(observation)[0], model.predict(observation)[0])
    other = make_model(DT, cheetah_buffer, seed=1)
    other.set_parameters(buffer)
    assert np.array_equal(other.predict(observation)[0], model.predict(observation)[0])


def test_a_function_for_the_learning_rate_is_asked_for_again(cheetah_buffer, tmp_path):
    def falling(progress_remaining: float) -> float:
        return 1e-3 * progress_remaining

    make_model(DT, cheetah_buffer, learning_rate=falling).save(tmp_path / "model")
    loaded = DT.load(tmp_path / "model", dataset=cheetah_buffer)
    observation, _ = make_env().reset(seed=1)
    loaded.predict(observation)
    with pytest.raises(ValueError, match=r"learning_rate was the function falling.*load\(path, learning_rate="):
        loaded.learn(1)
    loaded.save(tmp_path / "again")
    assert DT.load(tmp_path / "again", dataset=cheetah_buffer, learning_rate=falling).learn(1).num_timesteps == 1


def test_what_cannot_be_saved_is_left_out_aloud_or_refused_if_asked_for(cheetah_buffer, tmp_path):
    model = make_model(DT, cheetah_buffer)
    model.note = {"of": ["the user's", 1, None]}
    model.controller = {"handle": lambda: None}
    with pytest.warns(UserWarning, match="is no part of a saved model") as warned:
        model.save(tmp_path / "model")
    about = sorted(str(each.message) for each in warned)
    assert "controller is no part of a saved model: it holds a function, not plain values" in about[0]
    assert "note is no part of a saved model: files hold a model's settings" in about[1]
    for name in ("buffer", "note", "controller"):
        with pytest.raises(ValueError, match=f"{name} is no part of a saved model"):
            model.save(tmp_path / "other", include=[name], exclude={"note", "controller"} - {name})
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
    loaded = DT.load(tmp_path / "model")
    assert (hasattr(loaded, "note"), loaded.controller) == (False, None)


class Rewarded(DTFM):
    """A user's, with an argument of its own."""

    bonus = 0.0

    def __init__(self, *args, bonus: float = 0.0, **kwargs):
        self.bonus = bonus
        super().__init__(*args, **kwargs)


class Curious(Rewarded):
    def __init__(self, *args, curiosity: float = 1.0, **kwargs):
        self.curiosity = curiosity
        super().__init__(*args, **kwargs)


def test_arguments_of_a_subclass_come_back_to_it_alone(cheetah_buffer, tmp_path):
    kwargs = dict(dataset=cheetah_buffer, policy_kwargs=dict(embed_dim=8, n_layers=1), device="cpu", bonus=0.5)
    Rewarded("MlpPolicy", **kwargs).save(tmp_path / "model")
    assert Rewarded.load(tmp_path / "model").bonus == 0.5
    assert Curious.load(tmp_path / "model").bonus == 0.5
    with pytest.raises(ModelFileError, match="'bonus' is no attribute that a DTFM is saved with"):
        DTFM.load(tmp_path / "model")
    assert DTFM.load(tmp_path / "model", custom_objects={"bonus": None}).bonus is None
    model = Curious("MlpPolicy", curiosity=2.0, **kwargs)
    model.save(tmp_path / "curious")
    loaded = Curious.load(tmp_path / "curious")
    assert (loaded.bonus, loaded.curiosity) == (0.5, 2.0)
    assert FinetunedDTFM.of(model).policy.action_space == model.action_space


@pytest.mark.parametrize("name", ["tensorboard_log", "env", "dataset", "buffer", "lr_schedule", "not_there"])
def test_what_could_not_be_loaded_is_not_saved(name, cheetah_buffer, tmp_path):
    model = make_model(DT, cheetah_buffer, env=make_env(), tensorboard_log=str(tmp_path))
    model.dataset = "somewhere.npz"
    with pytest.raises(ValueError, match=f"{name} is no part of a saved model"):
        model.save(tmp_path / "model", include=[name])
    assert not (tmp_path / "model.zip").exists()


def test_options_of_the_data_are_saved_or_named(cheetah_buffer, tmp_path):
    model = make_model(DT, cheetah_buffer)
    model.dataset_kwargs = {
        "action_bounds": (np.array([-1.0, -1.0]), 1.0), "env_id": "My\u00a0Env-v0", "observation_keys": ("a", "b"),
        "observation_space": model.observation_space, "env_args": {}, "cache_dir": "here",
    }  # fmt: skip
    with pytest.warns(UserWarning, match="dataset_kwargs: env_args, observation_space: not saved; give"):
        model.save(tmp_path / "model")
    expected = {"action_bounds": [[-1.0, -1.0], 1.0], "env_id": "My\u00a0Env-v0", "observation_keys": ["a", "b"]}
    assert DT.load(tmp_path / "model").dataset_kwargs == expected
    mine = {"observation_space": model.observation_space}
    assert DT.load(tmp_path / "model", custom_objects={"dataset_kwargs": mine}).dataset_kwargs == mine
    model.controller = {"robots": "two\nlines"}
    with pytest.warns(UserWarning, match="controller is no part of a saved model: controller holds .*text without control"):
        model.save(tmp_path / "model", exclude=["dataset_kwargs"])
    assert DT.load(tmp_path / "model").controller is None
    model.controller = None
    model.dataset_kwargs = {"action_bounds": ("-1", "1")}
    with pytest.warns(UserWarning, match="dataset_kwargs is no part of a saved model: dataset_kwargs: action_bounds must"):
        model.save(tmp_path / "model")
    assert getattr(DT.load(tmp_path / "model"), "dataset_kwargs", None) is None


def test_a_policy_of_ones_own_is_asked_for(cheetah_buffer, tmp_path):
    class OwnPolicy(DT.policy_aliases["MultiInputPolicy"]):
        pass

    DT(OwnPolicy, dataset=cheetah_buffer, policy_kwargs=dict(embed_dim=8, n_layers=1), device="cpu").save(tmp_path / "model")
    with pytest.raises(ModelFileError, match=r"its policy is a OwnPolicy.*custom_objects"):
        DT.load(tmp_path / "model")
    assert isinstance(DT.load(tmp_path / "model", custom_objects={"policy_class": OwnPolicy}).policy, OwnPolicy)


def test_custom_objects_take_the_place_of_what_is_in_the_file_alone(saved):
    loaded = DTFM.load(
        io.BytesIO(saved), custom_objects={"learning_rate": 0.0, "lr_schedule": lambda _: 1.0, "clip_range": 1}
    )
    assert loaded.lr_schedule(1.0) == 0.0
    assert not hasattr(loaded, "clip_range")


PICKLED = ("learning_rate", "note")


def test_a_pickled_model_runs_nothing_unless_it_is_trusted(saved, tmp_path):
    """Every attribute of a file of Stable-Baselines3 can hold code, and its own loader runs it."""
    RAN.clear()
    model = DTFM.load(io.BytesIO(saved))
    for name in PICKLED:
        data = {**vars(model), name: RunsCode()}
        for unsaved in (*model._excluded_save_params(), "_means"):
            data.pop(unsaved, None)
        save_to_zip_file(tmp_path / "evil.zip", data, model.get_parameters())
        for load in (DTFM.load, model.set_parameters):
            with pytest.raises(ModelFileError, match=r"evil.zip: data, .*pickled.*allow_pickle=True"):
                load(tmp_path / "evil.zip")
    assert RAN == []
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=1).save(tmp_path / "agent.zip")
    with pytest.raises(ModelFileError, match=r"agent.zip: saved by another algorithm, one of stable_baselines3"):
        DTFM.load(tmp_path / "agent.zip")
    with pytest.raises(ValueError, match=r"policy is SACPolicy, which belongs to another algorithm than DTFM"):
        DTFM.load(tmp_path / "agent.zip", allow_pickle=True)
    data = {key: value for key, value in vars(model).items() if key not in (*model._excluded_save_params(), "_means")}
    save_to_zip_file(tmp_path / "old.zip", data, model.get_parameters())
    trusted = DTFM.load(tmp_path / "old.zip", allow_pickle=True)
    observation, _ = make_env().reset(seed=1)
    assert np.array_equal(trusted.predict(observation)[0], model.predict(observation)[0])


@pytest.mark.parametrize("where", ["attributes", "policy.pkl", "policy.pth", "data"])
def test_a_pickle_hidden_in_a_file_of_ours_is_not_opened(where, saved, tmp_path):
    RAN.clear()
    parts = members(saved)
    if where == "attributes":
        configuration = json.loads(parts["model.json"])
        configuration["attributes"]["note"] = {":type:": "x", ":serialized:": pickle.dumps(RunsCode()).hex()}
        parts["model.json"] = json.dumps(configuration).encode()
        assert "'note' is no attribute" in refused(packed(parts), tmp_path)
    else:
        assert where in refused(packed({**parts, where: pickle.dumps(RunsCode())}), tmp_path)
    assert RAN == []


def set_in(configuration: dict, *keys, value) -> None:
    for key in keys[:-1]:
        configuration = configuration[key]
    configuration[keys[-1]] = value


BAD_CONFIGURATIONS = [
    (("format",), 2, "a newer version"),
    (("format",), "x", "format 'x'"),
    (("algorithm",), "DT", "was saved by 'DT', not by DTFM"),
    (("algorithm",), None, "algorithm is None"),
    (("policy_class",), "os.system", "its policy is a os.system"),
    (("policy_class",), 3, "policy_class is 3"),
    (("observation_space",), "{}", "observation_space is no space"),
    (("observation_space",), '{"type": "Box", "dtype": "O", "shape": [1], "low": [0], "high": [1]}', "observation_space"),
    (("action_space",), '{"type": "Discrete", "n": 3, "start": 0}', "DTFM learns vectors of numbers and not Discrete(3)"),
    (("action_space",), '{"type": "Discrete", "n": 1000000000000, "start": 0}', "action space is Discrete(1000000000000)"),
    (("action_space",), '{"type": "MultiBinary", "n": 3}', "action_space: the action space is MultiBinary(3)"),
    (("action_space",), '{"type":"Box","dtype":"float32","shape":[1],"low":[-Infinity],"high":[Infinity]}', "bounded Box"),
    (("learning_rate",), -1.0, "learning_rate must be"),
    (("learning_rate",), 10**400, "learning_rate must be"),
    (("learning_rate",), {"start": 1, "end": 0, "end_fraction": 0.0}, "expected start, end and end_fraction"),
    (("learning_rate",), {"start": 1}, "expected start, end and end_fraction"),
    (("learning_rate",), {"__class__": 1}, "expected start, end and end_fraction"),
    (("means",), {"n_values": -1, "sums": {}}, "means are"),
    (("means",), {"n_values": 1, "sums": {"loss": "x"}}, "means are"),
    (("means",), {"n_values": 1, "sums": {"rollout/ep_rew_mean": 1.0}}, "of a number of values, by their names"),
    (("attributes",), [], "attributes is []"),
    (("attributes", "predict"), 1, "'predict' is no attribute"),
    (("attributes", "learn"), {}, "'learn' is no attribute"),
    (("attributes", "policy"), {}, "'policy' is no attribute"),
    (("attributes", "context_length"), 0, "context_length must be"),
    (("attributes", "context_length"), 10**12, "context_length must be"),
    (("attributes", "batch_size"), 1.5, "batch_size must be"),
    (("attributes", "num_timesteps"), -1, "num_timesteps must be"),
    (("attributes", "num_timesteps"), 10**400, "num_timesteps must be"),
    (("attributes", "warmup_steps"), 10**300, "warmup_steps must be"),
    (("attributes", "time_limit"), 2**200, "time_limit must be"),
    (("attributes", "policy_kwargs", "expected_return_steps"), 2**63, "expected_return_steps must be"),
    (("attributes", "return_reference"), [0.0, 0.0, 0.0, 10**300, False, None, None], "return_reference"),
    (("attributes", "dataset"), "evil.npz", "'dataset' is no attribute"),
    (("attributes", "tensorboard_log"), "/etc", "'tensorboard_log' is no attribute"),
    (("attributes", "note"), "plain", "'note' is no attribute"),
    (("attributes", "_init_setup_model"), True, "'_init_setup_model' is no attribute"),
    (("attributes", "args"), [], "'args' is no attribute"),
    (("attributes", "__class__"), 1, "'__class__' is no attribute"),
    (("attributes", "\x1b[2J"), 1, r"'\x1b[2J' is no attribute"),
    (("attributes", "n_envs"), 10**12, "n_envs must be"),
    (("attributes", "_training_seed"), "x", "_training_seed must be"),
    (("attributes", "_training_seed"), 2**64, "_training_seed must be"),
    (("attributes", "_stats_window_size"), 10**12, "_stats_window_size must be"),
    (("attributes", "_current_progress_remaining"), 7, "_current_progress_remaining must be"),
    (("attributes", "verbose"), 10**9, "verbose must be"),
    (("attributes", "use_sde"), True, "use_sde must be"),
    (("attributes", "start_time"), "now", "start_time must be"),
    (("attributes", "_n_updates"), None, "_n_updates must be"),
    (("attributes", "max_timestep"), 10**9, "return_to_go_range"),
    (("attributes", "ema_decay"), 2, "ema_decay must be"),
    (("attributes", "policy_kwargs", "embed_dim"), 10**6, "expected float32 of"),
    (("attributes", "policy_kwargs", "embed_dim"), 10**14, "model.zip"),
    (("attributes", "policy_kwargs", "n_layers"), 10**9, "n_layers=1000000000"),
    (("attributes", "policy_kwargs", "n_layers"), 3, "is missing"),
    (("attributes", "policy_kwargs", "chunk_size"), 10**9, "model.zip"),
    (("attributes", "policy_kwargs", "flow_hidden_dim"), 10**7, "expected float32 of"),
    (("attributes", "policy_kwargs", "flow_solver"), "nonsense", "solver must be"),
    (("attributes", "policy_kwargs", "flow_steps"), 10**12, "flow_steps must be"),
    (("attributes", "policy_kwargs", "unheard_of"), 1, "unheard_of is unknown"),
    (("attributes", "score_reference"), "abc", "score_reference is abc"),
    (("attributes", "score_reference"), [2.0, 1.0, "x"], "score_reference is [2.0"),
    (("attributes", "return_reference"), "abc", "return_reference"),
    (("attributes", "return_reference"), 7, "return_reference"),
    (("attributes", "return_reference"), [1.0, "x", 2.0, 3, False, None, None], "return_reference is [1.0, 'x'"),
    (("attributes", "return_reference"), [1.0, 2.0, 2.0, 3, False, 1.5, None], "expected recorded, best_tenth, best, n_"),
    (("attributes", "return_reference"), [1.0, 2.0, 2.0, 3, 0.5, None, None], "expected recorded, best_tenth, best, n_"),
    (("attributes", "controller"), "kp", "controller is 'kp'"),
    (("attributes", "policy_kwargs"), 7, "policy_kwargs"),
    (("attributes", "dataset_kwargs"), {"cache_dir": "/etc"}, "'cache_dir' is no option in a file"),
    (("attributes", "dataset_kwargs"), {"allow_pickle": True}, "'allow_pickle' is no option in a file"),
    (("attributes", "dataset_kwargs"), {"dataset": "/etc/passwd"}, "'dataset' is no option in a file"),
    (("attributes", "dataset_kwargs"), {"action_space": 5}, "'action_space' is no option in a file"),
    (("attributes", "dataset_kwargs"), {"env_args": {"a": 1}}, "'env_args' is no option in a file"),
    (("attributes", "dataset_kwargs"), {"\x1b[2J": 1}, r"'\x1b[2J' is no option in a file"),
    (("attributes", "dataset_kwargs"), {"filter_key": 5}, "filter_key must be text without control characters, or None"),
    (("attributes", "dataset_kwargs"), {"env_id": "\x1b[2J"}, "env_id must be text without control characters, or None"),
    (("attributes", "dataset_kwargs"), {"on_invalid": "x"}, "on_invalid must be one of raise, drop"),
    (("attributes", "dataset_kwargs"), {"episodes": [-1]}, "episodes must be a list of any number of entries, each a whole"),
    (("attributes", "dataset_kwargs"), {"image_size": [84]}, "image_size must be a list of 2 entries"),
    (("attributes", "dataset_kwargs"), {"action_bounds": "x"}, "action_bounds must be a list of 2 entries"),
    (("attributes", "dataset_kwargs"), [], "dataset_kwargs are []"),
    (("attributes", "dataset_kwargs"), {"observation_keys": ["\x1b[2J"]}, "dataset_kwargs holds '\\x1b[2J'; text without"),
    (("attributes", "controller"), {"\x1b[2J": 1}, r"controller: '\x1b[2J' is no setting; accepted: type, output_min"),
    (("attributes", "controller"), {"kp": {"a": 1}}, "controller: kp is {'a': 1}, expected a number, text, or a list"),
    (("attributes", "controller"), {"kp": 10**400}, "controller: kp is 1000"),
    (("attributes", "controller"), {"kp": [[1]]}, "controller: kp is [[1]], expected a number, text, or a list"),
    (("attributes", "controller"), {"robots": "\x1b[2J"}, "controller holds '\\x1b[2J'; text without"),
    (("attributes", "score_reference"), [0.0, 1.0, "\x1b[2J"], "score_reference holds '\\x1b[2J'; text without"),
    (("attributes", "n_episodes"), 10**30, "n_episodes must be"),
    (("attributes", "online_actor"), 5, "online_actor is 5, expected its settings, or None"),
    (("attributes", "dataset_kwargs"), "x", "dataset_kwargs are 'x'"),
    (("attributes", "dataset_kwargs"), {"fraction": "x"}, "dataset_kwargs: fraction must be"),
    (("attributes", "dataset_kwargs"), {"observation_keys": 3}, "observation_keys must be a list of names"),
    (("attributes", "dataset_kwargs"), {"min_return": "x"}, "min_return must be"),
    (("attributes", "seed"), 2**32, "seed must be a whole number in [0, 4294967295], or None"),
    (("members",), {}, "does not describe the members"),
    (("members", "../evil.safetensors"), {"bytes": 1}, "does not describe the members"),
    (("members", "policy.safetensors", "bytes"), 2**60, "bytes"),
    (("members", "policy.safetensors", "sha256"), "0" * 64, "another digest"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "value", "message"), BAD_CONFIGURATIONS, ids=[f"{k[-1]}={v}"[:40] for k, v, _ in BAD_CONFIGURATIONS]
)
def test_a_configuration_that_no_model_has_is_refused(keys, value, message, saved, tmp_path):
    assert message in refused(forged(saved, lambda configuration: set_in(configuration, *keys, value=value)), tmp_path)


def fill(name, value):
    return lambda tensors: tensors[name].fill_(value)


def settings(text):
    def change(tensors):
        (name,) = [name for name in tensors if name.endswith("_extra_state")]
        tensors[name] = th.tensor(list(text.encode()), dtype=th.uint8)

    return change


BAD_TENSORS = {
    "NaN weight": (fill("network.trunk.final_norm.weight", float("nan")), "final_norm.weight holds numbers"),
    "infinite average": (fill("ema_network.trunk.final_norm.bias", float("inf")), "ema_network.trunk.final_norm.bias"),
    "NaN mean": (fill("normalization.observation_mean", float("nan")), "observation_mean holds numbers"),
    "zero deviation": (fill("normalization.observation_std", 0.0), "observation_std must be positive"),
    "negative scale": (fill("normalization.return_scale", -1.0), "return_scale must be positive"),
    "NaN range": (fill("normalization.return_to_go_range", float("nan")), "return_to_go_range"),
    "NaN noise": (fill("noise_table", float("nan")), "noise_table holds numbers"),
    "missing": (lambda tensors: tensors.pop("noise_table"), "noise_table is missing"),
    "extra": (lambda tensors: tensors.update(evil=th.zeros(1)), "evil belongs to no policy"),
    "shape": (lambda tensors: tensors.update(noise_table=th.zeros(3)), "noise_table is torch.float32 of shape (3,)"),
    "type": (lambda tensors: tensors.update(noise_table=tensors["noise_table"].double()), "noise_table is torch.float64"),
    "steps of the solver": (settings('{"flow_steps": 0}'), "flow_steps"),
    "unknown way of acting": (settings('{"__init__": 0}'), "__init__: no way of acting"),
    "no JSON": (settings("{"), "ways of acting"),
    "no object": (settings("3"), "ways of acting"),
}
BAD_STATES = {
    "NaN": (lambda tensors: tensors["0.exp_avg"].fill_(float("nan")), "0.exp_avg holds numbers"),
    "negative square": (lambda tensors: tensors["0.exp_avg_sq"].fill_(-1.0), "negative squares"),
    "other weights": (lambda tensors: tensors.pop("0.step"), "states of"),
    "shape": (lambda tensors: tensors.update({"0.exp_avg": th.zeros(7)}), "0.exp_avg is torch.float32 of shape (7,)"),
}


@pytest.mark.parametrize(
    ("group", "change", "message"),
    [*(("policy", *x) for x in BAD_TENSORS.values()), *(("policy.optimizer", *x) for x in BAD_STATES.values())],
    ids=[*BAD_TENSORS, *(f"optimiser, {name}" for name in BAD_STATES)],
)
def test_tensors_that_no_model_has_are_refused(group, change, message, saved, tmp_path):
    assert message in refused(forged(saved, lambda configuration: None, change, group), tmp_path)


def test_members_that_are_missing_too_many_or_not_what_they_claim_are_refused(saved, tmp_path):
    parts = members(saved)
    for name in parts:
        assert name in refused(packed({key: part for key, part in parts.items() if key != name}), tmp_path)
    assert "notes.txt: nothing of this name" in refused(packed({**parts, "notes.txt": b"hello"}), tmp_path)
    assert "is compressed" in refused(packed(parts, zipfile.ZIP_DEFLATED), tmp_path)
    for text in (b"{", b"[]", b"\xff", b"[" * 10**5, b'{"format": NaN}', b'{"format": 1e999}', b"7" * 5000):
        assert "model.json" in refused(packed({**parts, "model.json": text}), tmp_path)
    claims = struct.pack("<Q", 2**62) + parts["policy.safetensors"][8:]
    forged_header = forged(packed({**parts, "policy.safetensors": claims}), lambda configuration: None)
    assert "policy.safetensors" in refused(forged_header, tmp_path)


def test_what_a_file_was_saved_with_is_printed_without_control_characters(saved, tmp_path, capsys):
    lines = packed({**members(saved), "system_info.txt": b"- OS: Linux\n- \x1b[2J\r"})
    (tmp_path / "model.zip").write_bytes(forged(lines, lambda configuration: None))
    DTFM.load(tmp_path / "model.zip", print_system_info=True)
    assert "- OS: Linux\n- \\x1b[2J\\r\n" in capsys.readouterr().out


def test_a_directory_that_leads_nowhere_is_refused(saved, tmp_path):
    """An offset behind the file's end, and a name that is no UTF-8."""
    end = saved.rindex(b"PK\5\6")
    for offset in (2**31, 2**32 - 2):
        assert "damaged" in refused(saved[: end + 16] + struct.pack("<I", offset) + saved[end + 20 :], tmp_path)
    entry = saved.rindex(b"PK\1\2", 0, saved.rindex(b"system_info.txt"))
    utf8 = saved[: entry + 8] + struct.pack("<H", 0x800) + saved[entry + 10 :]
    name = utf8.rindex(b"system_info.txt")
    assert "damaged" in refused(utf8[:name] + b"\xff" + utf8[name + 1 :], tmp_path)


def test_each_attribute_in_a_file_has_a_rule(saved):
    """So that no file sets what nobody looks at."""
    assert set(json.loads(members(saved)["model.json"])["attributes"]) <= {
        *SAVED,
        *ACCEPTED,
        *TrainingOptions.defaults(),
        *STRUCTURED,
    }


def test_a_cache_folder_is_not_saved(cheetah_buffer, tmp_path):
    cheetah_buffer.save(tmp_path / "data.npz")
    kwargs = {"cache_dir": str(tmp_path / "cache"), "fraction": 0.5}
    make_model(DT, tmp_path / "data.npz", dataset_kwargs=kwargs).save(tmp_path / "model")
    assert DT.load(tmp_path / "model").dataset_kwargs == {"fraction": 0.5}


def test_a_bomb_is_refused_before_it_grows(saved, tmp_path):
    """A thousand times as much as the file, behind the configuration's name or a tensor's."""
    for name in ("model.json", "policy.safetensors"):
        bomb = packed({**members(saved), name: bytes(2**27)}, zipfile.ZIP_DEFLATED)
        assert len(bomb) < 2**22
        assert "is compressed" in refused(bomb, tmp_path)


def test_a_damaged_file_is_refused_whatever_the_damage(saved, tmp_path):
    """Any byte that is changed, and any cut: what loads is what was saved."""
    expected = DTFM.load(io.BytesIO(saved)).get_parameters()["policy"]
    random = np.random.default_rng(0)
    n_loaded = 0
    for number in range(60):
        content = bytearray(saved)
        if number % 3 == 0:
            content = content[: random.integers(len(content))]
        else:
            content[random.integers(len(content))] ^= 1 << random.integers(8)
        (tmp_path / "model.zip").write_bytes(content)
        try:
            model = DTFM.load(tmp_path / "model.zip")
        except ModelFileError:
            continue
        n_loaded += 1  # a date in a header, for example
        assert all(th.equal(values, expected[name]) for name, values in model.get_parameters()["policy"].items())
    assert n_loaded < 20


def test_parameters_of_another_model_are_refused_and_change_nothing(saved, cheetah_buffer, tmp_path):
    (tmp_path / "model.zip").write_bytes(saved)
    model = make_model(DTFM, cheetah_buffer, policy_kwargs={"embed_dim": 64, "n_heads": 1, "clip_return_to_go": True})
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(ModelFileError, match="expected float32 of"):
        model.set_parameters(tmp_path / "model.zip")
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
