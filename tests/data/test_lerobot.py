"""LeRobot's folders: written as its formats 2.1 and 3.0 describe them."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, load_dataset
from sb3_dtfm.data.lerobot import _places
from tests.timing import takes_less

LENGTHS = [3, 5, 4]


def columns(**changes):
    """Three episodes, actions in degrees; None leaves a column out."""
    rng = np.random.default_rng(0)
    n = sum(LENGTHS)
    found = {
        "observation.state": rng.normal(size=(n, 3)), "observation.environment_state": rng.normal(size=(n, 2)),
        "action": rng.uniform(-90, 90, (n, 2)), "timestamp": np.arange(n) / 30,
        "frame_index": np.concatenate([np.arange(length) for length in LENGTHS]),
        "episode_index": np.repeat(np.arange(3), LENGTHS), "index": np.arange(n), "task_index": np.zeros(n, int),
    }  # fmt: skip
    return {name: values for name, values in {**found, **changes}.items() if values is not None}


def write(folder, version="v2.1", info=None, **changes):
    """One file an episode, as in 2.1, or one for all, as in 3.0."""
    found = columns(**changes)
    episodes = found["episode_index"]
    features = {name: {"dtype": str(v.dtype), "shape": list(v.shape[1:]) or [1], "names": None} for name, v in found.items()}
    features["language"] = {"dtype": "string", "shape": [1], "names": None}
    told = {"codebase_version": version, "total_frames": len(episodes), "total_episodes": 3, "fps": 30, "features": features}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({**told, **(info or {})}))
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    for episode in np.unique(episodes) if version == "v2.1" else [None]:
        chosen = np.flatnonzero(episodes == episode) if episode is not None else np.arange(len(episodes))
        table = pa.table({name: list(values[chosen]) for name, values in found.items()})
        name = f"file-{0:03d}" if episode is None else f"episode_{episode:06d}"
        pq.write_table(table, data / f"{name}.parquet")
    return str(folder)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_episodes_are_what_was_written(version, tmp_path):
    found = columns()
    buffer = load_dataset(write(tmp_path / "arm", version))
    assert buffer.episode_lengths.tolist() == LENGTHS
    expected = np.hstack([found["observation.environment_state"], found["observation.state"]])
    np.testing.assert_array_equal(buffer.observations, expected.astype(np.float32))
    np.testing.assert_array_equal(buffer.actions, found["action"].astype(np.float32))
    np.testing.assert_array_equal(buffer.action_space.high, found["action"].max(axis=0).astype(np.float32))
    assert buffer.rewards.tolist() == [0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1]
    assert buffer.terminated.all()
    chosen = load_dataset(tmp_path / "arm", observation_keys=["observation.state"], action_space=spaces.Box(-180, 180, (2,)))
    assert (chosen.observation_space.shape, chosen.action_space.high[0]) == ((3,), 180)
    cached = load_dataset(tmp_path / "arm", cache_dir=tmp_path / "cache", action_bounds=(-90, 90))
    np.testing.assert_array_equal(cached.observations, buffer.observations)
    assert DT("MultiInputPolicy", dataset=str(tmp_path / "arm"), device="cpu").buffer.n_episodes == 3


def test_actions_outside_of_the_bounds_are_refused_or_clipped(tmp_path):
    folder = write(tmp_path / "arm")
    with pytest.raises(DatasetError, match=r"outside of the action space \[-10, 10\]"):
        load_dataset(folder, action_bounds=(-10, 10))
    assert load_dataset(folder, action_bounds=(-10, 10), clip_actions=True).actions.abs().max() == 10.0


def test_rewards_and_successes(tmp_path):
    success = np.zeros(12, bool)
    success[[1, 7]] = True
    buffer = load_dataset(write(tmp_path / "successes", **{"next.success": success}))
    assert buffer.episode_lengths.tolist() == [2, 5, 4]
    assert buffer.episode_returns.tolist() == [1, 1, 0]
    assert buffer.terminated.tolist() == [True, True, False]
    assert buffer.truncated.tolist() == [False, False, True]
    both = {"next.success": success, "next.reward": np.arange(12.0), "next.done": np.ones(12, bool)}
    buffer = load_dataset(write(tmp_path / "both", **both))
    assert buffer.episode_returns.tolist() == [3, 25, 38]
    assert buffer.terminated.tolist() == [False, True, False]
    ended = {"next.reward": np.arange(12.0), "next.done": np.array([0] * 11 + [1], bool)}
    assert load_dataset(write(tmp_path / "ended", **ended)).terminated.tolist() == [False, False, True]
    assert load_dataset(write(tmp_path / "short", reward=np.arange(12.0))).episode_returns.tolist() == [3, 25, 38]


LISTS = {
    "lists of lists": pa.list_(pa.list_(pa.float32())),
    "large lists": pa.large_list(pa.large_list(pa.float32())),
    "lists of one size": pa.list_(pa.list_(pa.float32(), 2), 4),
    "tensors": pa.fixed_shape_tensor(pa.float32(), (4, 2)),
}


@pytest.mark.parametrize("kind", LISTS)
def test_all_axes_of_a_feature_are_observed(kind, tmp_path):
    keypoints = np.arange(96, dtype=np.float32).reshape(12, 4, 2)
    path = write(tmp_path / "arm", "v3.0", **{"observation.state": None, "observation.environment_state": keypoints[:, 0]})
    (file,) = (tmp_path / "arm" / "data" / "chunk-000").iterdir()
    is_tensor = isinstance(LISTS[kind], pa.FixedShapeTensorType)
    array = (
        pa.FixedShapeTensorArray.from_numpy_ndarray(keypoints) if is_tensor else pa.array(keypoints.tolist(), LISTS[kind])
    )
    table = pq.read_table(file).drop_columns("observation.environment_state")
    pq.write_table(table.append_column("observation.environment_state", array), file)
    np.testing.assert_array_equal(load_dataset(path).observations, keypoints.reshape(12, 8))


@pytest.mark.parametrize("dtype", ["uint8", "int8", "int16", "uint16", "uint32", "uint64"])
def test_whole_numbers_of_any_size_are_observed(dtype, tmp_path):
    touch = {"observation.touch": np.arange(12, dtype=dtype), "observation.state": None}
    info = json.loads((Path(write(tmp_path / "arm", **touch)) / "meta" / "info.json").read_text())
    info["features"]["observation.note"] = {"dtype": "string", "shape": [1], "names": None}
    info["features"]["observation.depth"] = {"dtype": "uint16", "shape": [480, 640], "names": None}
    (tmp_path / "arm" / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.warns(
        UserWarning, match=r"arm: neither vectors nor images, and not read: observation\.note \(string\), observation"
    ):
        buffer = load_dataset(tmp_path / "arm")
    assert buffer.observations[:, 2].tolist() == list(range(12))


@pytest.mark.parametrize("episodes", [1, "12", [0.5], ["a"], [[1]], [-1]])
def test_episodes_that_are_no_list_of_numbers(episodes, tmp_path):
    with pytest.raises(ValueError, match=rf"episodes must be a list of whole .*, or None, got {re.escape(repr(episodes))}"):
        load_dataset(write(tmp_path / "arm", **{"next.reward": np.zeros(12)}), episodes=episodes)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_some_of_the_episodes(version, tmp_path):
    path = write(tmp_path / "arm", version)
    whole = load_dataset(path)
    chosen = load_dataset(path, episodes=[2, 0])
    assert chosen.episode_lengths.tolist() == [4, 3]
    np.testing.assert_array_equal(chosen.observations, np.r_[whole.observations[8:], whole.observations[:3]])
    with pytest.raises(DatasetError, match="arm: there is no episode 3, only 0 to 2"):
        load_dataset(path, episodes=[3])


def test_the_time_to_find_episodes_grows_with_their_number_alone():
    numbers = np.arange(200_000.0)
    assert _places(range(len(numbers)), numbers, "arm") == list(range(len(numbers)))
    assert takes_less(2.0, lambda: _places(range(len(numbers)), numbers, "arm"))


def test_without_rewards_it_is_said_what_counts(tmp_path):
    with pytest.warns(
        UserWarning, match=r"arm: there is no feature next.reward or reward of numbers, .* every episode counts as a success"
    ):
        load_dataset(write(tmp_path / "arm"))
