"""Small parts of the learn loop: learning rate, precision, threads, and means of what was measured."""

import contextlib
import functools
import math
import os
import time
from collections.abc import Iterator

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

LEARNING_RATE_SCHEDULES = ("constant", "linear", "cosine")
PRECISIONS = ("auto", "float32", "bfloat16")
# Rows and repetitions that decide which of them is faster on a CPU.
TIMED_ROWS, N_TIMES = 512, 5
# Multiplications of a gradient step up to which one thread is as quick as two, which wait for one another.
ONE_THREADS_MACS = 3e9


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


def multiplies_bfloat16(device: th.device) -> bool:
    """Whether the hardware has instructions for matrix products in bfloat16, which need not be faster."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    return th.cpu._is_avx512_bf16_supported() or th.cpu._is_amx_tile_supported()


def choose_precision(network: nn.Module, n_rows: int, device: th.device) -> tuple[str, str]:
    """
    What the precision "auto" is, and why: bfloat16 where the hardware multiplies in it, on a CPU only if that is faster than
    float32 for the network's own products, which are timed once for each process.

    :param network: its linear layers count
    :param n_rows: rows that a gradient step multiplies by a weight
    :param device: where training runs
    :return: "float32" or "bfloat16", and a sentence
    """
    if not multiplies_bfloat16(device):
        return "float32", f"Matrix products are in float32: this {device.type} has no instructions for bfloat16."
    if device.type == "cuda":
        return "bfloat16", "Matrix products are in bfloat16, which this GPU has instructions for."
    weights = (layer.weight for layer in network.modules() if isinstance(layer, nn.Linear))
    shapes = tuple(sorted({(weight.shape[0], weight.shape[1]) for weight in weights}))
    ms = {name: products_ms(name, shapes, min(n_rows, TIMED_ROWS), th.get_num_threads()) for name in PRECISIONS[1:]}
    fastest = min(ms, key=lambda name: ms[name])
    measured = ", ".join(f"{name} {each:.2f} ms" for name, each in ms.items())
    return fastest, f"Matrix products are in {fastest}, the faster one here: {measured}."


@functools.cache
def products_ms(precision: str, shapes: tuple[tuple[int, int], ...], n_rows: int, n_threads: int) -> float:
    """
    Milliseconds of one linear layer of each shape on the CPU, forward and backward.

    :param precision: "float32" or "bfloat16"
    :param shapes: of the weights, (outputs, inputs)
    :param n_rows: of what is multiplied by them
    :param n_threads: that torch uses, a part of what is remembered
    :return: the shortest of a few times
    """
    layers = [(th.ones(n_rows, n, requires_grad=True), th.ones(m, n, requires_grad=True)) for m, n in shapes]
    times = []
    for _ in range(N_TIMES):
        start = time.perf_counter()
        for x, weight in layers:
            with autocast(precision, x.device):
                product = F.linear(x, weight)
            product.sum().backward()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times)


def autocast(precision: str, device: th.device) -> th.autocast:
    """
    The context that training computes its loss in.

    :param precision: "float32" or "bfloat16"
    :param device: where training runs
    """
    return th.autocast(device.type, dtype=th.bfloat16, enabled=precision == "bfloat16")


@contextlib.contextmanager
def limit_threads(n_macs: float) -> Iterator[None]:
    """
    One thread for little work; as many as ever for more, and where `OMP_NUM_THREADS` says how many.

    :param n_macs: multiplications of the work
    """
    n_threads = th.get_num_threads()
    if n_macs > ONE_THREADS_MACS or n_threads == 1 or "OMP_NUM_THREADS" in os.environ:
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
