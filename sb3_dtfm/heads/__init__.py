"""
Action heads: maps from the Transformer's hidden state to actions.

Each file holds all of one head: options, noise, loss, actions, ways of acting, search space.
"""

from sb3_dtfm.heads.base import ActionHead
from sb3_dtfm.heads.flow import FlowHead
from sb3_dtfm.heads.regression import RegressionHead

__all__ = ["ActionHead", "FlowHead", "RegressionHead"]
