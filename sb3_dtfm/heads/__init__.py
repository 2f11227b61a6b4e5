"""
Action heads: from the trunk's hidden state to actions. One file a head; a file that lies in this folder is found.

What a head can do is said in its file alone: options, noise, loss, actions, ways of acting, search space.
"""

import importlib
import pkgutil
from collections.abc import Iterator

from sb3_dtfm.heads.base import ActionHead
from sb3_dtfm.heads.flow import FlowHead
from sb3_dtfm.heads.regression import RegressionHead

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")


def _named_below(base: type[ActionHead]) -> Iterator[type[ActionHead]]:
    """Heads that name an algorithm of their own; one may also be made of another."""
    for head in base.__subclasses__():
        if "algorithm" in vars(head):
            yield head
        yield from _named_below(head)


# By the name of the algorithm that a head makes of the trunk.
HEADS: dict[str, type[ActionHead]] = {head.algorithm: head for head in _named_below(ActionHead)}  # type: ignore[type-abstract]

__all__ = ["HEADS", "ActionHead", "FlowHead", "RegressionHead"]
