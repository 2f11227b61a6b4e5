"""Dropout whose masks cost little on a CPU."""

import numpy as np
import torch as th
from torch.nn import functional as F

# Masks are drawn with 16 random bits an element: probabilities are multiples of 1 / 65536.
LEVELS = 1 << 16


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
