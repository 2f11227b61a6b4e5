"""Short episodes are read together, and are what they are one by one."""

import numpy as np
import pytest

from sb3_dtfm.data import DatasetError, Trajectory, TrajectoryBuffer, load_dataset
from sb3_dtfm.data.short_episodes import LONG, blocks
from sb3_dtfm.data.storage import STEP_ARRAYS
from tests.timing import takes_less

# Short ones of several lengths, beside and between long ones.
LENGTHS = np.array([3, 1, 1, 63, 64, 2, 200, 65, 1, 5, 5, 3])


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    n_steps, stops = LENGTHS.sum(), LENGTHS.cumsum()
    ends = np.zeros((2, n_steps), bool)
    ends[0, stops[::2] - 1], ends[1, stops[1::2] - 1] = True, True
    observations = rng.normal(size=(n_steps, 3))
    observations[:, 1] = 1e6  # constant beside its size
    return {
        "observations": observations.astype(np.float32),
        "actions": rng.uniform(-1, 1, (n_steps, 2)).astype(np.float32),
        "rewards": rng.normal(size=n_steps).astype(np.float32),
        "terminals": ends[0],
        "timeouts": ends[1],
        "success": np.where(np.arange(len(LENGTHS)) % 3, np.arange(len(LENGTHS)) % 2, np.nan),
    }


def one_by_one(arrays, space):
    stops = LENGTHS.cumsum()
    return TrajectoryBuffer.from_trajectories(
        [
            Trajectory(
                arrays["observations"][start:stop],
                arrays["actions"][start:stop],
                arrays["rewards"][start:stop],
                terminated=bool(arrays["terminals"][stop - 1]),
                truncated=bool(arrays["timeouts"][stop - 1]),
                success=None if np.isnan(success) else bool(success),
            )
            for start, stop, success in zip(stops - LENGTHS, stops, arrays["success"], strict=True)
        ],
        space,
    )


def test_the_buffer_is_that_of_the_episodes_one_by_one(arrays):
    together = load_dataset(arrays)
    expected = one_by_one(arrays, together.action_space)
    for name in STEP_ARRAYS:  # to the bit: a replayed episode shows these returns-to-go
        np.testing.assert_array_equal(getattr(together, name), getattr(expected, name))
    for name, ours, theirs in zip(together.episodes._fields, together.episodes, expected.episodes, strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12, err_msg=name)
    assert not together.episodes.observation_squares[:, 1].any()


def test_blocks_are_of_short_episodes_and_miss_none():
    found = list(blocks(LENGTHS.cumsum()))
    assert [index for first, end in found for index in range(first, end)] == list(range(len(LENGTHS)))
    for first, end in found:
        assert end - first == 1 or (LENGTHS[first:end] < LONG).all()
    assert (0, 4) in found
    assert (8, 12) in found


@pytest.mark.parametrize("episode", [1, 9])
def test_a_bad_episode_is_named_or_left_out(arrays, episode):
    step = LENGTHS.cumsum()[episode] - 1
    arrays["observations"][step, 2] = np.nan
    with pytest.raises(DatasetError, match=rf"episode {episode}, step {LENGTHS[episode] - 1}: observations hold nan"):
        load_dataset(arrays)
    with pytest.warns(UserWarning, match=f"1 of {len(LENGTHS)} episodes have been dropped.*episode {episode}"):
        kept = load_dataset(arrays, on_invalid="drop")
    assert kept.episode_lengths.tolist() == np.delete(LENGTHS, episode).tolist()


def test_returns_to_go_of_each_episode_have_to_be_finite(arrays):
    """Together with the episode behind it, the first one's would be."""
    arrays["rewards"] = arrays["rewards"].astype(np.float64)
    arrays["rewards"][:6] = [0.0, 3e38, 3e38, 0.0, -3e38, -3e38]
    with pytest.raises(DatasetError, match="episode 0, step 0: returns-to-go, sums of rewards,"):
        load_dataset(arrays)


def test_a_million_episodes_of_one_step_are_read_in_seconds(tmp_path):
    n = 1_000_000
    np.savez(tmp_path / "bandit.npz", observations=np.zeros((n, 2), np.float32), actions=np.zeros((n, 1), np.float32),
             rewards=np.ones(n, np.float32), terminals=np.ones(n, bool))  # fmt: skip
    buffers = []
    assert takes_less(10.0, lambda: buffers.append(load_dataset(tmp_path / "bandit.npz")))
    assert (buffers[0].n_episodes, len(buffers[0])) == (n, n)
