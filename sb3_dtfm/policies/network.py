"""Everything that is trained: Transformer, head, and the expected range of returns-to-go."""

from typing import Any

import torch as th
from torch import nn

from sb3_dtfm.heads import ActionHead
from sb3_dtfm.networks.layers import Linear
from sb3_dtfm.networks.trunk import SequenceTrunk
from sb3_dtfm.policies.images import ImageEncoder
from sb3_dtfm.windows import OBSERVATION, Windows

# Multiply-accumulates of an image of 84 x 84 in the default extractor: convolutions keep all threads busy.
N_MACS_OF_IMAGES = 15_000_000
HIDDEN_DIM = 256
# The lower and the upper expectile: 0.5 would be the mean twice, 0 and 1 the extremes.
EXPECTILES = (0.05, 0.95)


class ReturnRange(nn.Module):
    """
    A lower and an upper expectile of the normalised return-to-go by the observation (Newey and Powell, 1987).

    Returns-to-go outside of it are rare in the training data from such an observation. This matters where the start decides
    the return, as in Pendulum, and where an agent has fallen and cannot reach the target any more.

    :param observation_dim: O
    """

    def __init__(self, observation_dim: int) -> None:
        super().__init__()
        sizes = (observation_dim, HIDDEN_DIM, HIDDEN_DIM)
        layers = [layer for i in (0, 1) for layer in (Linear(sizes[i], sizes[i + 1]), nn.LayerNorm(sizes[i + 1]), nn.ReLU())]
        self.layers = nn.Sequential(*layers, Linear(HIDDEN_DIM, 2))

    def loss(self, observations: th.Tensor, returns_to_go: th.Tensor, mask: th.Tensor) -> th.Tensor:
        """
        :param observations: (B, K, O), normalised
        :param returns_to_go: (B, K), normalised
        :param mask: (B, K) bool, False on padded steps
        :return: sum of both expectile losses, mean over valid steps
        """
        missing = returns_to_go.unsqueeze(-1) - self.layers(observations).float()
        above = missing.new_tensor(EXPECTILES)
        errors = th.where(missing > 0, above, 1.0 - above) * missing.square()
        return (errors.sum(dim=-1) * mask).sum() / mask.sum()

    def forward(self, observations: th.Tensor, returns_to_go: th.Tensor) -> th.Tensor:
        """
        :param observations: (B, K, O), normalised
        :param returns_to_go: (B, K)
        :return: (B, K), clamped to the range
        """
        low, high = self.layers(observations).unbind(-1)
        return returns_to_go.clamp(low, high)


class SequenceNetwork(nn.Module):
    """
    A map from normalised windows to the loss, or to actions in [-1, 1].

    :param trunk: Transformer from windows to hidden states
    :param head: head from hidden states to actions
    :param return_range: range that the return-to-go is clamped to while acting; None leaves it alone
    :param encoder: encoder from images to features; None where there are no images
    :ivar n_macs: multiply-accumulates of a window's step in the forward pass, without attention's
    """

    def __init__(
        self,
        trunk: SequenceTrunk,
        head: ActionHead,
        return_range: ReturnRange | None = None,
        encoder: ImageEncoder | None = None,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.trunk = trunk
        self.head = head
        self.return_range = return_range
        self.n_macs = trunk.tokens_per_step * _n_weights(trunk) + _n_weights(head)
        if encoder is not None:
            self.n_macs += N_MACS_OF_IMAGES

    def see(self, observations: Any) -> th.Tensor:
        """
        :param observations: vectors (..., O), or a dictionary of these and of images by camera
        :return: vectors (..., O), or (..., O + F) with the features of images behind
        """
        if self.encoder is None:
            vectors: th.Tensor = observations
            return vectors
        return th.cat((observations[OBSERVATION], self.encoder(observations)), dim=-1)

    def draw_noise(self, batch: Windows, generator: th.Generator) -> tuple[th.Tensor, ...]:
        """
        :param batch: batch, as for :meth:`loss`
        :param generator: random number generator on the device of the batch
        :return: further arguments of :meth:`loss`, see :meth:`ActionHead.draw_noise`
        """
        return self.head.draw_noise(chunks_of(batch), generator)

    def loss(self, batch: Windows, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: normalised windows, with actions (B, K + H - 1, A) in [-1, 1]
        :param noise: noise that :meth:`draw_noise` drew for the batch
        :return: the loss to minimise, and its parts by their logged names
        """
        chunks = chunks_of(batch)
        windows = batch._replace(actions=batch.actions[:, : batch.mask.shape[1]])
        loss, parts = self.head.loss(self.trunk(**windows._asdict()), chunks, windows.mask, *noise)
        if self.return_range is not None:
            parts["return_range_loss"] = self.return_range.loss(
                windows.observations.detach(), windows.returns_to_go, windows.mask
            )
            loss = loss + parts["return_range_loss"]
        return loss, parts

    def within_range(self, windows: Windows) -> Windows:
        """Windows (B, K, ...) with returns-to-go clamped to the range that was recorded from such observations."""
        if self.return_range is None:
            return windows
        return windows._replace(returns_to_go=self.return_range(windows.observations, windows.returns_to_go))

    def newest_hidden(self, windows: Windows) -> th.Tensor:
        """Map windows (B, K, ...) to hidden states (B, D) of their newest steps."""
        return self.trunk(**self.within_range(windows)._asdict(), last_only=True).squeeze(1)

    def decode(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """Map hidden states (..., D) and noise (..., N) to chunks (..., H A) in [-1, 1]."""
        return self.head(hidden, noise).clamp(-1.0, 1.0)


def chunks_of(batch: Windows) -> th.Tensor:
    """Cut actions (B, K + H - 1, A) into the H from each of K steps on, (B, K, H A), one after the other."""
    n_actions, n_steps = batch.actions.shape[1], batch.mask.shape[1]
    return batch.actions.unfold(1, n_actions - n_steps + 1, 1).transpose(2, 3).flatten(2)


def _n_weights(network: nn.Module) -> int:
    """Number of elements in the weights of a network's linear layers."""
    return sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, nn.Linear))
