"""
Actions as vectors of numbers, which is all that data and networks know of them.

Those of a Box are vectors. One of a Discrete space's n actions becomes n numbers: 1 for it, 0 for the others.
"""

from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces

# Action spaces that can be learned.
ActionSpace: TypeAlias = spaces.Box | spaces.Discrete


def vector_space(space: ActionSpace) -> spaces.Box:
    """
    The space of the vectors that actions become.

    :return: Box (A,); of a Discrete space (n,), from 0 to 1
    """
    return space if isinstance(space, spaces.Box) else spaces.Box(0.0, 1.0, (int(space.n),), np.float32)


def to_vectors(actions: np.ndarray, space: ActionSpace) -> np.ndarray:
    """
    :param actions: (T, A), or (T,) of a Discrete space; inside of it but for rounding
    :return: (T, A) inside of :func:`vector_space`
    """
    if isinstance(space, spaces.Box):
        return np.clip(actions, space.low, space.high)
    vectors = np.zeros((len(actions), int(space.n)), np.float32)
    vectors[np.arange(len(actions)), actions.astype(np.int64) - int(space.start)] = 1.0
    return vectors


def from_vectors(vectors: np.ndarray, space: ActionSpace) -> np.ndarray:
    """
    The inverse of :func:`to_vectors`.

    :param vectors: (T, A)
    :return: (T, A), or (T,) of a Discrete space: the choice of the largest number
    """
    if isinstance(space, spaces.Box):
        return vectors
    return (int(space.start) + vectors.argmax(axis=-1)).astype(space.dtype)


def unscaled(actions: Any, low: Any, high: Any) -> Any:
    """
    Actions of a Box in its own range, but for rounding.

    :param actions: (..., A) in [-1, 1], an array or a tensor
    :param low: (A,), smallest action
    :param high: (A,), largest action
    """
    return low + 0.5 * (actions + 1.0) * (high - low)


def bounds_of(space: ActionSpace) -> tuple[np.ndarray, np.ndarray]:
    """
    Smallest and largest element of a space.

    :return: (A,) each, or () of a Discrete space
    """
    if isinstance(space, spaces.Box):
        return space.low, space.high
    first = int(space.start)
    return np.array(first, space.dtype), np.array(first + int(space.n) - 1, space.dtype)


def same_actions(space: ActionSpace, other: ActionSpace) -> bool:
    """Return whether two spaces hold the same actions, of whatever precision."""
    return space.shape == other.shape and all(
        np.allclose(bound, bound_of_other) for bound, bound_of_other in zip(bounds_of(space), bounds_of(other), strict=True)
    )


def choices_between(first: Any, last: Any) -> spaces.Discrete:
    """
    The Discrete space of a range.

    :param first: smallest action
    :param last: largest action
    :raises ValueError: not two whole numbers, the second one larger
    """
    low, high = (np.asarray(bound) for bound in (first, last))
    numbers = low.size == high.size == 1 and all(
        bound.dtype.kind in "iuf" and bound.item() % 1 == 0 for bound in (low, high)
    )
    if not numbers or low.item() >= high.item():
        raise ValueError(f"two whole numbers are expected, the second one larger; got {first!r} and {last!r}.")
    return spaces.Discrete(int(high.item() - low.item()) + 1, start=int(low.item()))
