"""
Layers of Transformer and heads: linear maps, dropout, sinusoidal embeddings, and MLPs that are scaled and shifted
from outside (FiLM).

Products of few rows and dropout masks have their own way on a CPU, with equal numbers. On 2 cores of an AMD EPYC with AVX2 a
row times a weight of 256 x 1024 outside of the cache takes 112 us by NumPy and 149 by torch, of 256 x 3072 182 and 458;
up to `LARGE_WEIGHT` torch is the faster one. A dropout mask takes an eighth of torch's time.
"""

import math

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

# Masks are drawn with 16 random bits an element: probabilities are multiples of 1 / 65536.
LEVELS = 1 << 16
# Up to here a product takes as long as reading the weights, and the library decides how fast they are read.
FEW_ROWS = 4
# Numbers in a weight from which that pays.
LARGE_WEIGHT = 1 << 17
# Lowest and highest frequency in rad: higher ones would change faster than a solver's step can follow.
TAU_FREQUENCIES = (1.0, 100.0)
# Higher ones tell the episodes of one agent apart, and each is then learned for itself.
RETURN_FREQUENCIES = (1.0, 8.0)
RETURN_EMBEDDING_DIM = 16
# Data are at about 1. The factors of ten blocks multiply: of a return of 100 they would leave the range of float32.
RETURN_CLIP = 10.0


class Linear(nn.Linear):
    """
    torch's linear layer; on a CPU, without gradients, NumPy computes the product of few rows and a large weight.

    It takes `einsum`, which reads weights as fast on one thread as `dot` does on two: the second one may have to be waited
    for, and 50 solver steps took from 28 to 130 ms.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Map (..., in_features) to (..., out_features)."""
        n_rows = x.numel() // self.in_features
        if (
            th.compiler.is_compiling()  # a graph is for any number of rows
            or not 0 < n_rows <= FEW_ROWS
            or self.weight.numel() < LARGE_WEIGHT
            or x.device.type != "cpu"
            or x.dtype != th.float32
            or th.is_grad_enabled()
        ):
            return F.linear(x, self.weight, self.bias)
        weight = self.weight.detach().numpy()
        y = np.empty((n_rows, self.out_features), np.float32)
        for row, out in zip(x.reshape(n_rows, -1).numpy(), y, strict=True):
            np.einsum("ij,j->i", weight, row, out=out)
        if self.bias is not None:
            y += self.bias.detach().numpy()
        return th.from_numpy(y).view(*x.shape[:-1], self.out_features)


def normal_(weight: th.Tensor, std: float) -> None:
    """
    Draw a weight from a normal distribution around 0, unless it is a shape without numbers: torch takes a second for that.

    :param weight: tensor of any shape; on the device "meta" it stays as it is
    :param std: standard deviation
    """
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)


def embedding(n_entries: int, dim: int) -> nn.Embedding:
    """torch's embedding and initial weights; torch's own way would import its compiler on "meta", which takes a second."""
    weight = th.empty(n_entries, dim)
    normal_(weight, std=1.0)
    return nn.Embedding.from_pretrained(weight, freeze=False)


def keep_mask(like: th.Tensor, probability: float) -> th.Tensor:
    """
    Factors of dropout (Srivastava et al., 2014): 0 with `probability`, otherwise what keeps the mean.

    On a CPU torch draws one double-precision number an element, from one thread. Four elements of one 64-bit number of
    NumPy's SFC64, itself seeded by torch's global generator, take an eighth of the time.

    :param like: tensor on the CPU
    :param probability: probability of a zero, in [0, 1)
    :return: factors with the shape and dtype of `like`
    """
    seed = int(th.randint(np.iinfo(np.int64).max, ()))
    raw = np.random.SFC64(seed).random_raw(-(-like.numel() // 4))
    bits = th.from_numpy(raw.view(np.int16))[: like.numel()].view(like.shape)
    n_kept = max(1, round((1.0 - probability) * LEVELS))
    mask = th.empty(like.shape, dtype=like.dtype)
    th.le(bits, n_kept - 1 - LEVELS // 2, out=mask)  # bits are from -32768 to 32767
    return mask.mul_(LEVELS / n_kept)


def dropout(x: th.Tensor, probability: float, training: bool) -> th.Tensor:
    """
    :param x: tensor of any shape
    :param probability: probability of a zero, in [0, 1)
    :param training: whether dropout applies; otherwise x stays as it is
    """
    if not training or probability == 0.0:
        return x
    return x * keep_mask(x, probability) if _draws_masks_here(x) else F.dropout(x, probability)


def dropout_add(residual: th.Tensor, x: th.Tensor, probability: float, training: bool) -> th.Tensor:
    """`residual + dropout(x)`, in one pass where masks are factors."""
    if not training or probability == 0.0 or not _draws_masks_here(x):
        return residual + dropout(x, probability, training)
    return th.addcmul(residual, x, keep_mask(x, probability))


def _draws_masks_here(x: th.Tensor) -> bool:
    """Return whether masks are drawn by NumPy; a compiled graph draws its own, fused with what uses them."""
    return x.device.type == "cpu" and not th.compiler.is_compiling()


def sinusoidal_embedding(
    tau: th.Tensor, embedding_dim: int, frequencies: tuple[float, float] = TAU_FREQUENCIES
) -> th.Tensor:
    """
    Sines and cosines at geometrically spaced frequencies.

    :param tau: numbers (...), such as times in [0, 1] or scaled returns-to-go
    :param embedding_dim: number of sines and cosines, even
    :param frequencies: lowest and highest frequency, rad
    :return: (..., embedding_dim)
    """
    low, high = map(math.log, frequencies)
    angles = tau.unsqueeze(-1) * th.exp(th.linspace(low, high, embedding_dim // 2, device=tau.device))
    return th.cat((angles.sin(), angles.cos()), dim=-1)


class FilmNetwork(nn.Module):
    """
    MLP from A to A numbers whose every hidden layer is scaled and shifted from outside (FiLM, Perez et al., 2018).

    :param action_dim: A
    :param condition_dim: width D of the hidden state h
    :param hidden_dim: width of the hidden layers
    :param n_layers: number of hidden layers
    """

    def __init__(self, action_dim: int, condition_dim: int, hidden_dim: int = 512, n_layers: int = 3) -> None:
        super().__init__()
        self.n_layers = n_layers
        self.film_dim = 2 * hidden_dim * n_layers
        sizes = [action_dim] + [hidden_dim] * n_layers
        self.layers = nn.ModuleList(Linear(sizes[i], sizes[i + 1]) for i in range(n_layers))
        self.film_condition = Linear(condition_dim, self.film_dim)
        self.output = Linear(hidden_dim, action_dim)

    def forward(self, x: th.Tensor, film: th.Tensor) -> th.Tensor:
        """
        :param x: (..., A)
        :param film: (..., 2 * hidden_dim * n_layers), scales and shifts: `film_condition(h)` and what is added to it
        :return: (..., A)
        """
        scales_and_shifts = film.chunk(2 * self.n_layers, dim=-1)
        for layer, scale, shift in zip(self.layers, scales_and_shifts[::2], scales_and_shifts[1::2], strict=True):
            x = F.silu(th.addcmul(shift, layer(x), 1.0 + scale))
        return self.output(x)


class VectorField(FilmNetwork):
    """
    Velocity v(x, tau, h): a FiLM network whose scales and shifts come from tau and h.

    The FiLM map of [psi(tau), h] is linear, so its two halves are kept apart: the half of h is computed once per action,
    the half of tau once for all times of a solver.

    :param time_embedding_dim: size of psi(tau)

    The other parameters are those of :class:`FilmNetwork`.
    """

    def __init__(
        self, action_dim: int, condition_dim: int, hidden_dim: int = 512, n_layers: int = 3, time_embedding_dim: int = 128
    ) -> None:
        super().__init__(action_dim, condition_dim, hidden_dim, n_layers)
        self.time_embedding_dim = time_embedding_dim
        self.film_time = Linear(time_embedding_dim, self.film_dim, bias=False)

    def time_share(self, tau: th.Tensor) -> th.Tensor:
        """The share of times in [0, 1], (...), in all scales and shifts: (..., 2 * hidden_dim * n_layers)."""
        return self.film_time(sinusoidal_embedding(tau, self.time_embedding_dim))


class ReturnFilm(nn.Module):
    """
    A map from a return-to-go to scales and shifts of all blocks of the Transformer: an MLP of its sines and cosines.

    Scales start apart (standard deviation 0.2 of the last weights), so that returns that differ by a tenth are told apart
    from the first gradient step on.

    :param embed_dim: width D of the Transformer, and of the hidden layer
    :param n_blocks: number of its blocks
    """

    def __init__(self, embed_dim: int, n_blocks: int) -> None:
        super().__init__()
        self.hidden = Linear(1 + RETURN_EMBEDDING_DIM, embed_dim)
        self.output = Linear(embed_dim, 2 * embed_dim * n_blocks)
        normal_(self.hidden.weight, std=0.5)
        normal_(self.output.weight, std=0.2)
        nn.init.zeros_(self.hidden.bias)
        nn.init.zeros_(self.output.bias)

    def forward(self, returns_to_go: th.Tensor) -> th.Tensor:
        """Map (B, N), scaled and clipped at 10, to (B, N, 2 * embed_dim * n_blocks)."""
        returns_to_go = returns_to_go.clamp(-RETURN_CLIP, RETURN_CLIP)
        waves = sinusoidal_embedding(returns_to_go, RETURN_EMBEDDING_DIM, RETURN_FREQUENCIES)
        return self.output(F.silu(self.hidden(th.cat((returns_to_go.unsqueeze(-1), waves), dim=-1))))
