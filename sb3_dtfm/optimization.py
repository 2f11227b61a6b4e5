"""Small parts of the learn loop: learning rate, precision, threads, and means of what was measured."""

import contextlib
import math
import os
from collections.abc import Iterator

import numpy as np
import torch as th

LEARNING_RATE_SCHEDULES = ("constant", "linear", "cosine")
PRECISIONS = ("auto", "float32", "bfloat16")
# Multiplications of a gradient step up to which one thread is as quick as two, which wait for one another.
ONE_THREADS_PRODUCTS = 3e9


def learning_rate_factor(schedule: str, step: int, progress: float, warmup_steps: int = 0) -> float:
    """
    What the learning rate is multiplied by.

    :param schedule: "constant", or "linear" or "cosine" down to zero at the end
    :param step: gradient steps done
    :param progress: share of the training done, from 0 to 1
    :param warmup_steps: steps over which the factor also rises linearly from zero
    """
    factor = min(1.0, (step + 1) / warmup_steps) if warmup_steps else 1.0
    if schedule == "linear":
        factor *= 1.0 - progress
    elif schedule == "cosine":
        factor *= 0.5 * (1.0 + math.cos(math.pi * progress))
    return factor


def has_fast_bfloat16(device: th.device) -> bool:
    """Whether matrix products in bfloat16 are faster than in float32 on this device."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    return th.cpu._is_avx512_bf16_supported() or th.cpu._is_amx_tile_supported()


def autocast(precision: str, device: th.device) -> th.autocast:
    """
    The context that training computes its loss in.

    :param precision: one of `PRECISIONS`; "auto" is bfloat16 where the hardware multiplies in it, else float32
    :param device: where training runs
    """
    use_bfloat16 = precision == "bfloat16" or (precision == "auto" and has_fast_bfloat16(device))
    return th.autocast(device.type, dtype=th.bfloat16, enabled=use_bfloat16)


@contextlib.contextmanager
def threads_that_pay(n_products: float) -> Iterator[None]:
    """
    One thread for little work; as many as ever for more, and where `OMP_NUM_THREADS` says how many.

    :param n_products: multiplications of the work
    """
    n_threads = th.get_num_threads()
    if n_products > ONE_THREADS_PRODUCTS or n_threads == 1 or "OMP_NUM_THREADS" in os.environ:
        yield
        return
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(n_threads)


class RunningMeans:
    """
    Means of scalars, summed on their device: reading each value would wait for it.

    :param sums: of :meth:`sums` and `n_values`, to go on from
    """

    def __init__(self, sums: dict[str, float] | None = None, n_values: int = 0) -> None:
        self._sums = {name: th.tensor(total) for name, total in (sums or {}).items()}
        self.n_values = n_values

    def add(self, values: dict[str, th.Tensor]) -> None:
        """
        Count one more step.

        :param values: scalars by name, the same names each time
        """
        for name, value in values.items():
            total = self._sums.get(name)
            self._sums[name] = value.detach().clone() if total is None else total.to(value.device).add_(value.detach())
        self.n_values += 1

    def sums(self) -> dict[str, float]:
        """The sums of what was added, as they are."""
        return {name: float(total) for name, total in self._sums.items()}

    def pop(self) -> dict[str, float]:
        """The means since the last call, and a fresh start."""
        means = {name: total / self.n_values for name, total in self.sums().items()}
        self._sums, self.n_values = {}, 0
        return means


# What each number of a run's random stream is for.
BATCHES, NOISE, DROPOUT, TRANSITIONS, OWN_BATCHES = range(5)


def step_seed(seed: int, n_updates: int, *purpose: int) -> int:
    """
    What a generator is seeded with for one gradient step.

    Each step has a seed of its own, so that a run that was interrupted goes on as if it had not been.

    :param seed: of the run
    :param n_updates: gradient steps that the model has had
    :param purpose: one of `BATCHES` and those beside it, and the process where each draws its own
    """
    return int(np.random.SeedSequence([seed, n_updates, *purpose]).generate_state(1, np.uint64)[0])


def seed_default_generator(device: th.device, seed: int) -> None:
    """
    Seed what dropout draws from; `torch.manual_seed` takes a thousand times as long.

    :param device: of the network
    :param seed: any
    """
    if device.type == "cuda":
        th.cuda.manual_seed(seed)
    else:
        th.default_generator.manual_seed(seed)
