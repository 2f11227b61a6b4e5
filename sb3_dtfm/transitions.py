"""Steps and where they led to: what a critic learns from."""

from typing import Any, NamedTuple

# The observations of transitions.
ENDS = ("observations", "next_observations")


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
