"""The context window against a plain list of steps."""

import numpy as np
import pytest

from sb3_dtfm.policies.context import empty_context, push, with_action


def step(value: float, timestep: int, n_rows: int = 1):
    return np.full((n_rows, 2), value, np.float32), np.full(n_rows, -value, np.float32), np.full(n_rows, timestep, np.int64)


def test_steps_enter_on_the_right_and_leave_on_the_left():
    context = empty_context(1, 3, 2, 1)
    for t in range(5):
        context = with_action(push(context, *step(10.0 + t, t)), np.full((1, 1), 0.1 * t, np.float32))
    assert context.observations[0, :, 0].tolist() == [12.0, 13.0, 14.0]
    assert context.returns_to_go[0].tolist() == [-12.0, -13.0, -14.0]
    assert np.allclose(context.actions[0, :, 0], [0.2, 0.3, 0.4])
    assert context.timesteps[0].tolist() == [2, 3, 4]
    assert context.mask.all()


def test_a_fresh_context_is_padded_on_the_left():
    context = push(empty_context(1, 3, 2, 1), *step(1.0, 0))
    assert context.mask.tolist() == [[False, False, True]]


def test_rows_restart_on_their_own():
    context = push(empty_context(2, 3, 2, 1), *step(1.0, 0, 2))
    context = push(context, *step(2.0, 1, 2), episode_start=np.array([True, False]))
    assert context.mask.tolist() == [[False, False, True], [False, True, True]]


def test_a_time_step_that_does_not_follow_restarts_its_row():
    context = push(empty_context(2, 3, 2, 1), *step(1.0, 0, 2))
    observation, return_to_go, _ = step(2.0, 0, 2)
    context = push(context, observation, return_to_go, np.array([1, 0]))
    assert context.mask.tolist() == [[False, True, True], [False, False, True]]


def test_pushing_leaves_the_old_context_alone():
    old = push(empty_context(1, 3, 2, 1), *step(1.0, 0))
    copies = [array.copy() for array in old]
    with_action(push(old, *step(2.0, 1)), np.ones((1, 1), np.float32))
    assert all(np.array_equal(array, copy) for array, copy in zip(old, copies, strict=True))


@pytest.mark.parametrize(("sizes", "shown"), [((1, 5), "1 row, 5 steps"), ((3, 1), "3 rows, 1 step")])
def test_a_context_is_shown_by_its_sizes(sizes, shown):
    assert repr(empty_context(*sizes, 17, 6)) == f"Context({shown})"
