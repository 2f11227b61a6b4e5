"""The robomimic writer: its layout is robomimic's, and a file is complete or not there."""

import json

import h5py
import numpy as np
import pytest

from sb3_dtfm.data.robomimic import load_robomimic
from sb3_dtfm.recording.episodes import RecordedEpisode
from sb3_dtfm.recording.robomimic import refuse_existing, write_robomimic

WIDTHS = {"robot0_eef_pos": 3, "robot0_eef_quat": 4, "robot0_gripper_qpos": 2, "object": 10}
ENV_ARGS = {"env_name": "Lift", "env_version": "1.5.1", "type": 1, "env_kwargs": {"robots": ["Panda"], "control_freq": 20}}


def make_episode(n_steps: int, seed: int = 0) -> RecordedEpisode:
    rng = np.random.default_rng(seed)
    return RecordedEpisode(
        seed,
        [{key: rng.normal(size=width) for key, width in WIDTHS.items()} for _ in range(n_steps + 1)],
        list(rng.uniform(-1, 1, (n_steps, 7))),
        [0.0] * (n_steps - 1) + [1.0],
        terminated=True,
        states=list(rng.normal(size=(n_steps, 32))),
        model_file="<mujoco/>",
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "demos.hdf5"


def test_written_file_has_robomimics_layout_and_reads_back(path):
    episodes = [make_episode(4 + i, seed=i) for i in range(20)]
    write_robomimic(path, episodes, ENV_ARGS)
    with h5py.File(path) as file:
        data = file["data"]
        assert data.attrs["total"] == sum(len(episode.actions) for episode in episodes)
        assert json.loads(data.attrs["env_args"]) == ENV_ARGS
        demo = data["demo_3"]
        assert demo.attrs["num_samples"] == 7
        assert demo.attrs["model_file"] == "<mujoco/>"
        assert set(demo) == {"obs", "next_obs", "actions", "rewards", "dones", "states"}
        np.testing.assert_array_equal(demo["obs/object"][1:], demo["next_obs/object"][:-1])
        np.testing.assert_array_equal(demo["next_obs/object"][-1], episodes[3].observations[-1]["object"])
        assert demo["dones"][()].tolist() == [0] * 6 + [1]
        masks = {key: {name.decode() for name in file[f"mask/{key}"][()]} for key in file["mask"]}
    assert masks["train"] | masks["valid"] == {f"demo_{i}" for i in range(20)}
    assert not masks["train"] & masks["valid"]
    assert [len(masks[key]) for key in ("train", "valid", "50_percent")] == [18, 2, 10]
    buffer = load_robomimic(path)
    assert buffer.episode_lengths.tolist() == [4 + i for i in range(20)]
    actions = np.concatenate([np.stack(episode.actions) for episode in episodes])
    np.testing.assert_array_equal(buffer.actions, actions.astype(np.float32))
    assert load_robomimic(path, filter_key="50_percent").n_episodes == 10


def test_file_appears_only_when_complete(path):
    def episodes():
        yield make_episode(4)
        assert not path.exists()

    write_robomimic(path, episodes(), ENV_ARGS)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_interrupted_writing_leaves_the_old_file(path):
    def episodes():
        yield make_episode(4)
        raise KeyboardInterrupt

    path.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write_robomimic(path, episodes(), ENV_ARGS)
    assert path.read_text() == "old"
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_existing_file_is_not_overwritten(path):
    path.write_text("old")
    refuse_existing(path, overwrite=True)
    with pytest.raises(FileExistsError, match="exists already; pass overwrite=True"):
        refuse_existing(path, overwrite=False)
    with pytest.raises(FileExistsError, match="is a folder"):
        refuse_existing(path.parent, overwrite=True)
