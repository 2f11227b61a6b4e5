"""`load_dataset` finds the reader for whatever it is given, and says so when there is none."""

import json
import warnings
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from sb3_dtfm.data import DatasetError, Trajectory, TrajectoryBuffer, load_dataset, readers
from sb3_dtfm.data.cache import Fingerprint
from sb3_dtfm.data.storage import FileStorage

LIFT = {"robot0_eef_pos": 3, "robot0_eef_quat": 4, "robot0_gripper_qpos": 2, "object": 10}


@pytest.fixture(autouse=True)
def datasets_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path


@pytest.fixture
def minari_dataset() -> minari.MinariDataset:
    episode = EpisodeBuffer(
        observations=np.zeros((5, 3)),
        actions=np.zeros((4, 2), np.float32),
        rewards=np.ones(4),
        terminations=np.zeros(4, bool),
        truncations=np.zeros(4, bool),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return minari.create_dataset_from_buffers(
            "test/ones-v0",
            [episode],
            observation_space=spaces.Box(-1.0, 1.0, (3,), np.float64),
            action_space=spaces.Box(-1.0, 1.0, (2,), np.float32),
        )


@pytest.fixture
def robomimic_file(tmp_path: Path) -> Path:
    path = tmp_path / "lift.hdf5"
    env_args = {"env_name": "Lift", "type": 1, "env_version": "1.5.1", "env_kwargs": {}}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = 6
        data.attrs["env_args"] = json.dumps(env_args)
        for name in ("demo_0", "demo_1"):
            demo = data.create_group(name)
            demo.attrs["num_samples"] = 3
            demo["actions"] = np.zeros((3, 7))
            demo["rewards"] = demo["dones"] = np.array([0.0, 0.0, 1.0])
            for key, size in LIFT.items():
                demo[f"obs/{key}"] = np.zeros((3, size))
        file["mask/train"] = np.array([b"demo_1"])
    return path


def test_a_minari_id_is_read(minari_dataset: minari.MinariDataset):
    assert load_dataset("test/ones-v0").episode_returns.tolist() == [4.0]


def test_an_opened_minari_dataset_is_read(minari_dataset: minari.MinariDataset):
    assert load_dataset(minari_dataset).episode_returns.tolist() == [4.0]


@pytest.mark.parametrize("kind", [str, Path])
def test_a_robomimic_path_is_read(kind: type, robomimic_file: Path):
    buffer = load_dataset(kind(robomimic_file))
    assert buffer.episode_returns.tolist() == [1.0, 1.0]
    assert buffer.observation_space.shape == (19,)


def test_a_relative_path_is_read(robomimic_file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(robomimic_file.parent)
    assert load_dataset("lift.hdf5").n_episodes == 2


def test_options_reach_the_reader(robomimic_file: Path):
    buffer = load_dataset(robomimic_file, filter_key="train", observation_keys=["robot0_eef_pos"])
    assert (buffer.n_episodes, buffer.observation_space.shape) == (1, (3,))


def test_a_file_that_is_called_like_a_minari_dataset_is_read(robomimic_file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(robomimic_file.parent)
    robomimic_file.rename("lift-v0")
    assert load_dataset("lift-v0").n_episodes == 2


def test_a_path_in_the_home_folder_is_read(robomimic_file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(robomimic_file.parent))
    assert load_dataset("~/lift.hdf5").n_episodes == 2


def test_a_further_reader_is_one_row_of_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def load_numpy(path: str, scale: float = 1.0, storage: FileStorage | None = None) -> TrajectoryBuffer:
        with np.load(path) as arrays:
            trajectory = Trajectory(arrays["observations"], arrays["actions"], scale * arrays["rewards"])
        return TrajectoryBuffer.from_trajectories([trajectory], spaces.Box(-1.0, 1.0, (1,)), storage=storage)

    def fingerprint_numpy(path: str, options: dict[str, Any]) -> Fingerprint:
        return Fingerprint.of(Path(path).name, Path(path), options)

    row = readers.Reader("the path of a .zip file", lambda name: str(name).endswith(".zip"), load_numpy, fingerprint_numpy)
    monkeypatch.setattr(readers, "READERS", (row, *readers.READERS))
    path = str(tmp_path / "episode.zip")
    with open(path, "wb") as file:
        np.savez(file, observations=np.zeros((3, 2)), actions=np.zeros((3, 1)), rewards=np.ones(3))
    for cache_dir in (None, tmp_path / "cache"):
        buffer = load_dataset(path, cache_dir=cache_dir, scale=2.0, env_id="Own-v0")
        assert (buffer.episode_returns.tolist(), buffer.env_id, buffer.memory_mapped) == (
            [6.0],
            "Own-v0",
            cache_dir is not None,
        )
    with pytest.raises(TypeError, match="unknown option filter_key; accepted: scale, cache_dir, env_id"):
        load_dataset(path, filter_key="train")
    with pytest.raises(DatasetError, match=r"accepted are the path of a .zip file, the path of a file of flat arrays"):
        load_dataset("halfcheetah")


def test_the_environment_is_the_one_that_the_file_names_unless_one_is_given(
    robomimic_file: Path, minari_dataset: minari.MinariDataset
):
    assert load_dataset(robomimic_file).env_id == "robosuite/Lift-v0"
    assert load_dataset(robomimic_file, env_id="Walker2d-v5").env_id == "Walker2d-v5"
    assert load_dataset(minari_dataset).env_id is None
    assert load_dataset(minari_dataset, env_id="Walker2d-v5").env_id == "Walker2d-v5"


def test_an_environment_that_is_given_leaves_the_buffer_as_it_was():
    trajectory = Trajectory(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros(2))
    buffer = TrajectoryBuffer.from_trajectories([trajectory], spaces.Box(-1.0, 1.0, (1,)), env_id="Hopper-v5")
    given = load_dataset(buffer, env_id="Walker2d-v5")
    assert (given.env_id, buffer.env_id) == ("Walker2d-v5", "Hopper-v5")
    assert given.observations is buffer.observations


def test_a_buffer_is_returned_as_it_is():
    trajectory = Trajectory(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros(2))
    buffer = TrajectoryBuffer.from_trajectories([trajectory], spaces.Box(-1.0, 1.0, (1,)))
    assert load_dataset(buffer) is buffer


@pytest.mark.parametrize("name", ["missing.hdf5", "./missing", "~/missing.h5", "../data/missing.hdf5"])
def test_a_missing_file_is_named(name: str):
    with pytest.raises(DatasetError, match=f"{Path(name).name} does not exist"):
        load_dataset(name)


def test_a_missing_file_is_named_before_an_option_that_it_would_not_have():
    with pytest.raises(DatasetError, match=r"missing.hdf5 does not exist; the path of a robomimic file"):
        load_dataset("missing.hdf5", image_size=(8, 8))


@pytest.mark.parametrize("kind", [str, Path])
def test_a_file_of_another_kind_is_refused_with_what_is_accepted(kind: type, tmp_path: Path):
    (tmp_path / "steps.txt").write_text("0 1 2")
    with pytest.raises(DatasetError, match=r"steps.txt'; accepted are the path of .*\.npz.*\.csv"):
        load_dataset(kind(tmp_path / "steps.txt"))


def test_a_folder_is_no_dataset(tmp_path: Path):
    with pytest.raises(DatasetError, match="is a folder"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("dataset", ["halfcheetah", "mujoco/halfcheetah/expert", "", 3, None])
def test_anything_else_is_refused_with_what_is_accepted(dataset: Any):
    with pytest.raises(DatasetError, match=r"accepted are the path of .* a Minari id .* a TrajectoryBuffer"):
        load_dataset(dataset)


def test_an_unknown_option_is_refused_with_those_there_are(robomimic_file: Path, minari_dataset: minari.MinariDataset):
    with pytest.raises(
        TypeError,
        match=r"unknown option filter \(did you mean filter_key\?\); accepted: filter_key, observation_keys, action_b",
    ):
        load_dataset(robomimic_file, filter="train")
    with pytest.raises(TypeError, match="test/ones-v0: unknown option filter_key; accepted: observation_keys, clip_act"):
        load_dataset("test/ones-v0", filter_key="train")


WRONG = {
    "clip_actions": ("no", "one of True, False"),
    "success_only": (1, "one of True, False"),
    "allow_pickle": ("yes", "one of True, False"),
    "env_id": (5, "the id of an environment, or None"),
    "cache_dir": ("", "the path of a folder, or None"),
    "min_return": ("high", "a finite number, or None"),
    "max_episode_steps": (0, "a whole number of at least 1, or None"),
    "observation_keys": ("state", "a list of names, or None"),
    "action_keys": ([1], "a list of names, or None"),
}


@pytest.mark.parametrize("name", WRONG)
def test_options_are_looked_at(name):
    value, accepted = WRONG[name]
    arrays = {"obs": np.zeros((2, 3)), "action": np.zeros((2, 2)), "reward": np.zeros(2), "done": [False, True]}
    with pytest.raises(ValueError, match=rf"{name} must be {accepted}, got {value!r}".replace("[1]", r"\[1\]")):
        load_dataset(arrays, **{name: value})
