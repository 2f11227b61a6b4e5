"""The keys and values that acting keeps, without a copy of all of them at every step."""

import contextlib

import numpy as np
import torch as th

# Steps that fit behind what is kept before it moves to new memory.
ROOM = 20


class Kept(np.ndarray):
    """
    Keys and values of earlier steps, (B, layers, 2, L, D), which never change, and the memory behind them.

    :ivar behind: that memory, shaped like this but longer, and where these end in it: for the first who takes it, from
        whatever thread. Copies have none, nor has what NumPy computes.
    """

    behind: list[tuple[th.Tensor, int]]


def hand_out(memory: th.Tensor, start: int, end: int) -> Kept:
    """
    :param memory: (B, layers, 2, M, D), on any device
    :param start: of what is kept, along the fourth axis
    :param end: of what is kept
    """
    kept = memory[..., start:end, :].cpu().numpy().view(Kept)
    kept.behind = [(memory, end)]
    return kept


def take_up(kept: np.ndarray, n_tokens: int, device: th.device) -> tuple[th.Tensor, int]:
    """
    :param kept: what :func:`hand_out` gave, a copy of it, or another array like it
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
