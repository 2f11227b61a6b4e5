"""How attempts at Can that fail are sorted."""

import can_failures
import numpy as np
import pytest


@pytest.mark.parametrize(
    ("lifted", "opened_at", "success", "expected"),
    [
        (True, 0.1, True, "solved"),
        (False, 0.1, False, "never lifted"),
        (True, None, False, "never let go"),
        (True, 0.1, False, "let go on the way"),
        (True, 0.35, False, "let go at the bin"),
    ],
)
def test_an_attempt_is_sorted_by_where_the_hand_first_opens_after_lifting(lifted, opened_at, success, expected):
    """The hand is open before it lifts; it moves by a centimetre a step."""
    observations, actions = np.zeros((60, 23)), np.ones((60, 7))
    actions[:10, -1] = -1.0
    observations[:, 1] = np.linspace(-0.2, 0.39, 60)
    observations[15:, 18] = 0.1 if lifted else 0.0
    if opened_at is not None:
        actions[observations[:, 1] > opened_at, -1] = -0.5
    assert can_failures.sort(observations, actions, success) == expected
