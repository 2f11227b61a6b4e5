"""The buffer: return-to-go, windows, sampling, and what it refuses."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm.data.trajectories import (
    DatasetError,
    ScoreReference,
    Trajectory,
    TrajectoryBuffer,
    check_trajectory,
    returns_to_go,
)

ACTION_SPACE = spaces.Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 2.0], np.float32))
OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (3,), np.float32)


def make_trajectory(n_steps: int, seed: int = 0, **changes: object) -> Trajectory:
    rng = np.random.default_rng(seed)
    arrays: dict = {
        "observations": rng.normal(size=(n_steps, 3)),
        "actions": rng.uniform(ACTION_SPACE.low, ACTION_SPACE.high, size=(n_steps, 2)),
        "rewards": rng.normal(size=n_steps),
    }
    return Trajectory(**{**arrays, **changes})


def make_buffer(lengths: list[int]) -> TrajectoryBuffer:
    trajectories = [make_trajectory(length, seed) for seed, length in enumerate(lengths)]
    return TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE, OBSERVATION_SPACE)


def test_return_to_go_of_a_hand_built_episode():
    np.testing.assert_array_equal(returns_to_go(np.array([1.0, -2.0, 0.5, 4.0])), [3.5, 2.5, 4.5, 4.0])


def test_return_to_go_restarts_with_each_episode():
    trajectories = [make_trajectory(2, rewards=np.array([1.0, 2.0])), make_trajectory(3, rewards=np.array([0.0, 0.0, 1.0]))]
    buffer = TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE)
    assert buffer.returns_to_go.tolist() == [3.0, 2.0, 1.0, 1.0, 1.0]
    assert buffer.timesteps.tolist() == [0, 1, 0, 1, 2]
    assert buffer.episode_returns.tolist() == [3.0, 1.0]


def naive_window(trajectory: Trajectory, end: int, context_length: int) -> dict[str, np.ndarray]:
    """What a window must hold, step by step."""
    window = {
        "observations": np.zeros((context_length, 3), np.float32),
        "actions": np.zeros((context_length, 2), np.float32),
        "returns_to_go": np.zeros(context_length, np.float32),
        "timesteps": np.zeros(context_length, np.int64),
        "mask": np.zeros(context_length, bool),
    }
    for slot in range(context_length):
        step = end - (context_length - 1 - slot)
        if step < 0:
            continue
        window["observations"][slot] = trajectory.observations[step]
        window["actions"][slot] = trajectory.actions[step]
        window["returns_to_go"][slot] = trajectory.rewards[step:].sum()
        window["timesteps"][slot] = step
        window["mask"][slot] = True
    return window


@pytest.mark.parametrize("context_length", [1, 3, 7, 20])
def test_windows_equal_a_naive_reference_with_padding_at_the_start(context_length: int):
    lengths = [5, 1, 12, 2]
    buffer = make_buffer(lengths)
    batch = buffer.windows(th.arange(len(buffer)), context_length)
    assert batch.observations.shape == (sum(lengths), context_length, 3)
    row = 0
    for episode, length in enumerate(lengths):
        trajectory = make_trajectory(length, episode)
        for end in range(length):
            for name, expected in naive_window(trajectory, end, context_length).items():
                np.testing.assert_allclose(getattr(batch, name)[row].numpy(), expected, rtol=1e-5, atol=1e-6, err_msg=name)
            row += 1


def test_windows_end_at_every_step_with_equal_probability():
    buffer = make_buffer([1, 3, 30, 66])
    buffer.observations[:, 0] = th.arange(len(buffer))
    n_draws = 100_000
    batch = buffer.sample(n_draws, 4, th.Generator().manual_seed(7))
    counts = np.bincount(batch.observations[:, -1, 0].long().numpy(), minlength=len(buffer))
    expected = n_draws / len(buffer)
    chi_square, freedom = np.sum((counts - expected) ** 2) / expected, len(buffer) - 1
    assert abs(chi_square - freedom) < 4 * np.sqrt(2 * freedom)
    assert batch.mask[:, -1].all()


def test_sampling_repeats_with_the_same_seed():
    buffer = make_buffer([10, 10])
    first, second = (buffer.sample(32, 5, th.Generator().manual_seed(3)) for _ in range(2))
    assert all(th.equal(a, b) for a, b in zip(first, second, strict=True))


def test_episodes_shorter_than_the_context_are_padded_and_kept():
    buffer = make_buffer([2, 1])
    batch = buffer.windows(th.tensor([1, 2]), 5)
    assert batch.mask.tolist() == [[False] * 3 + [True] * 2, [False] * 4 + [True]]
    assert batch.observations[0, :3].abs().sum() == 0
    assert batch.returns_to_go[1, :4].abs().sum() == 0


def test_an_unfinished_last_episode_is_kept():
    trajectories = [make_trajectory(4, terminated=True), make_trajectory(3, truncated=True), make_trajectory(2)]
    buffer = TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE)
    assert buffer.n_episodes == 3
    assert buffer.terminated.tolist() == [True, False, False]
    assert buffer.truncated.tolist() == [False, True, False]
    assert len(buffer) == 9


def test_arrays_are_float32_whatever_was_recorded():
    buffer = make_buffer([4])
    for name in ("observations", "actions", "rewards", "returns_to_go"):
        assert getattr(buffer, name).dtype == th.float32, name


def test_known_lengths_allow_an_iterator():
    lengths = [3, 2]
    iterator = (make_trajectory(length, seed) for seed, length in enumerate(lengths))
    buffer = TrajectoryBuffer.from_trajectories(iterator, ACTION_SPACE, OBSERVATION_SPACE, lengths=lengths)
    assert th.equal(buffer.observations, make_buffer(lengths).observations)


def test_fewer_episodes_than_announced_are_refused():
    with pytest.raises(DatasetError, match="announces 2 episodes"):
        TrajectoryBuffer.from_trajectories(iter([make_trajectory(3)]), ACTION_SPACE, lengths=[3, 2])


@pytest.mark.parametrize("lengths", [[3], [3, 1], [3, 5]])
def test_more_or_other_steps_than_announced_are_refused(lengths: list[int]):
    with pytest.raises(DatasetError, match="holds 2 steps, announced"):
        TrajectoryBuffer.from_trajectories(iter([make_trajectory(3), make_trajectory(2)]), ACTION_SPACE, lengths=lengths)


def test_no_episode_is_refused():
    with pytest.raises(DatasetError, match=r"file.hdf5: holds no episode"):
        TrajectoryBuffer.from_trajectories([], ACTION_SPACE, source="file.hdf5")


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


def test_rounding_errors_beyond_the_action_bounds_are_clipped():
    actions = with_value(GOOD.actions, (0, 0), 1.00005)
    buffer = TrajectoryBuffer.from_trajectories([make_trajectory(6, actions=actions)], ACTION_SPACE)
    assert buffer.actions[0, 0] == 1.0


def test_random_fraction_is_the_same_for_the_same_seed():
    buffer = make_buffer(list(range(1, 41)))
    halves = [buffer.random_fraction(0.5, seed).episode_lengths.tolist() for seed in (1, 1, 2)]
    assert halves[0] == halves[1] != halves[2]
    assert len(set(halves[0])) == 20
    assert buffer.random_fraction(1.0, 0) is buffer
    assert buffer.random_fraction(0.001, 0).n_episodes == 1


@pytest.mark.parametrize("fraction", [0.0, -0.5, 1.5, float("nan")])
def test_random_fraction_outside_of_its_range_is_refused(fraction: float):
    with pytest.raises(ValueError, match="dataset_fraction"):
        make_buffer([3]).random_fraction(fraction, 0)


def test_select_takes_whole_episodes_in_the_order_given():
    buffer = make_buffer([5, 1, 4])
    chosen = buffer.select(np.array([2, 0]))
    assert chosen.episode_lengths.tolist() == [4, 5]
    assert th.equal(chosen.observations, th.cat([buffer.observations[6:], buffer.observations[:5]]))
    assert th.equal(chosen.returns_to_go, th.cat([buffer.returns_to_go[6:], buffer.returns_to_go[:5]]))
    np.testing.assert_array_equal(chosen.episode_returns, buffer.episode_returns[[2, 0]])
    assert chosen.timesteps.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 4]


def test_normalised_score_is_zero_at_the_minimum_and_one_at_the_maximum():
    reference = ScoreReference(-100.0, 300.0, "of a test")
    assert [reference.normalize(value) for value in (-100.0, 100.0, 300.0)] == [0.0, 0.5, 1.0]
