"""Flat arrays in one file: what is read, and what is refused."""

import numpy as np
import pytest

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, load_dataset, load_npz

N, STOPS = 9, [2, 5, 9]


def arrays(**changes):
    """Nine steps of three episodes; None leaves an array out."""
    rng = np.random.default_rng(0)
    found = dict(
        observations=rng.normal(size=(N, 3)), actions=rng.uniform(-1, 1, (N, 2)), rewards=np.arange(N, dtype=float),
        episode_ends=np.array(STOPS),
    )  # fmt: skip
    return {name: array for name, array in {**found, **changes}.items() if array is not None}


def write(path, **changes):
    np.savez(path, **arrays(**changes))
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "episodes.npz"


def flags(*steps):
    marked = np.zeros(N, bool)
    marked[list(steps)] = True
    return marked


ENDS = {
    "ends": {},
    "lengths": dict(episode_ends=None, episode_lengths=np.diff(STOPS, prepend=0)),
    "flags of two kinds": dict(episode_ends=None, terminals=flags(1), timeouts=flags(4)[:, None]),
}


@pytest.mark.parametrize("changes", ENDS.values(), ids=ENDS)
def test_episodes_are_what_was_written(changes, path):
    buffer = load_dataset(str(write(path, **changes)))
    expected = arrays()
    assert buffer.episode_lengths.tolist() == [2, 3, 4]
    assert buffer.episode_returns.tolist() == [1.0, 9.0, 26.0]
    np.testing.assert_array_equal(buffer.observations, expected["observations"].astype(np.float32))
    np.testing.assert_array_equal(buffer.actions, expected["actions"].astype(np.float32))
    assert buffer.returns_to_go.tolist() == [1, 1, 9, 7, 4, 26, 21, 15, 8]
    assert buffer.terminated.tolist() == [True, False, False] if "terminals" in changes else [False] * 3


def test_without_rewards_every_episode_is_a_success(path):
    buffer = load_npz(write(path, rewards=None))
    assert buffer.rewards.tolist() == [0, 1, 0, 0, 1, 0, 0, 0, 1]
    assert buffer.terminated.all()


def test_other_names_and_chosen_observations(path):
    extra = np.arange(N * 4.0).reshape(N, 2, 2)
    write(path, observations=None, actions=None, state=np.ones((N, 1)), action=np.zeros((N, 2)), keypoint=extra)
    assert load_npz(path).observation_space.shape == (1,)
    both = load_npz(path, observation_keys=["keypoint", "state"])
    np.testing.assert_array_equal(both.observations, np.hstack([extra.reshape(N, 4), np.ones((N, 1))]))


def test_bounds_of_actions(path):
    write(path, actions=np.linspace(0, 512, 2 * N).reshape(N, 2))
    buffer = load_npz(path, action_bounds=(0, [512, 600]))
    assert buffer.action_space.high.tolist() == [512, 600]
    assert load_npz(path, clip_actions=True).actions.max() == 1.0
    cached = load_dataset(path, cache_dir=path.parent / "cache", action_bounds=(np.zeros(2), np.array([512, 600])))
    assert cached.action_space == buffer.action_space
    with pytest.raises(DatasetError, match=r"episodes.npz, episode 0, step 0: action 30.* outside .*\[-1, 1\]"):
        load_npz(path)
    with pytest.raises(DatasetError, match=r"action_bounds is \(0, 1, 2\); smallest and largest action .* or 2 each"):
        load_npz(path, action_bounds=(0, 1, 2))


REFUSED = {
    "no actions": (dict(actions=None), "has no array one of actions, action, only episode_ends, observations, rewards"),
    "no ends": (dict(episode_ends=None), "does not say where episodes end; one of episode_ends, episode_lengths, term"),
    "ends before the end": (dict(episode_ends=[2, 5]), "episode_ends tells of 5 steps in all; actions have 9"),
    "an empty episode": (dict(episode_ends=[2, 2, 9]), "episode_ends tells of 0 steps in episode 1"),
    "no episode": (dict(episode_ends=np.zeros(0, int)), "episode_ends tells of 0 steps in all"),
    "other length": (dict(rewards=np.zeros(8)), r"rewards has shape \(8,\) and actions have 9 steps"),
    "infinite actions": (dict(actions=np.full((N, 2), np.inf)), "episode 0, step 0: actions hold inf"),
    "NaN": (dict(observations=np.full((N, 3), np.nan)), "episode 0, step 0: observations hold nan"),
    "flat actions": (dict(actions=np.zeros(N)), r"actions have shape \(9,\); \(N, A\) is expected"),
    "words": (dict(rewards=np.array(["good"] * N)), "rewards hold <U4; real numbers are expected"),
    "two rewards": (dict(rewards=np.zeros((N, 2))), "rewards have 2 columns"),
    "pickles": (dict(rewards=np.array([print] * N)), "rewards hold object; real numbers"),
}


@pytest.mark.parametrize(("changes", "message"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused_by_name(changes, message, path):
    with pytest.raises(DatasetError, match=f"episodes.npz.*{message}"):
        load_npz(write(path, **changes), clip_actions=True)


def test_damaged_and_missing_files(path, tmp_path):
    whole = write(path).read_bytes()
    np.savez_compressed(path, **arrays())
    compressed = bytearray(path.read_bytes())
    compressed[150:180] = bytes(30)
    for content in (b"", b"no archive", whole[:-200], compressed):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=r"episodes.npz: .*cannot be read"):
            load_npz(path)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(DatasetError, match=r"episodes.npz: cannot be read .*not a zip file"):
        load_npz(path)
    with pytest.raises(DatasetError, match=r"none.npz does not exist; the path of a file of flat arrays"):
        load_dataset(tmp_path / "none.npz")


def test_a_cache_holds_the_same_and_a_model_learns_from_it(path, tmp_path):
    write(path)
    cached = load_dataset(path, cache_dir=tmp_path / "cache")
    np.testing.assert_array_equal(cached.observations, load_dataset(path).observations)
    options = dict(dataset_kwargs={"observation_keys": ["observations"], "env_id": "Pusher-v5"}, device="cpu")
    model = DT("MultiInputPolicy", dataset=str(path), policy_kwargs=dict(embed_dim=8, n_layers=1), **options).learn(2)
    assert model.buffer.env_id == "Pusher-v5"
