"""Datasets of Discrete actions, from every reader that may hold some: rows of ones and zeros that tell the choices."""

import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from stable_baselines3 import DQN

from sb3_dtfm.actions import from_vectors
from sb3_dtfm.data import DatasetError, Trajectory, TrajectoryBuffer, load_dataset
from sb3_dtfm.data.inspection import inspect_buffer

SPACE = spaces.Discrete(3, start=-1)
CHOICES = np.array([0, -1, 1, 1, 0])
LENGTHS = (2, 3)


def arrays(**changes):
    """Two episodes, flat."""
    found = {"observations": np.arange(10.0).reshape(5, 2), "actions": CHOICES, "rewards": np.ones(5)}
    return {**found, "episode_lengths": np.array(LENGTHS), **changes}


def episodes(**changes):
    """The same, one by one."""
    flat = arrays(**changes)
    names = ("observations", "actions", "rewards")
    return [{name: np.split(flat[name], [2])[i] for name in names} for i in range(2)]


def written(tmp_path, **changes):
    np.savez(tmp_path / "choices.npz", **arrays(**changes))
    return tmp_path / "choices.npz"


def check(buffer, choices=CHOICES, space=SPACE):
    assert buffer.action_space == space
    assert buffer.actions.shape == (len(choices), space.n)
    rows = buffer.actions.numpy()
    assert np.unique(rows).tolist() == [0.0, 1.0]
    assert (rows.sum(axis=1) == 1.0).all()
    assert from_vectors(rows, space).tolist() == list(choices)


KINDS = {
    "a dictionary": lambda _, **changes: arrays(**changes),
    "npz": written,
    "episodes": lambda _, **changes: episodes(**changes),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("actions", [CHOICES, CHOICES.astype(np.int8), CHOICES[:, None], CHOICES.astype(float)])
def test_choices_are_those_of_the_environment(kind, actions, tmp_path):
    check(load_dataset(KINDS[kind](tmp_path, actions=actions), action_space=SPACE))


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_tell_the_choices_where_there_is_no_environment(kind, tmp_path):
    dataset = KINDS[kind](tmp_path)
    check(load_dataset(dataset, action_bounds=(-1, 1)))
    check(load_dataset(dataset, action_bounds=(-2, 1)), space=spaces.Discrete(4, start=-2))
    with pytest.raises(DatasetError, match=r"expected their number, too: .*action_bounds=\(first, last\)"):
        load_dataset(dataset)
    for bounds in ((-1, 0.5), (-1,), (1, 1), (0, 1e300), ([-1, -1], 1)):
        with pytest.raises(DatasetError, match="smallest and largest action are expected, whole numbers"):
            load_dataset(dataset, action_bounds=bounds)
    with pytest.raises(DatasetError, match=r"Discrete\(1000000000001\); .* 2 to 65,536 actions"):
        load_dataset(dataset, action_bounds=(0, 10**12))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (3, 2, "episode 1, step 1: action 2 is no whole number from -1 to 1"),
        (1, -2, "episode 0, step 1: action -2 is no"),
        (4, 0.5, "episode 1, step 2: action 0.5 is no"),
        (0, np.nan, "episode 0, step 0: actions hold nan"),
    ],
)
def test_other_numbers_are_refused_by_episode_and_step(kind, at, value, message, tmp_path):
    actions = CHOICES.astype(type(value))
    actions[at] = value
    with pytest.raises(DatasetError, match=message) as refusal:
        load_dataset(KINDS[kind](tmp_path, actions=actions), action_space=SPACE)
    assert "choices.npz" in str(refusal.value) or kind != "npz"


@pytest.mark.parametrize("kind", KINDS)
def test_vectors_are_no_choices(kind, tmp_path):
    with pytest.raises(DatasetError, match=r"episode 0: actions have shape \(2, 3\), expected \(2,\)"):
        load_dataset(KINDS[kind](tmp_path, actions=np.eye(3)[CHOICES + 1]), action_space=SPACE)


def test_what_a_buffer_saves_is_what_it_holds(tmp_path):
    buffer = load_dataset(arrays(), action_space=SPACE)
    buffer.save(tmp_path / "saved")
    check(load_dataset(tmp_path / "saved.npz"))
    buffer.select(np.array([1])).save(tmp_path / "part")
    check(load_dataset(tmp_path / "part.npz"), CHOICES[2:])
    both = load_dataset([buffer, str(tmp_path / "part.npz")])
    check(both, [*CHOICES, *CHOICES[2:]])


def test_a_cache_holds_the_same(tmp_path):
    dataset = written(tmp_path)
    for _ in range(2):
        cached = load_dataset(dataset, cache_dir=tmp_path / "cache", action_space=SPACE)
        assert cached.memory_mapped
        check(cached)
    wider = spaces.Discrete(4, start=-2)
    check(load_dataset(dataset, cache_dir=tmp_path / "cache", action_space=wider), space=wider)


def test_d4rls_layout(tmp_path):
    with h5py.File(tmp_path / "choices.hdf5", "w") as file:
        for name, array in arrays().items():
            file[name] = array
    check(load_dataset(tmp_path / "choices.hdf5", action_space=SPACE))


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_minari_writes(data_format, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    ends = {"terminations": [False, True], "truncations": [False, False]}
    numbers = {"observations": np.zeros((3, 4), np.float32), "rewards": [1.0, 1.0]}
    minari.create_dataset_from_buffers(
        "test/choices-v0",
        [EpisodeBuffer(**numbers, actions=[np.int64(1), np.int64(-1)], **ends)] * 2,
        action_space=SPACE, observation_space=spaces.Box(-1.0, 1.0, (4,)), data_format=data_format,
    )  # fmt: skip
    check(load_dataset("test/choices-v0"), [1, -1, 1, -1])


def test_the_replay_buffer_of_dqn():
    model = DQN("MlpPolicy", "CartPole-v1", learning_starts=1000, buffer_size=60, seed=0, device="cpu").learn(50)
    stop = np.flatnonzero(model.replay_buffer.dones[:, 0])[-1] + 1
    with pytest.warns(UserWarning, match="1 unfinished episodes"):
        check(load_dataset(model.replay_buffer), model.replay_buffer.actions[:stop, 0, 0], spaces.Discrete(2))


def test_trajectories():
    one = Trajectory(np.zeros((5, 2)), CHOICES, np.ones(5))
    check(TrajectoryBuffer.from_trajectories([one], SPACE))


def test_what_there_is_to_remark():
    buffer = load_dataset(arrays(), action_bounds=(-3, 2))
    remarks = inspect_buffer(buffer).remarks
    assert remarks[-1] == "Never chosen: -3, -2, 2."
    assert not any("bound" in remark or "change in" in remark for remark in remarks)


@pytest.mark.parametrize("kind", KINDS)
def test_images_in_arrays_stay_images(kind, tmp_path):
    images = np.zeros((5, 8, 8, 3), np.uint8)
    buffer = load_dataset(KINDS[kind](tmp_path, observations=images), action_space=SPACE)
    assert buffer.own("image").shape == images.shape
    for unfit in (images[..., 0], images.astype(np.float32)):
        with pytest.raises(DatasetError, match=r"expected images as uint8 of \(steps, height, width"):
            load_dataset(KINDS[kind](tmp_path, observations=unfit), action_space=SPACE)
    check(load_dataset(KINDS[kind](tmp_path, observations=images[:, :, 0, 0]), action_space=SPACE))
