"""The zarr replay buffers of Diffusion Policy: folders and zips, images of bytes or of whole floats, and what is refused."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm import DTFM
from sb3_dtfm.data import DatasetError, load_dataset

zarr = pytest.importorskip("zarr")

ENDS = [3, 8]
N = 8


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return {
        "data/img": rng.integers(0, 256, (N, 8, 8, 3)).astype(np.float32),
        "data/state": rng.uniform(0, 512, (N, 5)).astype(np.float32),
        "data/action": rng.uniform(0, 512, (N, 2)).astype(np.float32),
        "meta/episode_ends": np.array(ENDS),
    }


def write(path, arrays):
    """Format 2, as it was published."""
    root = zarr.open_group(str(path), mode="w", **({"zarr_format": 2} if int(zarr.__version__[0]) > 2 else {}))
    for name, array in arrays.items():
        group, _, member = name.partition("/")
        root.require_group(group)[member] = array
    return path


def load(path, **kwargs):
    with pytest.warns(UserWarning, match="every episode counts as a success"):
        return load_dataset(path, action_bounds=(0, 512), **kwargs)


def test_a_folder_and_a_zip_hold_the_same_episodes(arrays, tmp_path):
    folder = write(tmp_path / "push.zarr", arrays)
    shutil.make_archive(str(folder), "zip", folder)
    shutil.make_archive(str(tmp_path / "from_outside.zarr"), "zip", tmp_path, "push.zarr")
    for path in (folder, tmp_path / "push.zarr.zip", tmp_path / "from_outside.zarr.zip"):
        buffer = load(path)
        assert buffer.episode_lengths.tolist() == [3, 5]
        np.testing.assert_array_equal(buffer.observations.numpy(), arrays["data/state"])
        np.testing.assert_array_equal(buffer.actions.numpy(), arrays["data/action"])
        np.testing.assert_array_equal(buffer.own("img").numpy(), arrays["data/img"].astype(np.uint8))
        assert buffer.rewards.tolist() == [0, 0, 1, 0, 0, 0, 0, 1]
        assert buffer.terminated.all()


def test_actions_outside_of_the_bounds_are_refused_or_clipped(arrays, tmp_path):
    path = write(tmp_path / "push.zarr", {**arrays, "data/reward": np.zeros(N)})
    with pytest.raises(DatasetError, match=r"outside of the action space \[0, 100\]"):
        load_dataset(path, action_bounds=(0, 100))
    assert load_dataset(path, action_bounds=(0, 100), clip_actions=True).actions.max() == 100.0


def test_the_environments_names_and_some_columns(arrays, tmp_path):
    path = write(tmp_path / "push.zarr", arrays)
    buffer = load(path, observation_keys={"pixels": "img", "agent_pos": "state[:2]"}, cache_dir=tmp_path / "cache")
    assert buffer.image_spaces == {"pixels": spaces.Box(0, 255, (8, 8, 3), np.uint8)}
    np.testing.assert_array_equal(buffer.observations.numpy(), arrays["data/state"][:, :2])
    alone = load(path, observation_keys=["img"])
    assert (alone.observations == 0).all()


@pytest.mark.parametrize(("name", "shape"), [("reward", (N,)), ("rewards", (N, 1))])
def test_rewards_and_ends_are_read_where_they_are(name, shape, arrays, tmp_path, recwarn):
    arrays[f"data/{name}"] = np.arange(N, dtype=np.float32).reshape(shape)
    arrays["data/terminals"] = np.eye(1, N, 2)[0]
    arrays["data/timeouts"] = np.eye(1, N, N - 1)[0] > 0
    buffer = load_dataset(write(tmp_path / "push.zarr", arrays), action_bounds=(0, 512))
    assert buffer.rewards.tolist() == list(range(N))
    assert (buffer.terminated.tolist(), buffer.truncated.tolist()) == ([True, False], [False, True])
    assert not [each for each in recwarn if "reward" in str(each.message)]


@pytest.mark.parametrize("images", [True, False])
def test_without_a_state_all_numbers_are_observed(images, arrays, tmp_path):
    parts = {"data/gripper": np.arange(N, dtype=np.uint8)[:, None], "data/robot_eef_pose": arrays.pop("data/state")}
    arrays |= {**parts, "data/timeouts": np.zeros(N, bool), "data/times": np.zeros(3)}
    if not images:
        del arrays["data/img"]
    with pytest.warns(UserWarning, match=r"Not read: times\."):
        buffer = load_dataset(write(tmp_path / "push.zarr", arrays), action_bounds=(0, 512))
    np.testing.assert_array_equal(buffer.observations.numpy(), np.hstack(list(parts.values())))
    assert set(buffer.image_spaces) == ({"img"} if images else set())


def test_beside_a_camera_the_numbers_that_the_environment_shows_are_observed(arrays, tmp_path):
    """An environment of images alone shows no numbers, whatever else was recorded."""
    del arrays["data/state"]
    path = write(tmp_path / "push.zarr", {**arrays, "data/timestamp": np.arange(8.0)[:, None]})
    image = spaces.Box(0, 255, (8, 8, 3), np.uint8)
    for space, expected in ((image, [0.0] * N), (spaces.Dict(img=image, timestamp=spaces.Box(0, 9, (1,))), list(range(N)))):
        with pytest.warns(
            UserWarning, match=r"observed: img(, timestamp)?; not observed: (timestamp|none)\. observation_keys="
        ):
            buffer = load_dataset(path, action_bounds=(0, 512), observation_space=space)
        assert buffer.observations[:, 0].tolist() == expected


def test_successes_are_read(arrays, tmp_path):
    arrays["data/success"] = np.eye(1, N, N - 1)[0]
    buffer = load_dataset(write(tmp_path / "push.zarr", arrays), action_bounds=(0, 512))
    assert buffer.successes.tolist() == [0.0, 1.0]
    assert buffer.episode_returns.tolist() == [0.0, 1.0]
    assert buffer.terminated.tolist() == [False, True]


def test_whole_floats_are_ends_and_a_float_is_an_action_of_one_number(arrays, tmp_path):
    arrays |= {"data/action": arrays["data/action"][:, 0], "meta/episode_ends": np.array(ENDS, float)}
    buffer = load(write(tmp_path / "push.zarr", arrays))
    assert buffer.episode_lengths.tolist() == [3, 5]
    assert buffer.action_space == spaces.Box(0, 512, (1,))
    np.testing.assert_array_equal(buffer.actions[:, 0].numpy(), arrays["data/action"])
    arrays["data/action"] = np.arange(N) % 3
    path = write(tmp_path / "choices.zarr", arrays)
    assert load_dataset(path, action_space=spaces.Box(0, 2, (1,))).actions[:, 0].tolist() == [0, 1, 2, 0, 1, 2, 0, 1]
    assert load_dataset(path, action_space=spaces.Discrete(3)).actions[1].tolist() == [0, 1, 0]


REFUSED = {
    "no pixel": (
        lambda arrays: arrays["data/img"].__setitem__(0, np.nan),
        r"img: images of float32 hold .*; scale them and store uint8, or leave them out with observation_keys=",
    ),
    "nothing to observe": (
        lambda arrays: [arrays.pop(name) for name in ("data/img", "data/state")],
        r"data has nothing to observe, only action\.",
    ),
    "half a pixel": (
        lambda arrays: arrays["data/img"].__setitem__(0, 0.5),
        r"episode 0: img: images of float32 hold others than whole",
    ),
}


@pytest.mark.filterwarnings("error", "ignore:.*every episode counts")
@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_refused_by_name(name, arrays, tmp_path):
    spoil, message = REFUSED[name]
    arrays = {key: array.copy() for key, array in arrays.items()}
    spoil(arrays)
    with pytest.raises(DatasetError, match=message):
        load_dataset(write(tmp_path / "push.zarr", arrays), action_bounds=(0, 512))


def test_chunks_that_are_not_stored_are_told_of(arrays, tmp_path):
    folder = write(tmp_path / "push.zarr", arrays)
    for name in ("action", "state"):
        (folder / "data" / name / "0.0").unlink()
    with pytest.warns(UserWarning, match=r"push\.zarr: state: 1 of 1 chunks are not stored, and count as 0"):
        assert not load(folder).observations.any()


def test_frames_of_the_published_demonstrations_show_the_tool_where_it_is():
    """Five steps of two demonstrations by people (Chi et al., 2023): upright, red first, and at the steps' own places."""
    keys = {"pixels": "img", "agent_pos": "state[:2]"}
    buffer = load(Path(__file__).with_name("pusht.zarr.zip"), observation_keys=keys)
    assert buffer.episode_lengths.tolist() == [3, 2]
    images, positions = buffer.own("pixels").numpy(), buffer.observations.numpy()
    assert (images.shape, images.dtype) == ((5, 96, 96, 3), np.uint8)
    for image, (x, y) in zip(images, positions * 96 / 512, strict=True):
        assert image[round(y), round(x)].tolist() == [78, 126, 255], "the tool is blue"
    assert (images[0, 0, 0] == 255).all()
    seen = buffer.windows(th.tensor([1]), 2).observations["pixels"]
    np.testing.assert_array_equal(seen[0].numpy(), np.moveaxis(images[:2], 3, 1))
    small = dict(embed_dim=8, n_layers=1, n_heads=1, features_extractor_kwargs=dict(channels=(8, 8), features_dim=8))
    model = DTFM("MultiInputPolicy", dataset=buffer, batch_size=4, device="cpu", policy_kwargs=small).learn(1)
    observation = {"observation": positions[0], "pixels": images[0], "return_to_go": np.ones(1), "timestep": np.zeros(1)}
    assert model.action_space.contains(model.predict(observation, deterministic=True)[0])
