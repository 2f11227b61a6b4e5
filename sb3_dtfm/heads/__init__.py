"""
Action heads: from the Transformer's hidden state to actions. One file a head.

Each file says all of its head: options, noise, loss, actions, ways of acting, search space.
"""

from sb3_dtfm.heads.base import ActionHead
from sb3_dtfm.heads.flow import FlowHead
from sb3_dtfm.heads.regression import RegressionHead

__all__ = ["ActionHead", "FlowHead", "RegressionHead"]
