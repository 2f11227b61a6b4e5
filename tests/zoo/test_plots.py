"""Learning curves and the interval of a success rate."""

import numpy as np
import pytest

from sb3_dtfm.zoo.plots import load_evaluations, plot_learning_curve, wilson_interval


def test_wilson_interval_is_the_closed_form():
    n_successes, n, z = 45, 50, 1.959963984540054
    rate = n_successes / n
    centre = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half_width = z / (1 + z**2 / n) * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    assert wilson_interval(n_successes, n) == pytest.approx((centre - half_width, centre + half_width))
    assert wilson_interval(50, 50) == pytest.approx((0.9287, 1.0), abs=1e-4)


@pytest.mark.parametrize("with_success", [True, False])
def test_a_run_with_or_without_successes_is_drawn(with_success, tmp_path):
    arrays = {"timesteps": np.array([10, 20]), "results": np.ones((2, 4)), "ep_lengths": np.ones((2, 4))}
    if with_success:
        arrays["successes"] = np.array([[True, False, False, False], [True] * 4])
    np.savez(tmp_path / "evaluations.npz", **arrays)
    assert (load_evaluations(tmp_path).successes is not None) == with_success
    picture = plot_learning_curve(tmp_path, tmp_path / "new" / "curve.png")
    assert picture.read_bytes().startswith(b"\x89PNG")
