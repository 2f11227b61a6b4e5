"""Offline reinforcement learning for Stable-Baselines3: Decision Transformers with and without a flow-matching head."""

from sb3_dtfm.algorithms import DT, DTFM

__all__ = ["DT", "DTFM"]
__version__ = "0.1.0"
