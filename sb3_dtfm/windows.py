"""Windows of K consecutive steps: what a network learns from, and acts on."""

from typing import Any, NamedTuple


class Windows(NamedTuple):
    """
    B windows of K consecutive steps, newest last, padded on the left; padded entries are zero and False in `mask`.

    Tensors on their way through a network, arrays in a :class:`Context`. Shapes: observations (B, K, O), actions (B, K, A),
    returns_to_go (B, K) in environment reward units, timesteps (B, K) int64 counted from the episode's start, mask (B, K)
    bool. Whoever hands windows on says in which units observations and actions are. A batch to learn chunks from has more
    actions, (B, K + H - 1, A): those after the newest step.
    """

    observations: Any
    actions: Any
    returns_to_go: Any
    timesteps: Any
    mask: Any


class Transitions(NamedTuple):
    """
    B steps and where they led to; of a chunk, h steps as one.

    Shapes: observations (B, O); actions (B, h A), one after the other; rewards (B,), discounted sums over the h steps, in
    environment reward units; next_observations (B, O); discounts (B,), what the value of the next observation counts, 0
    where the episode has terminated; mask (B,) bool, False where the recording ended before it could be told.
    """

    observations: Any
    actions: Any
    rewards: Any
    next_observations: Any
    discounts: Any
    mask: Any
