"""The buffer: windows, sampling, and choices of episodes that share its arrays."""

import itertools

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm.data import DatasetError, Trajectory, TrajectoryBuffer
from sb3_dtfm.data.storage import STEP_ARRAYS
from tests.data.small import ACTION_SPACE, OBSERVATION_SPACE, make_buffer, make_trajectory


def test_return_to_go_restarts_with_each_episode():
    trajectories = [make_trajectory(2, rewards=np.array([1.0, 2.0])), make_trajectory(3, rewards=np.array([0.0, 0.0, 1.0]))]
    buffer = TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE)
    assert buffer.returns_to_go.tolist() == [3.0, 2.0, 1.0, 1.0, 1.0]
    assert buffer.timesteps.tolist() == [0, 1, 0, 1, 2]
    assert buffer.episode_returns.tolist() == [3.0, 1.0]


def naive_window(trajectory: Trajectory, end: int, context_length: int) -> dict[str, np.ndarray]:
    """The expected window, built step by step."""
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


@pytest.mark.parametrize("n_ahead", [1, 4])
def test_actions_ahead_are_the_next_ones_and_an_episodes_last_goes_on(n_ahead: int):
    lengths = [5, 1, 12, 2]
    buffer = make_buffer(lengths)
    plain = buffer.windows(th.arange(len(buffer)), 3)
    batch = buffer.windows(th.arange(len(buffer)), 3, n_ahead)
    assert batch.actions.shape == (sum(lengths), 3 + n_ahead, 2)
    assert all(each.equal(other) for each, other in zip(batch._replace(actions=batch.actions[:, :3]), plain, strict=True))
    row = 0
    for episode, length in enumerate(lengths):
        actions = make_trajectory(length, episode).actions.astype(np.float32)
        for end in range(length):
            expected = actions[np.minimum(end + 1 + np.arange(n_ahead), length - 1)]
            np.testing.assert_array_equal(batch.actions[row, 3:].numpy(), expected)
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


def test_better_episodes_are_drawn_more_often_by_the_weight_of_their_returns():
    """Steps of returns -10, 0 and 10 are drawn as 1 to 3.5 to 6; of equal returns, alike."""
    lengths, returns, n_draws = np.array([100, 300, 50]), np.array([0.0, 10.0, -10.0]), 40_000
    buffer = make_buffer(list(lengths))
    buffer.observations[:, 0] = th.arange(3).repeat_interleave(th.from_numpy(lengths))

    def shares(returns: np.ndarray) -> np.ndarray:
        buffer.episodes = buffer.episodes._replace(returns=returns)
        generator = th.Generator().manual_seed(5)
        batch = next(buffer.batches(n_draws, 1, generator, return_weighting=5.0))
        assert batch.timesteps.max() == 299
        return np.bincount(batch.observations[:, 0, 0].long().numpy()) / n_draws

    weights = lengths * np.array([3.5, 6.0, 1.0])
    assert shares(returns) == pytest.approx(weights / weights.sum(), abs=0.01)
    assert shares(np.full(3, 7.0)) == pytest.approx(lengths / 450, abs=0.01)


def test_sampling_repeats_with_the_same_seed():
    buffer = make_buffer([10, 10])
    first, second = (buffer.sample(32, 5, th.Generator().manual_seed(3)) for _ in range(2))
    assert all(th.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("choices", [{}, {"return_weighting": 5.0}], ids=str)
def test_batches_differ_repeat_with_the_same_seed_and_have_no_end(choices: dict[str, float]):
    buffer = make_buffer([10, 10])
    first, second = (
        list(itertools.islice(buffer.batches(32, 5, th.Generator().manual_seed(3), **choices), 50)) for _ in range(2)
    )
    for ours, theirs in zip(first, second, strict=True):
        assert all(th.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    assert len({tuple(batch.observations.flatten().tolist()) for batch in first}) == 50


def test_batches_are_one_sample_after_the_other():
    buffer = make_buffer([10, 3]).select(np.array([1, 0]))
    generator = th.Generator().manual_seed(3)
    for batch in itertools.islice(buffer.batches(32, 5, th.Generator().manual_seed(3)), 4):
        for ours, theirs in zip(batch, buffer.sample(32, 5, generator), strict=True):
            assert th.equal(ours, theirs)


def test_batches_take_their_randomness_from_their_generator_alone():
    buffer = make_buffer([10, 10])
    state = th.get_rng_state()
    next(buffer.batches(32, 5, th.Generator().manual_seed(3), return_weighting=5.0))
    assert th.equal(th.get_rng_state(), state)


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


def test_no_episode_is_refused():
    with pytest.raises(DatasetError, match=r"file.hdf5: holds no episode"):
        TrajectoryBuffer.from_trajectories([], ACTION_SPACE, source="file.hdf5")


@pytest.mark.parametrize(
    ("space", "problem"),
    [
        (spaces.Discrete(1), r"Discrete\(1\)"),
        (spaces.Discrete(10**9), r"Discrete\(1000000000\)"),
        (spaces.MultiDiscrete([3, 2]), r"MultiDiscrete\(\[3 2\]\)"),
        (spaces.MultiBinary(2), r"MultiBinary\(2\)"),
        (spaces.Box(-1.0, 1.0, (2, 1), np.float32), r"\(2, 1\)"),
        (spaces.Box(-1.0, 1.0, (0,), np.float32), r"\(0,\)"),
        (spaces.Box(-1, 1, (2,), np.int64), "int64"),
        (spaces.Box(-np.inf, np.inf, (2,), np.float32), "dimension 0 reaches from -inf to inf"),
        (spaces.Box(np.array([-1, 0.0]), np.array([1, np.inf]), dtype=np.float64), "dimension 1 reaches from 0 to inf"),
        (spaces.Box(-1e39, 1e39, (2,), np.float64), r"dimension 0 reaches from -1e\+39 to 1e\+39"),
        (spaces.Box(np.array([-1, 0.5]), np.array([1, 0.5]), dtype=np.float64), "dimension 1 reaches from 0.5 to 0.5"),
    ],
)
def test_actions_that_cannot_be_learnt_are_refused(space: spaces.Space, problem: str):
    with pytest.raises(DatasetError, match=rf"file.hdf5: the action space is .*{problem}.*only a bounded Box of floats"):
        TrajectoryBuffer.from_trajectories([make_trajectory(6)], space, source="file.hdf5")


@pytest.mark.parametrize(
    ("observations", "space"),
    [
        (np.zeros(6), None),
        (np.zeros((6, 2, 2)), None),
        (np.zeros((6, 2)), spaces.Dict(position=spaces.Box(-1.0, 1.0, (2,)))),
        (np.zeros(6, np.int64), spaces.Discrete(3)),
    ],
)
def test_observations_that_are_no_vectors_are_refused(observations: np.ndarray, space: spaces.Space | None):
    with pytest.raises(DatasetError, match=r"file.hdf5: the observation space is .*only a Box of shape \(O,\)"):
        TrajectoryBuffer.from_trajectories(
            [make_trajectory(6, observations=observations)], ACTION_SPACE, space, source="file.hdf5"
        )


def test_actions_in_float64_are_checked_against_their_bounds_and_clipped():
    space = spaces.Box(-0.1, 0.1, (2,), np.float64)
    actions = np.full((6, 2), 0.1)
    actions[0] = 0.1 + 1e-6, -0.1 - 1e-6
    buffer = TrajectoryBuffer.from_trajectories([make_trajectory(6, actions=actions)], space)
    assert buffer.action_space == space
    assert buffer.actions.dtype == th.float32
    assert buffer.actions[0].tolist() == [np.float32(0.1), np.float32(-0.1)]
    actions[3, 1] = 0.1001
    with pytest.raises(DatasetError, match=r"step 3: action 0.1001 in dimension 1 .*\[-0.1, 0.1\]"):
        TrajectoryBuffer.from_trajectories([make_trajectory(6, actions=actions)], space)


def test_a_buffer_and_all_that_is_made_from_it_know_the_environment():
    trajectories = [make_trajectory(2), make_trajectory(3)]
    buffer = TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE, env_id="Pendulum-v1")
    parts = [buffer, buffer.select(np.array([1])), buffer.random_fraction(0.5, 0), buffer.to("cpu")]
    assert [part.env_id for part in parts] == ["Pendulum-v1"] * 4
    assert make_buffer([2]).env_id is None


def test_rounding_errors_beyond_the_action_bounds_are_clipped():
    actions = make_trajectory(6).actions
    actions[0, 0] = 1.00005
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
    with pytest.raises(ValueError, match="fraction"):
        make_buffer([3]).random_fraction(fraction, 0)


@pytest.mark.parametrize("n_steps", [None, 1, 5, 100])
def test_an_iterator_is_read_once_whatever_number_of_steps_is_announced(n_steps: int | None):
    lengths = [3, 2, 9]
    iterator = (make_trajectory(length, seed) for seed, length in enumerate(lengths))
    buffer = TrajectoryBuffer.from_trajectories(iterator, ACTION_SPACE, OBSERVATION_SPACE, n_steps=n_steps)
    expected = make_buffer(lengths)
    for name in STEP_ARRAYS:
        assert th.equal(getattr(buffer, name), getattr(expected, name)), name
    assert buffer.episode_lengths.tolist() == lengths


def test_select_takes_whole_episodes_in_the_order_given():
    buffer = make_buffer([5, 1, 4])
    chosen = buffer.select(np.array([2, 0]))
    assert chosen.episode_lengths.tolist() == [4, 5]
    assert len(chosen) == 9
    assert chosen.rows.tolist() == [6, 7, 8, 9, 0, 1, 2, 3, 4]
    np.testing.assert_array_equal(chosen.episode_returns, buffer.episode_returns[[2, 0]])
    assert chosen.timesteps.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 4]


def test_select_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"select was given no episode; at least one of 2 is needed"):
        make_buffer([5, 1]).select(np.array([], int))


def test_saving_says_that_weights_are_left_out(tmp_path, recwarn):
    buffer = make_buffer([5, 1])
    buffer.save(tmp_path / "alike")
    assert not recwarn
    with pytest.warns(UserWarning, match=r"weighted\.npz: has no weights of episodes; give them again"):
        type(buffer).join([buffer, buffer], [1.0, 2.0]).save(tmp_path / "weighted")


def test_select_shares_the_arrays_and_can_be_repeated():
    buffer = make_buffer([5, 1, 4, 2])
    chosen = buffer.select(np.array([3, 0, 2])).select(np.array([2, 0]))
    assert chosen.rows.tolist() == [6, 7, 8, 9, 10, 11]
    for name in STEP_ARRAYS:
        assert chosen.stored[name] is buffer.stored[name], name
    assert len(buffer) == 12


def test_the_arrays_of_a_part_are_its_own_and_those_of_all_are_not_copied():
    buffer = make_buffer([5, 1, 4, 2])
    assert buffer.observations is buffer.stored["observations"]
    chosen = buffer.select(np.array([2, 0]))
    for name in ("observations", "actions", "rewards", "returns_to_go"):
        th.testing.assert_close(getattr(chosen, name), buffer.stored[name][chosen.rows], rtol=0, atol=0)
        assert len(getattr(chosen, name)) == len(chosen) < len(buffer)


def test_windows_of_a_selection_are_those_of_a_buffer_of_these_episodes_alone():
    chosen = make_buffer([5, 1, 7, 4]).select(np.array([3, 1, 2]))
    alone = TrajectoryBuffer.from_trajectories(
        [make_trajectory(4, 3), make_trajectory(1, 1), make_trajectory(7, 2)], ACTION_SPACE, OBSERVATION_SPACE
    )
    for ours, theirs in zip(chosen.windows(th.arange(12), 6), alone.windows(th.arange(12), 6), strict=True):
        assert th.equal(ours, theirs)
    drawn = [buffer.sample(64, 6, th.Generator().manual_seed(2)) for buffer in (chosen, alone)]
    assert all(th.equal(ours, theirs) for ours, theirs in zip(*drawn, strict=True))


def test_sampling_a_selection_covers_exactly_its_steps():
    buffer = make_buffer([5, 1, 7, 4])
    buffer.observations[:, 0] = th.arange(len(buffer))
    chosen = buffer.select(np.array([2, 1]))
    batch = chosen.sample(2000, 3, th.Generator().manual_seed(0))
    assert set(batch.observations[:, -1, 0].tolist()) == set(chosen.rows.tolist()) == set(range(5, 13))
    assert batch.timesteps.max() == 6


def test_the_draw_of_a_full_buffer_is_one_randint_over_its_steps():
    """Runs of earlier versions repeat: position and row are the same there."""
    buffer = make_buffer([5, 1, 7, 4])
    ends = th.randint(17, (32,), generator=th.Generator().manual_seed(3))
    batch = buffer.sample(32, 1, th.Generator().manual_seed(3))
    assert th.equal(batch.observations[:, 0], buffer.observations[ends])


@pytest.mark.parametrize("episodes", [*itertools.permutations(range(3), 2), (0, 1, 2)])
def test_statistics_are_those_of_the_contained_steps(episodes: tuple[int, ...]):
    chosen = make_buffer([5, 1, 40]).select(np.array(episodes))
    observations, to_go = chosen.observations.double(), chosen.returns_to_go
    statistics = chosen.statistics()
    np.testing.assert_allclose(statistics.observation_mean, observations.mean(0), rtol=1e-6)
    np.testing.assert_allclose(statistics.observation_std, observations.std(0, correction=0), rtol=1e-6)
    assert np.float32(statistics.return_scale) == to_go.abs().max().item()


def test_a_few_wild_episodes_do_not_set_the_unit():
    """Eight agents that keep their balance, two that roll: by hand, to a tenth of the standard deviation at least."""
    steps = np.array([-1.0, 1.0])
    spreads = [[0.5, 3.0, 0.0], *[[1.0, 3.0, 0.0]] * 7, *[[20.0, 3.0, 0.0]] * 2]
    trajectories = [make_trajectory(2, observations=steps[:, None] * spread) for spread in spreads]
    buffer = TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE, spaces.Box(-np.inf, np.inf, (3,)))
    statistics = buffer.statistics()
    np.testing.assert_allclose(statistics.observation_std, [np.sqrt(80.725), 3.0, 0.0])
    np.testing.assert_allclose(statistics.observation_robust_std, [1.0, 3.0, 0.0])
    assert buffer.select(np.array([0, 8, 9])).statistics().observation_robust_std[0] == pytest.approx(10.25)
    wild = buffer.select(np.array([0, 0, 0, 8])).statistics()
    assert (
        wild.observation_robust_std[0]
        == pytest.approx(0.1 * wild.observation_std[0])
        == pytest.approx(0.1 * np.sqrt(100.1875))
    )


def test_a_buffer_on_its_own_device_stays_as_it_is():
    buffer = make_buffer([3, 2])
    moved = buffer.to("cpu")
    assert moved.observations.data_ptr() == buffer.observations.data_ptr()
    assert moved.device == th.device("cpu")


def test_the_range_of_the_return_to_go_by_hand():
    trajectories = [
        make_trajectory(len(rewards), rewards=np.array(rewards)) for rewards in ([1, 2, 3], [5, -1], [9, 9, 9, 9])
    ]
    buffer = TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE, OBSERVATION_SPACE)
    assert buffer.select(np.array([1, 0])).return_to_go_range().tolist() == [[4, -1, 3], [6, 5, 3]]
