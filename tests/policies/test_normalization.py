"""Normalisation of observations and returns-to-go for the network, by hand."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.policies.normalization import Normalization
from sb3_dtfm.windows import Windows

T = 100


def make_normalization(**options: bool) -> Normalization:
    options = {"clip_return_to_go": False, "observation_scaling": "robust", **options}
    normalization = Normalization(2, spaces.Box(-1.0, 1.0, (1,)), T, **options)
    normalization.set_statistics(np.array([1.0, 5.0]), np.array([2.0, 0.0]), np.array([0.5, 0.0]), 300.0)
    return normalization


def make_windows(observations: list[float], returns_to_go: float, timestep: int) -> Windows:
    arrays = (observations, [0.0], returns_to_go, timestep, True)
    return Windows(*(th.tensor(each)[None, None] for each in arrays))


@pytest.mark.parametrize(
    ("observations", "expected"),
    [([2.0, 5.0], [2.0, 0.0]), ([-1.0, 6.0], [-4.0, 0.0]), ([100.0, 500.0], [40.0, 0.0])],
    ids=[
        "a unit is what an episode that moves little spreads",
        "a constant stays zero",
        "clipped at ten standard deviations",
    ],
)
def test_observations_by_hand(observations, expected):
    normalized = make_normalization()(make_windows(observations, 0.0, 0))
    assert normalized.observations.flatten().tolist() == expected


@pytest.mark.parametrize(
    ("return_to_go", "timestep", "expected"),
    [(300.0, 0, 0.5), (150.0, 50, 0.5), (75.0, 50, -0.25), (3.0, 99, 0.5), (9000.0, 0, 1.25), (6.0, 140, 1.25)],
    ids=["at the start", "half-way", "below the mean", "last step", "clipped at five deviations", "longer than any episode"],
)
def test_the_scaled_return_to_go_by_hand(return_to_go, timestep, expected):
    """Two standard deviations above the mean at a time step are 0.5, at the first step as at the last."""
    normalization = make_normalization(return_scaling="timestep")
    remaining = th.arange(T, 0, -1) / T
    normalization.set_return_to_go_moments(th.stack((200.0 * remaining, 50.0 * remaining)))
    windows = make_windows([1.0, 5.0], return_to_go, timestep)
    assert normalization(windows).returns_to_go.item() == pytest.approx(expected)


def test_a_return_to_go_is_clipped_before_it_is_scaled():
    normalization = make_normalization(return_scaling="timestep", clip_return_to_go=True)
    normalization.set_return_to_go_moments(th.stack((th.full((T,), 100.0), th.full((T,), 25.0))))
    limits = th.zeros(2, T)
    limits[1] = 150.0
    normalization.set_return_to_go_range(limits)
    assert normalization(make_windows([1.0, 5.0], 900.0, 50)).returns_to_go.item() == pytest.approx(0.5)


def test_a_policy_without_return_conditioning_sees_none():
    assert make_normalization(return_scaling=None)(make_windows([1.0, 5.0], 900.0, 50)).returns_to_go.item() == 0.0


def test_the_unit_is_the_standard_deviation_unless_asked_for():
    normalized = make_normalization(observation_scaling="std")(make_windows([2.0, 6.0], 0.0, 0))
    assert normalized.observations.flatten().tolist() == [0.5, 0.0]


@pytest.mark.parametrize(("deviation", "expected"), [(6e-6, 0.0), (6e-5, 1.0)], ids=["noise of rounding", "a signal"])
def test_a_deviation_of_6e_6_is_a_constant(deviation, expected):
    """As recorded, in what settings are decided from, and at acting, where it may be far from what it was."""
    steps = np.stack([np.arange(8.0), 1.0 + deviation * np.tile([-1.0, 1.0], 4)], axis=1)
    episode = Trajectory(steps, np.zeros((8, 1)), np.ones(8), terminated=False, truncated=True)
    buffer = TrajectoryBuffer.from_trajectories([episode], spaces.Box(-1.0, 1.0, (1,)))
    statistics = buffer.statistics()
    assert statistics.observation_std[1] == pytest.approx(deviation, rel=0.02)
    one_above, far_away = [3.5, 1.0 + deviation], [3.5, 2.0]
    assert statistics.normalize(th.tensor([one_above]))[0, 1].item() == pytest.approx(expected, rel=0.03)
    normalization = make_normalization(observation_scaling="std")
    normalization.set_statistics(*statistics)
    for seen, normalized in ((one_above, expected), (far_away, 10.0 * expected)):
        observations = normalization(make_windows(seen, 0.0, 0)).observations
        assert observations[0, 0, 1].item() == pytest.approx(normalized, rel=0.03)
