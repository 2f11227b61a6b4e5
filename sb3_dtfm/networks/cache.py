"""
Acting on the cached keys and values of earlier steps: it takes one step's tokens instead of a whole window's.

Keys and values, copied at every step instead of appended to, make an action for 16 environments at the paper's size take
21 % longer (19 MB).
"""

import contextlib

import numpy as np
import torch as th

from sb3_dtfm.networks.trunk import SequenceTrunk, TransformerBlock, scale_and_shift

# Steps that fit behind what is kept before it moves to new memory.
ROOM = 20


def extend(
    trunk: SequenceTrunk,
    observations: th.Tensor,
    actions: th.Tensor,
    returns_to_go: th.Tensor,
    timesteps: th.Tensor,
    mask: th.Tensor,
    keys_values: th.Tensor,
) -> tuple[th.Tensor, list[th.Tensor]]:
    """
    The newest step's hidden state from the keys and values of earlier steps.

    Three new tokens are the last action, the return-to-go and the observation. They attend to the same steps as in
    :meth:`SequenceTrunk.forward`; but a kept step was itself computed with the steps before it, which reach back further
    than this window once it slides. Equal to `forward` for the first K steps of an episode, and to attention with a band of
    K steps over the whole episode from then on.

    :param trunk: Transformer whose weights are used
    :param observations: (B, K, O); this and the others as for `forward`, of which the last two steps are read
    :param keys_values: (B, layers, 2, L, D) for the L tokens of K steps (:meth:`SequenceTrunk.n_tokens`), any finite number
        where `mask` is False; those of the last `tokens_per_step` tokens are filled in, see :func:`fill_in`
    :return: (B, D) hidden state, and the keys and values of each layer, (B, 2, L, D)
    """
    n_new = trunk.tokens_per_step
    newest = (x[:, -2:] for x in (observations, actions, returns_to_go, timesteps, mask))
    tokens = trunk.embed(*newest)[:, -n_new:]
    attention_bias = trunk.attention_bias(mask, keys_values.shape[3])[:, :, -n_new:]
    filled = list(keys_values.unbind(dim=1))
    for i, (block, film) in enumerate(zip(trunk.blocks, trunk.films(returns_to_go[:, -2:]), strict=True)):
        assert isinstance(block, TransformerBlock)
        tokens = scale_and_shift(tokens, None if film is None else film[:, -n_new:])
        query, key, value = block.attention_in(block.attention_norm(tokens)).split(tokens.shape[-1], dim=-1)
        filled[i] = fill_in(filled[i], key, value)
        tokens = block.finish(tokens, block.attend(query, filled[i][:, 0], filled[i][:, 1], attention_bias))
    return trunk.final_norm(tokens[:, -1]), filled


def extend_cache(trunk: SequenceTrunk, windows: dict[str, th.Tensor], cache: np.ndarray) -> tuple[th.Tensor, np.ndarray]:
    """
    The newest hidden states from what was kept, and what to keep for the next step.

    :param trunk: Transformer whose weights are used
    :param windows: (B, K, ...), normalised, by the names of `SequenceTrunk.forward`
    :param cache: (B, layers, 2, L, D) for the L tokens before the newest, or (B, 0) if the last steps were acted without
    :return: (B, D) hidden states, and the new cache
    """
    mask = windows["mask"]
    n_new = trunk.tokens_per_step
    n_kept = trunk.n_tokens(mask.shape[1]) - n_new
    shape = (len(mask), trunk.n_layers, 2, n_kept, trunk.embed_dim)
    n_missing = 0
    if cache.shape != shape:
        cache = np.zeros(shape, np.float32)
        n_missing = int(mask.sum(dim=1).max()) - 1
    for n_back in range(n_missing, -1, -1):
        earlier = {name: x.roll(n_back, dims=1) for name, x in windows.items()} if n_back else windows
        earlier["mask"][:, :n_back] = False  # the newest steps went round to the left
        memory, end = reserve_cache(cache, n_new, mask.device)
        start, end = end - n_kept, end + n_new
        hidden, _ = extend(trunk, **earlier, keys_values=memory[..., start:end, :])
        cache = make_cache(memory, start + n_new, end)
    return hidden, cache


def fill_in(keys_values: th.Tensor, key: th.Tensor, value: th.Tensor) -> th.Tensor:
    """
    Keys and values with those of the last N tokens: in place, but for a graph, which has no memory to write into.

    :param keys_values: (B, 2, L, D)
    :param key: (B, N, D)
    :param value: (B, N, D)
    :return: (B, 2, L, D)
    """
    n_new = key.shape[1]
    if th.compiler.is_compiling():
        return th.cat((keys_values[:, :, :-n_new], th.stack((key, value), dim=1)), dim=2)
    keys_values[:, 0, -n_new:] = key
    keys_values[:, 1, -n_new:] = value
    return keys_values


class KeyValueCache(np.ndarray):
    """
    Keys and values of earlier steps, (B, layers, 2, L, D), which never change, and the memory behind them.

    :ivar behind: that memory, shaped like this but longer, and the position where these end in it: for the first who takes
        it, from whatever thread. Copies have none, nor have NumPy's results.
    """

    behind: list[tuple[th.Tensor, int]]


def make_cache(memory: th.Tensor, start: int, end: int) -> KeyValueCache:
    """
    :param memory: (B, layers, 2, M, D), on any device
    :param start: first token to keep, along the fourth axis
    :param end: end of the tokens to keep, exclusive
    """
    kept = memory[..., start:end, :].cpu().numpy().view(KeyValueCache)
    kept.behind = [(memory, end)]
    return kept


def reserve_cache(kept: np.ndarray, n_tokens: int, device: th.device) -> tuple[th.Tensor, int]:
    """
    :param kept: cache that :func:`make_cache` returned, a copy of it, or another array like it
    :param n_tokens: number of tokens that will be appended
    :param device: device of the tokens that will be appended
    :return: memory with room for them that no other call uses, and the position where `kept` ends in it
    """
    with contextlib.suppress(IndexError):
        memory, end = getattr(kept, "behind", []).pop()
        if end + n_tokens <= memory.shape[3] and memory.device == device:
            return memory, end
    end = kept.shape[3]
    memory = th.empty(*kept.shape[:3], end + ROOM * n_tokens, kept.shape[4], device=device)
    memory[..., :end, :] = th.from_numpy(kept).to(device)
    return memory, end
