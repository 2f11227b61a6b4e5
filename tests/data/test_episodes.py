"""Statistics of episodes, against numpy's of all their steps."""

import numpy as np
import pytest

from sb3_dtfm.data.episodes import BLOCK_BYTES, moments


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64, np.uint8, bool])
def test_moments_are_numpys(dtype: type):
    values = (np.random.default_rng(0).normal(size=(50, 4)) * 3 + 1).astype(dtype)
    mean, squares = moments(values)
    np.testing.assert_allclose(mean, values.mean(axis=0, dtype=np.float64), rtol=1e-12)
    np.testing.assert_allclose(squares, 50 * values.var(axis=0, dtype=np.float64), rtol=1e-10)


def test_moments_of_more_rows_than_a_block_holds():
    values = np.random.default_rng(0).normal(size=(BLOCK_BYTES // 8 + 7, 2))
    mean, squares = moments(values)
    np.testing.assert_allclose(mean, values.mean(axis=0), rtol=1e-10)
    np.testing.assert_allclose(squares, len(values) * values.var(axis=0), rtol=1e-10)


def test_a_constant_dimension_has_no_spread_and_a_small_one_is_not_swallowed_by_its_offset():
    noise = np.random.default_rng(0).normal(size=1000)
    mean, squares = moments(np.stack([np.full(1000, 100.1), np.zeros(1000), 1e6 + 1e-3 * noise], axis=1))
    assert squares[:2].tolist() == [0.0, 0.0]
    assert mean[:2].tolist() == [100.1, 0.0]
    assert squares[2] == pytest.approx(1e-6 * 1000 * noise.var(), rel=1e-4)


def test_moments_of_one_step():
    mean, squares = moments(np.array([[3.0, -2.0]]))
    assert (mean.tolist(), squares.tolist()) == ([3.0, -2.0], [0.0, 0.0])
