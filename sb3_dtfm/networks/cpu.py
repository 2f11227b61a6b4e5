"""
What only makes a CPU faster: dropout masks, products of few rows, and memory for kept keys and values. Without this file the
numbers would be the same.

Measured on 2 cores of an AMD EPYC with AVX2, in microseconds, with weights that lie outside of the cache:

| product | rows | torch | NumPy |
| --- | --- | --- | --- |
| 128 x 128 | 1 / 3 | 17 / 23 | 20 / 27 |
| 128 x 512 | 1 / 3 | 52 / 82 | 38 / 47 |
| 256 x 768 | 1 / 3 | 116 / 191 | 90 / 116 |
| 256 x 1024 | 1 / 3 | 149 / 252 | 112 / 110 |
| 256 x 3072 | 1 / 3 | 458 / 910 | 182 / 332 |

NumPy's times are those of `dot` on two threads that nobody disturbs, see :class:`Linear`.

All weights of a small model stay in the cache, and there torch is the faster one up to `LARGE_WEIGHT`.

Keys and values, copied at every step instead of appended to, make an action for 16 environments at the paper's size
take 21 % longer (19 MB). A dropout mask takes an eighth of torch's time.
"""

import contextlib

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
# Steps that fit behind what is kept before it moves to new memory.
ROOM = 20


class Linear(nn.Linear):
    """
    torch's linear layer; few rows times a large weight on a CPU, without gradients, by NumPy.

    By `einsum`, which reads weights as fast on one thread as `dot` does on two; of these the second may have to be waited
    for, and 50 solver steps took from 28 to 130 ms.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """From (..., in_features) to (..., out_features)."""
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

    :param weight: any shape; on the device "meta" it stays as it is
    :param std: standard deviation
    """
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)


def keep_mask(like: th.Tensor, probability: float) -> th.Tensor:
    """
    Factors of dropout (Srivastava et al., 2014): 0 with `probability`, otherwise what keeps the mean.

    On a CPU torch draws one double-precision number an element, from one thread. Four elements of one 64-bit number of
    NumPy's SFC64, itself seeded by torch's global generator, take an eighth of the time.

    :param like: tensor on the CPU
    :param probability: of a zero, in [0, 1)
    :return: shape and dtype of `like`
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
    :param x: any shape
    :param probability: of a zero
    :param training: leave x alone if not
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
    """A compiled graph draws its own, fused with what uses them."""
    return x.device.type == "cpu" and not th.compiler.is_compiling()


class KeyValueCache(np.ndarray):
    """
    Keys and values of earlier steps, (B, layers, 2, L, D), which never change, and the memory behind them.

    :ivar behind: that memory, shaped like this but longer, and where these end in it: for the first who takes it, from
        whatever thread. Copies have none, nor has what NumPy computes.
    """

    behind: list[tuple[th.Tensor, int]]


def make_cache(memory: th.Tensor, start: int, end: int) -> KeyValueCache:
    """
    :param memory: (B, layers, 2, M, D), on any device
    :param start: of what is kept, along the fourth axis
    :param end: of what is kept
    """
    kept = memory[..., start:end, :].cpu().numpy().view(KeyValueCache)
    kept.behind = [(memory, end)]
    return kept


def reserve_cache(kept: np.ndarray, n_tokens: int, device: th.device) -> tuple[th.Tensor, int]:
    """
    :param kept: what :func:`make_cache` gave, a copy of it, or another array like it
    :param n_tokens: how many will be appended
    :param device: where they will
    :return: memory with room for them that is nobody else's, and where `kept` ends in it
    """
    with contextlib.suppress(IndexError):
        memory, end = getattr(kept, "behind", []).pop()
        if end + n_tokens <= memory.shape[3] and memory.device == device:
            return memory, end
    end = kept.shape[3]
    memory = th.empty(*kept.shape[:3], end + ROOM * n_tokens, kept.shape[4], device=device)
    memory[..., :end, :] = th.from_numpy(kept).to(device)
    return memory, end
