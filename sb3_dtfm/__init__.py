"""Offline reinforcement learning for Stable-Baselines3: Decision Transformers with and without a flow-matching head."""

from typing import TYPE_CHECKING, Any

import sb3_dtfm.envs  # noqa: F401  (registers the tasks)

if TYPE_CHECKING:
    from sb3_dtfm.algorithms import DT, DTFM

__all__ = ["DT", "DTFM"]
__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """The algorithms, when they are asked for: PyTorch takes seconds to import."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sb3_dtfm import algorithms

    return getattr(algorithms, name)
