"""Windows of K consecutive steps: what a network learns from, and acts on."""

from collections.abc import Callable
from typing import Any, NamedTuple

# The vector among the observations, where these hold images too.
OBSERVATION = "observation"


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

    def map(self, change: Callable[[Any], Any]) -> "Windows":
        """Windows of changed tensors, those of images too."""
        return Windows(*(map_tensors(change, each) for each in self))


def map_tensors(change: Callable[[Any], Any], tensors: Any) -> Any:
    """A changed tensor, or a dictionary of changed tensors."""
    return {name: change(each) for name, each in tensors.items()} if isinstance(tensors, dict) else change(tensors)
