"""
Action heads: from the trunk's hidden state to actions. One file a head; a file that lies in this folder is found.

What a head can do is said in its file alone: options, noise, loss, actions, ways of acting, search space.
"""

import importlib
import pkgutil

from sb3_dtfm.heads.base import ActionHead
from sb3_dtfm.heads.flow import FlowHead
from sb3_dtfm.heads.regression import RegressionHead

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

# By the name of the algorithm that a head makes of the trunk.
HEADS: dict[str, type[ActionHead]] = {head.algorithm: head for head in ActionHead.__subclasses__()}

__all__ = ["HEADS", "ActionHead", "FlowHead", "RegressionHead"]
