"""Actions and their vectors."""

import numpy as np
import pytest
from gymnasium import spaces

from sb3_dtfm.actions import bounds_of, choices_between, from_vectors, to_vectors, vector_space


def test_choices_become_ones_among_zeros_and_come_back():
    space = spaces.Discrete(3, start=5)
    choices = np.array([7, 5, 6, 5])
    vectors = to_vectors(choices, space)
    assert vectors.dtype == np.float32
    assert vectors.tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0], [1, 0, 0]]
    assert vector_space(space) == spaces.Box(0.0, 1.0, (3,))
    back = from_vectors(vectors, space)
    assert back.dtype == np.int64
    assert back.tolist() == choices.tolist()
    assert from_vectors(vectors, spaces.Discrete(3, dtype=np.uint8)).dtype == np.uint8


def test_vectors_of_a_box_stay_what_they_are_but_for_rounding():
    space = spaces.Box(np.array([-1.0, -0.3]), np.array([0.1, 2.0]), dtype=np.float64)
    actions = np.array([[0.1 + 1e-9, 0.3], [-0.2, -0.3 - 1e-9]])
    vectors = to_vectors(actions, space)
    assert vectors.tolist() == [[0.1, 0.3], [-0.2, -0.3]]
    assert vector_space(space) is space
    assert from_vectors(vectors, space) is vectors


def test_a_range_of_choices():
    space = spaces.Discrete(3, start=-1)
    assert [bound.item() for bound in bounds_of(space)] == [-1, 1]
    assert choices_between(*bounds_of(space)) == space
    assert choices_between(0, 1.0) == spaces.Discrete(2)
    for first, last in ((0, 0.5), (1, 0), (0, np.inf), (0, [1, 2]), ("a", "b"), (False, True)):
        with pytest.raises(ValueError, match="two whole numbers are expected"):
            choices_between(first, last)
