"""Pickles are read on request only."""

import os
import pickle

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, load_dataset

LENGTHS = (3, 5)


class Planted:
    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def objects(parts):
    array = np.empty(len(parts), object)
    array[:] = parts
    return array


def episodes():
    rng = np.random.default_rng(0)
    arrays = {
        "observations": [rng.normal(size=(n + 1, 3)) for n in LENGTHS],
        "actions": [rng.uniform(-1, 1, (n, 2)) for n in LENGTHS],
        "rewards": [np.arange(n) for n in LENGTHS],
    }
    return {name: objects(parts) for name, parts in arrays.items()}


@pytest.mark.parametrize("suffix", [".pkl", ".pickle", ".npz"])
def test_a_pickle_runs_nothing_unless_it_is_allowed(suffix, tmp_path):
    path = tmp_path / f"set{suffix}"
    if suffix == ".npz":
        np.savez(path, **{**episodes(), "actions": objects([Planted(tmp_path / "mark")] * 2)})
    else:
        path.write_bytes(pickle.dumps(Planted(tmp_path / "mark")))
    for options in ({}, {"allow_pickle": False}):
        with pytest.raises(
            DatasetError, match=f"set{suffix}.* a pickle of Python objects, which can run code .*allow_pickle=True"
        ):
            load_dataset(path, **options)
    assert not (tmp_path / "mark").exists()


def test_a_replay_buffer_s_file(tmp_path):
    buffer = ReplayBuffer(10, spaces.Box(-1, 1, (3,)), spaces.Box(-2, 2, (1,)), device="cpu")
    for step in range(6):
        before, after = (np.full((1, 3), 0.1 * number) for number in (step, step + 1))
        buffer.add(before, after, np.array([[0.5]]), np.array([1.0]), np.array([step % 3 == 2]), [{}])
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    read = load_dataset(tmp_path / "buffer.pkl", allow_pickle=True)
    assert read.episode_lengths.tolist() == [3, 3]
    assert read.actions.unique().tolist() == [1.0]
    both = load_dataset([str(tmp_path / "buffer.pkl")] * 2, allow_pickle=True)
    assert both.n_episodes == 4


def test_arrays_of_objects_are_episodes(tmp_path):
    np.savez(tmp_path / "set.npz", **episodes())
    for buffer in (load_dataset(tmp_path / "set.npz", allow_pickle=True), load_dataset(episodes())):
        assert buffer.episode_lengths.tolist() == list(LENGTHS)
        assert buffer.episode_returns.tolist() == [3, 10]
        np.testing.assert_array_equal(buffer.observations[:3], episodes()["observations"][0][:3].astype(np.float32))


def test_a_damaged_pickle_is_named(tmp_path):
    (tmp_path / "set.pkl").write_bytes(b"no pickle")
    with pytest.raises(DatasetError, match=r"set.pkl: cannot be read"):
        load_dataset(tmp_path / "set.pkl", allow_pickle=True)


def test_what_files_of_others_may_hold_allows_no_pickle(tmp_path):
    (tmp_path / "set.pkl").write_bytes(pickle.dumps(Planted(tmp_path / "mark")))
    allowed = {"allow_pickle": True}
    for dataset, options in (
        (tmp_path / "set.pkl", {"dataset_kwargs": allowed}),
        ([{"dataset": str(tmp_path / "set.pkl"), **allowed}], {}),
    ):
        with pytest.raises(DatasetError, match="dataset_kwargs: allow_pickle is accepted by load_dataset alone"):
            DT("MultiInputPolicy", dataset=dataset, device="cpu", **options)
    assert not (tmp_path / "mark").exists()
