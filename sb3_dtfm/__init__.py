"""Offline reinforcement learning for Stable-Baselines3: Decision Transformers with and without a flow-matching head."""

import os

# Before torch starts its threads: by default they spin while they wait, and on a core that is shared with a simulator or
# another job they take the time that the others need (docs/performance.md).
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from sb3_dtfm.algorithms import DT, DTFM

__all__ = ["DT", "DTFM"]
__version__ = "0.1.0"
