"""One episode: its return-to-go, and what makes it unfit for learning."""

import zlib

import numpy as np
import pytest

from sb3_dtfm.data import TrajectoryBuffer
from sb3_dtfm.data.trajectories import DatasetError, ScoreReference, check_size, check_trajectory, returns_to_go
from tests.data.small import ACTION_SPACE, OBSERVATION_SPACE, make_trajectory


def test_return_to_go_of_a_hand_built_episode():
    np.testing.assert_array_equal(returns_to_go(np.array([1.0, -2.0, 0.5, 4.0])), [3.5, 2.5, 4.5, 4.0])


def with_value(array: np.ndarray, index: tuple[int, ...], value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


GOOD = make_trajectory(6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": np.zeros((6, 4))}, r"observations have shape \(6, 4\), expected \(6, 3\)"),
        ({"observations": np.zeros((7, 3))}, r"observations have shape \(7, 3\), expected \(6, 3\)"),
        ({"actions": np.zeros((6, 1))}, r"actions have shape \(6, 1\), expected \(6, 2\)"),
        ({"rewards": np.zeros((6, 1))}, r"rewards have shape \(6, 1\), expected \(6,\)"),
        ({"observations": with_value(GOOD.observations, (4, 2), np.nan)}, "step 4: observations hold nan, dimension 2"),
        ({"observations": with_value(GOOD.observations, (0, 1), 1e39)}, "step 0: observations hold 1e.39, .*float32"),
        ({"actions": with_value(GOOD.actions, (3, 1), np.inf)}, "step 3: actions hold inf, dimension 1"),
        ({"rewards": with_value(GOOD.rewards, (5,), -np.inf)}, "step 5: rewards hold -inf"),
        ({"actions": with_value(GOOD.actions, (2, 1), 2.5)}, r"step 2: action 2.5 in dimension 1 .*\[-2, 2\]"),
        ({"actions": with_value(GOOD.actions, (1, 0), -1.1)}, r"step 1: action -1.1 in dimension 0 .*\[-1, 1\]"),
        ({name: getattr(GOOD, name)[:0] for name in ("observations", "actions", "rewards")}, "holds no step"),
    ],
)
def test_an_error_names_file_episode_and_step(changes: dict, message: str):
    with pytest.raises(DatasetError, match=f"file.hdf5, demo_3.*{message}"):
        check_trajectory(make_trajectory(6, name="demo_3", **changes), OBSERVATION_SPACE, ACTION_SPACE, "file.hdf5")


def test_normalised_score_is_zero_at_the_minimum_and_one_at_the_maximum():
    reference = ScoreReference(-100.0, 300.0, "of a test")
    assert [reference.normalize(value) for value in (-100.0, 100.0, 300.0)] == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_large_numbers_that_fit_into_float32_are_kept(dtype: type):
    observations = with_value(GOOD.observations, (4, 2), 3e38).astype(dtype)
    buffer = TrajectoryBuffer.from_trajectories([make_trajectory(6, observations=observations)], ACTION_SPACE)
    np.testing.assert_array_equal(buffer.observations.numpy(), observations.astype(np.float32))
    assert buffer.statistics().observation_mean[2] == pytest.approx(5e37, rel=1e-6)


def test_what_compresses_best_is_taken_and_what_no_compression_makes_is_not():
    n_bytes = 2**25
    n_stored = len(zlib.compress(bytes(n_bytes), 9))
    assert n_bytes > 1000 * n_stored
    check_size(n_bytes, n_stored, "rewards")
    with pytest.raises(DatasetError, match=f"rewards claim {2**26} bytes, of which {n_stored} are stored"):
        check_size(2**26, n_stored, "rewards")
