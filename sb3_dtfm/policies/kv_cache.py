"""What acting keeps of its earlier computation, without copying it at every step."""

import numpy as np
import torch as th

# Tokens that a step adds: the last action, the return-to-go and the observation.
TOKENS_PER_STEP = 3
# Steps that fit behind what is kept before it has to move to a new place.
ROOM = 20


class KeysValuesCache:
    """
    Appends a step's keys and values behind those that are kept, in the same memory where nobody can notice.

    What is handed out belongs to a state and must never change. Whoever comes back with the newest state goes on behind it:
    older states end before that. Any other state is copied first.
    """

    def __init__(self) -> None:
        self._memory = th.empty(0)
        self._end = 0
        self._newest: np.ndarray | None = None

    def with_next_step(self, kept: np.ndarray, device: th.device) -> th.Tensor:
        """
        :param kept: (B, layers, 2, L, D)
        :param device: where it is needed
        :return: (B, layers, 2, L + 3, D): what is kept, and room for the next step's tokens to be filled in
        """
        n_kept = kept.shape[3]
        if kept is not self._newest or self._end + TOKENS_PER_STEP > self._memory.shape[3]:
            self._newest = None
            shape = (*kept.shape[:3], n_kept + ROOM * TOKENS_PER_STEP, kept.shape[4])
            self._memory = th.empty(shape, device=device)
            self._memory[:, :, :, :n_kept] = th.from_numpy(kept).to(device)
            self._end = n_kept
        return self._memory[:, :, :, self._end - n_kept : self._end + TOKENS_PER_STEP]

    def keep(self, keys_values: th.Tensor) -> np.ndarray:
        """
        The state's share of what :meth:`with_next_step` gave, once it is filled in.

        :param keys_values: (B, layers, 2, L + 3, D)
        :return: (B, layers, 2, L, D), without the oldest step
        """
        self._end += TOKENS_PER_STEP  # only now: a call that failed on the way has left all as it was
        self._newest = keys_values[:, :, :, TOKENS_PER_STEP:].cpu().numpy()
        return self._newest
