"""Reading Minari datasets that Minari itself has written."""

import io
import json
import shutil
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from packaging.version import Version
from PIL import Image

from sb3_dtfm.data import DatasetError, load_minari
from sb3_dtfm.envs import ReturnToGoWrapper, register_gymnasium_robotics, return_to_go_space

OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (3,), np.float64)
ACTION_SPACE = spaces.Box(-0.4, 0.4, (2,), np.float32)
ENDS = {"terminated": (True, False), "truncated": (False, True), "unfinished": (False, False)}


@pytest.fixture(autouse=True)
def datasets_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))

    def no_network(dataset_id: str) -> None:
        raise ConnectionError("no network in tests")

    monkeypatch.setattr(minari, "download_dataset", no_network)
    monkeypatch.setenv("MINARI_REMOTE", "none://of-tests")
    return tmp_path / "datasets"


def make_episode(n_steps: int, end: str = "truncated", extra: int = 1, seed: int = 0, **changes: Any) -> EpisodeBuffer:
    rng = np.random.default_rng(seed)
    terminated, truncated = ENDS[end]
    arrays: dict[str, Any] = {
        "observations": rng.normal(size=(n_steps + extra, 3)),
        "actions": rng.uniform(-0.4, 0.4, size=(n_steps, 2)).astype(np.float32),
        "rewards": rng.normal(size=n_steps),
        "terminations": np.arange(n_steps) == (n_steps - 1 if terminated else -1),
        "truncations": np.arange(n_steps) == (n_steps - 1 if truncated else -1),
    }
    return EpisodeBuffer(**{**arrays, **changes})


def write(episodes: list[EpisodeBuffer], dataset_id: str = "test/set-v0", **kwargs: Any) -> minari.MinariDataset:
    kwargs = {"observation_space": OBSERVATION_SPACE, "action_space": ACTION_SPACE, **kwargs}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return minari.create_dataset_from_buffers(dataset_id, episodes, **kwargs)


def data_file(dataset: minari.MinariDataset, name: str = "main_data.hdf5") -> Path:
    return Path(dataset.storage.data_path) / name


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_every_episode_comes_back(data_format: str):
    episodes = [
        make_episode(5, "terminated", seed=1),
        make_episode(7, "truncated", seed=2),
        make_episode(3, "unfinished", seed=3),
    ]
    write(episodes, data_format=data_format)
    buffer = load_minari("test/set-v0")
    assert buffer.episode_lengths.tolist() == [5, 7, 3]
    assert buffer.terminated.tolist() == [True, False, False]
    assert buffer.truncated.tolist() == [False, True, False]
    observations = np.concatenate([episode.observations[:-1] for episode in episodes])
    np.testing.assert_array_equal(buffer.observations.numpy(), observations.astype(np.float32))
    np.testing.assert_array_equal(buffer.actions.numpy(), np.concatenate([episode.actions for episode in episodes]))
    assert buffer.episode_returns.tolist() == [np.sum(episode.rewards) for episode in episodes]
    assert "test/set-v0" in buffer.source


@pytest.mark.parametrize("version", ["0.5.3", "0.5.4"])
def test_files_of_either_version_are_read_by_either(version: str):
    path = data_file(write([make_episode(5)]), "metadata.json")
    metadata = {**json.loads(path.read_text()), "minari_version": version, "jpeg_encoding": True}
    path.write_text(json.dumps(metadata))
    np.testing.assert_array_equal(load_minari("test/set-v0").actions.numpy(), make_episode(5).actions)


def test_as_many_observations_as_actions_are_accepted():
    episode = make_episode(6, extra=0)
    buffer = load_minari(write([episode]))
    np.testing.assert_array_equal(buffer.observations.numpy(), episode.observations.astype(np.float32))


def test_infos_are_not_read():
    with_infos = make_episode(4, infos={"position": np.zeros(5)})
    dataset = write([with_infos])
    with h5py.File(data_file(dataset), "a") as file:
        file["episode_0/infos"]["link"] = h5py.SoftLink("/nowhere")
    assert len(load_minari("test/set-v0")) == 4


def test_the_episodes_of_an_opened_dataset_are_the_chosen_ones():
    dataset = write([make_episode(n_steps, seed=n_steps) for n_steps in (2, 3, 4, 5)])
    chosen = dataset.filter_episodes(lambda episode: len(episode.rewards) % 2 == 1)
    assert load_minari(chosen).episode_lengths.tolist() == [3, 5]


def test_goal_dict_is_flattened_as_the_wrapper_does():
    register_gymnasium_robotics()
    env = gym.make("FetchReach-v4")
    wrapped = ReturnToGoWrapper(gym.make("FetchReach-v4"), 0.0)
    observations, vectors = [env.reset(seed=5)[0]], [wrapped.reset(seed=5)[0]["observation"]]
    actions, rewards = [], []
    for _ in range(4):
        actions.append(env.action_space.sample())
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
        vectors.append(wrapped.step(actions[-1])[0]["observation"])
    stacked = {key: np.stack([observation[key] for observation in observations]) for key in reversed(list(observations[0]))}
    episode = EpisodeBuffer(
        observations=stacked, actions=np.stack(actions), rewards=rewards, terminations=[False] * 4, truncations=[False] * 4
    )
    buffer = load_minari(write([episode], env="FetchReach-v4", observation_space=None, action_space=None))
    np.testing.assert_array_equal(buffer.observations.numpy(), np.stack(vectors[:-1]))
    assert return_to_go_space(buffer.observation_space) == wrapped.observation_space


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_nested_spaces_are_flattened_in_sorted_order(data_format: str):
    space = spaces.Dict(z=spaces.Box(-9, 9, (1, 2), np.float64), a=spaces.Tuple([spaces.Discrete(3), spaces.MultiBinary(2)]))
    observations = {
        "z": np.arange(6.0).reshape(3, 1, 2),
        "a": (np.array([2, 0, 1]), np.array([[0, 1], [1, 1], [0, 0]], np.int8)),
    }
    buffer = load_minari(
        write([make_episode(2, observations=observations)], observation_space=space, data_format=data_format)
    )
    assert buffer.observations.tolist() == [[0, 0, 1, 0, 1, 0, 1], [1, 0, 0, 1, 1, 2, 3]]
    assert buffer.observation_space.low.tolist() == [0, 0, 0, 0, 0, -9, -9]


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Pendulum-v1"])
def test_the_space_is_that_of_the_wrapped_environment(env_id: str):
    env = gym.make(env_id)
    n_observations, n_actions = env.observation_space.shape[0], env.action_space.shape[0]
    episode = make_episode(2, observations=np.zeros((3, n_observations)), actions=np.zeros((2, n_actions), np.float32))
    buffer = load_minari(write([episode], env=env_id, observation_space=None, action_space=None))
    assert return_to_go_space(buffer.observation_space) == ReturnToGoWrapper(env, 0.0).observation_space
    assert buffer.action_space == env.action_space


def test_the_normalised_score_uses_the_scale_of_the_metadata():
    reference = load_minari(
        write([make_episode(3)], env="Pendulum-v1", ref_min_score=-10.0, ref_max_score=30.0)
    ).score_reference
    assert reference is not None
    assert (reference.normalize(-10.0), reference.normalize(30.0)) == (0.0, 1.0)
    assert "test/set-v0" in reference.scale
    assert load_minari(write([make_episode(3)], "test/without-v0")).score_reference is None


def test_a_score_scale_without_extent_is_not_used():
    dataset = write([make_episode(3)], env="Pendulum-v1", ref_min_score=5.0, ref_max_score=5.0)
    assert load_minari(dataset).score_reference is None


def test_a_missing_dataset_is_downloaded(datasets_path: Path, monkeypatch: pytest.MonkeyPatch):
    write([make_episode(3)], "test/remote-v0")
    away = datasets_path.parent / "remote"
    (datasets_path / "test" / "remote-v0").rename(away)
    monkeypatch.setattr(minari, "download_dataset", lambda dataset_id: shutil.copytree(away, datasets_path / dataset_id))
    assert len(load_minari("test/remote-v0")) == 3


def test_a_dataset_that_is_nowhere_is_named_with_what_there_is(datasets_path: Path):
    write([make_episode(3)], "test/other-v0")
    with pytest.raises(DatasetError) as caught:
        load_minari("test/missing-v0")
    for part in ("test/missing-v0", "MINARI_DATASETS_PATH", str(datasets_path), "test/other-v0", "no network in tests"):
        assert part in str(caught.value)


@pytest.mark.parametrize("dataset_id", ["no version", "test/set", "test/set-vX"])
def test_a_malformed_id_is_refused(dataset_id: str):
    with pytest.raises(DatasetError, match="namespace/name-vN"):
        load_minari(dataset_id)


def test_a_file_that_was_cut_off_is_named():
    dataset = write([make_episode(500, seed=seed) for seed in range(5)])
    content = data_file(dataset).read_bytes()
    data_file(dataset).write_bytes(content[: len(content) // 2])
    with pytest.raises(DatasetError, match=r"main_data.hdf5.*damaged or incomplete"):
        load_minari("test/set-v0")


def test_zeroed_bytes_in_the_file_are_found():
    dataset = write([make_episode(500, seed=seed) for seed in range(5)])
    content = bytearray(data_file(dataset).read_bytes())
    content[2000:6000] = bytes(4000)
    data_file(dataset).write_bytes(content)
    with pytest.raises(DatasetError, match=r"main_data.hdf5"):
        load_minari("test/set-v0")


@pytest.mark.parametrize("content", [None, "{", json.dumps({"total_steps": 3})])
def test_missing_or_broken_metadata_is_named(content: str | None, datasets_path: Path):
    metadata = data_file(write([make_episode(3)]), "metadata.json")
    metadata.unlink() if content is None else metadata.write_text(content)
    with pytest.raises(
        DatasetError, match=r"test/set-v0.*(does not exist|damaged or incomplete|dataset_id is None)"
    ) as caught:
        load_minari("test/set-v0")
    assert str(datasets_path) in str(caught.value)


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("episode_1", "metadata.json.*total_episodes is 3; there are 2 episodes"),
        ("episode_1/actions", "main_data.hdf5.*episode 1: has no 'actions', only 'observations', 'rewards'"),
    ],
)
def test_a_missing_part_is_named(missing: str, message: str):
    dataset = write([make_episode(3, seed=seed) for seed in range(3)])
    with h5py.File(data_file(dataset), "a") as file:
        del file[missing]
    with pytest.raises(DatasetError, match=message):
        load_minari("test/set-v0")


def test_a_dataset_without_episodes_is_refused():
    write([])
    with pytest.raises(DatasetError, match="holds no episode"):
        load_minari("test/set-v0")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": np.zeros((9, 3))}, "episode 1: holds 9 observations for 5 rewards; 6 or 5 are accepted"),
        ({"observations": np.zeros((6, 2))}, r"episode 1: observations have shape \(6, 2\), expected \(steps, 3\)"),
        ({"actions": np.zeros((4, 2))}, "episode 1: holds 4 actions for 5 rewards"),
        ({"rewards": np.array([0.0, np.nan, 0.0, 0.0, 0.0])}, "episode 1, step 1: rewards hold nan"),
        ({"actions": np.full((5, 2), 0.9)}, "episode 1, step 0: action 0.9"),
    ],
)
def test_wrong_numbers_are_named_with_episode_and_step(changes: dict[str, Any], message: str):
    write([make_episode(3), make_episode(5, **changes)])
    with pytest.raises(DatasetError, match=message):
        load_minari("test/set-v0")


def test_the_environment_is_named_without_being_built(monkeypatch: pytest.MonkeyPatch):
    write([make_episode(3)], env="Pendulum-v1")
    write([make_episode(3)], "test/without-v0")

    def no_environment(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("an environment is built")

    monkeypatch.setattr(gym, "make", no_environment)
    assert load_minari("test/set-v0").env_id == "Pendulum-v1"
    assert load_minari("test/without-v0").env_id is None


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_actions_in_float64_are_read(data_format: str):
    """FrankaKitchen has such an action space."""
    space = spaces.Box(-0.4, 0.4, (2,), np.float64)
    actions = np.random.default_rng(0).uniform(-0.4, 0.4, (5, 2))
    buffer = load_minari(write([make_episode(5, actions=actions)], action_space=space, data_format=data_format))
    assert buffer.action_space == space
    np.testing.assert_array_equal(buffer.actions.numpy(), actions.astype(np.float32))


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (spaces.MultiDiscrete([3, 2]), np.zeros((3, 2), np.int64)),
        (spaces.Box(-1, 1, (2,), np.int64), np.zeros((3, 2), np.int64)),
        (spaces.Box(-np.inf, np.inf, (2,), np.float32), np.zeros((3, 2), np.float32)),
    ],
)
def test_only_bounded_box_actions_are_accepted(space: spaces.Space, actions: np.ndarray):
    dataset = write([make_episode(3, actions=actions)], action_space=space)
    with pytest.raises(DatasetError, match="only a bounded Box"):
        load_minari(dataset)


PICTURES = spaces.Dict(
    {
        "b": spaces.Box(-9, 9, (2,)),
        "hand": spaces.Box(0, 255, (40, 48, 3), np.uint8),
        "first": spaces.Box(0, 255, (3, 40, 48), np.uint8),
        "a": spaces.Box(-9, 9, (1,)),
    }
)


def pictures(n_steps: int) -> dict[str, np.ndarray]:
    """Smooth images, so that JPEG changes them little; rows and columns tell which way up they are."""
    rows, columns = np.mgrid[:40, :48]
    hand = np.stack([np.stack([5 * rows, 5 * columns, np.full_like(rows, 9 * step)], axis=2) for step in range(n_steps + 1)])
    seen = {"hand": hand.astype(np.uint8), "first": np.moveaxis(hand, 3, 1).astype(np.uint8)}
    vectors = {"a": np.arange(n_steps + 1.0)[:, None], "b": np.ones((n_steps + 1, 2))}
    return {**seen, **{name: each.astype(np.float32) for name, each in vectors.items()}}


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_images_come_back_as_minari_itself_reads_them(data_format: str):
    seen = pictures(6)
    dataset = write([make_episode(6, observations=seen)], observation_space=PICTURES, data_format=data_format)
    buffer = load_minari("test/set-v0")
    read = next(iter(dataset)).observations
    for camera in ("first", "hand"):
        np.testing.assert_array_equal(buffer.own(camera), np.reshape(read[camera], (7, *PICTURES[camera].shape))[:6])
        assert np.abs(buffer.own(camera).numpy().astype(int) - seen[camera][:6]).max() < 12, "JPEG, upright"
    assert buffer.own("hand").dtype == buffer.own("first").dtype == th.uint8
    np.testing.assert_array_equal(buffer.observations, np.hstack([seen["a"], seen["b"]])[:6])
    chosen = load_minari("test/set-v0", observation_keys=["b", "hand"])
    assert list(chosen.image_spaces) == ["hand"]
    np.testing.assert_array_equal(chosen.observations, seen["b"][:6])
    assert load_minari("test/set-v0", observation_keys=["hand"]).observations.tolist() == [[0.0]] * 6
    with pytest.raises(
        DatasetError, match=r"observation_keys is \['wrist'\]; the observations have entries a, b, first, hand"
    ):
        load_minari("test/set-v0", observation_keys=["wrist"])


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_images_that_are_stored_as_they_are(data_format: str):
    """By Minari 0.5.4 if it is told to; by 0.5.3 those that are none by its own rule, channels first for example."""
    images = pictures(4)["hand"]
    if Version(minari.__version__) >= Version("0.5.4"):
        space, kwargs = PICTURES["hand"], {"jpeg_encoding": False}
    else:
        images, space, kwargs = np.moveaxis(images, 3, 1), PICTURES["first"], {}
    episode = make_episode(4, observations=images)
    buffer = load_minari(write([episode], observation_space=space, data_format=data_format, **kwargs))
    np.testing.assert_array_equal(buffer.own("image"), images[:4])


def test_damaged_images_are_named():
    dataset = write([make_episode(6, observations=pictures(6))], observation_space=PICTURES)
    with h5py.File(data_file(dataset), "a") as file:
        frames = list(file["episode_0/observations/hand"])
        larger = io.BytesIO()
        Image.fromarray(np.zeros((50, 48, 3), np.uint8)).save(larger, "JPEG")
        others = {kind: io.BytesIO() for kind in ("GIF", "TIFF", "BMP")}
        for kind, content in others.items():
            Image.fromarray(np.zeros((40, 48, 3), np.uint8)).save(content, kind)
    for damage, message in {
        **dict.fromkeys(
            (b"no image", *(content.getvalue() for content in others.values())),
            "episode 0: hand, step 2: cannot be read .*; the image is no JPEG or PNG, or damaged",
        ),
        bytes(frames[2])[:200]: "episode 0: hand, step 2: cannot be read .*(?i:truncated)",
        larger.getvalue(): r"episode 0: hand, step 2: the image is RGB of 50 x 48 pixels, expected \(40, 48, 3\)",
    }.items():
        with h5py.File(data_file(dataset), "a") as file:
            del file["episode_0/observations/hand"]
            found = file.create_dataset("episode_0/observations/hand", (7,), h5py.vlen_dtype(np.uint8))
            for number, frame in enumerate(frames):
                found[number] = np.frombuffer(damage, np.uint8) if number == 2 else frame
        with pytest.raises(DatasetError, match=message):
            load_minari("test/set-v0")


def change_metadata(dataset: minari.MinariDataset, **changes: Any) -> None:
    path = data_file(dataset, "metadata.json")
    metadata = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in metadata.items() if value is not None}))


def test_an_old_dataset_that_does_not_name_its_format_is_read():
    dataset = write([make_episode(4)])
    change_metadata(dataset, data_format=None, minari_version="0.5.0")
    assert load_minari("test/set-v0").episode_lengths.tolist() == [4]


def test_a_dataset_of_a_newer_minari_is_no_damaged_one():
    change_metadata(write([make_episode(4)]), minari_version="99.0.0")
    with pytest.raises(DatasetError, match=r"written by Minari '99.0.0', which .* not read: .*upgrade minari\.$"):
        load_minari("test/set-v0")


@pytest.mark.skipif(Version(minari.__version__) >= Version("0.5.4"), reason="Minari 0.5.4 stores bytes as they are")
@pytest.mark.parametrize("seen", ["vectors", "one image a step"])
def test_vectors_that_minari_stores_as_jpeg_are_named(seen: str):
    """Bytes of shape (T + 1, 6) count as an image; frames that happen to be of one length become a table."""
    observations = np.zeros((5, 6), np.uint8)
    dataset = write([make_episode(4, observations=observations)], observation_space=spaces.Box(0, 255, (6,), np.uint8))
    if seen != "vectors":
        with h5py.File(data_file(dataset), "a") as file:
            frames = np.stack(file["episode_0/observations"][:])
            del file["episode_0/observations"]
            file["episode_0/observations"] = frames
    with pytest.raises(DatasetError, match="episode 0: observations hold JPEG images, as which Minari stores arrays of byt"):
        load_minari(dataset)


def test_a_hub_that_cannot_be_reached_fails_at_once(monkeypatch: pytest.MonkeyPatch):
    """Minari's client would look for it five times, for half a minute."""
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("MINARI_REMOTE", "hf://farama-minari")
    waited = []
    for _ in range(2):  # the first imports the client
        begin = time.monotonic()
        with pytest.raises(DatasetError, match=r"test/none-v0 is not in .*; and it cannot be downloaded: .*refused"):
            load_minari("test/none-v0")
        waited.append(time.monotonic() - begin)
    assert min(waited) < 5.0


def test_entries_of_dictionary_observations_are_chosen():
    space = spaces.Dict({"b": spaces.Box(-9, 9, (2,)), "a": spaces.Discrete(3), "c": spaces.Box(-9, 9, (1,))})
    seen = {"a": np.array([0, 2, 1, 0]), "b": np.zeros((4, 2), np.float32), "c": np.full((4, 1), 5.0, np.float32)}
    for data_format in ("hdf5", "parquet"):
        dataset_id = f"test/{data_format}-v0"
        episode = make_episode(3, observations=seen)
        write([episode], dataset_id, observation_space=space, data_format=data_format)
        np.testing.assert_array_equal(
            load_minari(dataset_id, observation_keys=["c", "a"]).observations, [[5, 1, 0, 0], [5, 0, 0, 1], [5, 0, 1, 0]]
        )
        with pytest.raises(DatasetError, match=r"observation_keys is \['d'\]; the observations have entries a, b, c"):
            load_minari(dataset_id, observation_keys=["d"])
    write([make_episode(3)])
    with pytest.raises(DatasetError, match=r"observation_keys is \['d'\]; the observations have no entries, but Box"):
        load_minari("test/set-v0", observation_keys=["d"])


def test_actions_outside_of_the_space_can_be_clipped():
    write([make_episode(5, actions=np.full((5, 2), 0.9, np.float32))])
    assert load_minari("test/set-v0", clip_actions=True).actions.unique().tolist() == [np.float32(0.4)]
