"""Trunk and head as one network, and its newest hidden states from what was kept of earlier steps."""

import numpy as np
import torch as th
from torch import nn

from sb3_dtfm.heads import ActionHead
from sb3_dtfm.networks.cache import extend_cache
from sb3_dtfm.networks.return_range import ReturnRange
from sb3_dtfm.networks.trunk import SequenceTrunk
from sb3_dtfm.windows import Windows


class SequenceNetwork(nn.Module):
    """
    Everything that is trained.

    :param trunk: from normalised windows to hidden states
    :param head: from hidden states to actions
    :param return_range: what the return-to-go is kept within while acting; None leaves it alone
    :ivar n_macs: multiplications of a step of a window on the way forward, without attention's
    """

    def __init__(self, trunk: SequenceTrunk, head: ActionHead, return_range: ReturnRange | None = None) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = head
        self.return_range = return_range
        self.n_macs = trunk.tokens_per_step * _n_weights(trunk) + _n_weights(head)

    def within_range(self, windows: Windows) -> Windows:
        """
        Windows whose returns-to-go recordings reached from such observations; in training they are those of recordings.

        :param windows: (B, K, ...), normalised
        """
        if self.return_range is None or self.training:
            return windows
        return windows._replace(returns_to_go=self.return_range(windows.observations, windows.returns_to_go))

    def extend(self, windows: Windows, cache: np.ndarray) -> tuple[th.Tensor, np.ndarray]:
        """
        :param windows: (B, K, ...), normalised
        :param cache: see :func:`~sb3_dtfm.networks.cache.extend_cache`
        :return: (B, D) hidden states of the newest step, and the new cache
        """
        return extend_cache(self.trunk, self.within_range(windows)._asdict(), cache)


def _n_weights(network: nn.Module) -> int:
    """Numbers in its linear layers' weights."""
    return sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, nn.Linear))
