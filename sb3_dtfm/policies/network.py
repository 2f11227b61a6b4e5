"""Trunk and head as one network, and its newest hidden states from what was kept of earlier steps."""

import numpy as np
import torch as th
from torch import nn

from sb3_dtfm.heads import ActionHead
from sb3_dtfm.networks.cpu import make_cache, reserve_cache
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

    def extend(self, windows: Windows, kept: np.ndarray) -> tuple[th.Tensor, np.ndarray]:
        """
        The newest hidden states from what was kept, and what to keep for the next step.

        :param windows: (B, K, ...), normalised
        :param kept: (B, layers, 2, L, D) for the L tokens before the newest, or (B, 0) if the last steps were acted without
            a cache
        :return: (B, D) hidden states, and the new `kept`
        """
        trunk, device = self.trunk, windows.mask.device
        n_new = trunk.tokens_per_step
        n_kept = trunk.n_tokens(windows.mask.shape[1]) - n_new
        shape = (len(windows.mask), trunk.n_layers, 2, n_kept, trunk.embed_dim)
        n_missing = 0
        if kept.shape != shape:
            kept = np.zeros(shape, np.float32)
            n_missing = int(windows.mask.sum(dim=1).max()) - 1
        for n_back in range(n_missing, -1, -1):
            earlier = Windows(*(x.roll(n_back, dims=1) for x in windows)) if n_back else windows
            earlier.mask[:, :n_back] = False  # the newest steps went round to the left
            memory, end = reserve_cache(kept, n_new, device)
            start, end = end - n_kept, end + n_new
            hidden, _ = trunk.extend(**earlier._asdict(), keys_values=memory[..., start:end, :])
            kept = make_cache(memory, start + n_new, end)
        return hidden, kept


def _n_weights(network: nn.Module) -> int:
    """Numbers in its linear layers' weights."""
    return sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, nn.Linear))
