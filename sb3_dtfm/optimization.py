"""Small parts of the learn loop: learning rate, precision, threads, and means of what was measured."""

import contextlib
import functools
import math
import os
import re
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

LEARNING_RATE_SCHEDULES = ("constant", "linear", "cosine")
PRECISIONS = ("auto", "float32", "bfloat16")
# Logged numbers that have to be finite.
FINITE = ("loss", "grad_norm", "critic_loss")
# Rows and repetitions of the products that decide which precision is faster on a CPU.
TIMED_ROWS, N_TIMES = 512, 5
# Multiplications of a gradient step up to which one thread is as quick as two, which wait for one another.
ONE_THREADS_MACS = 3e9


def learning_rate_factor(schedule: str, step: int, progress: float, warmup_steps: int = 0) -> float:
    """
    Factor of the learning rate.

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
    """Return whether the hardware has instructions for matrix products in bfloat16, which need not be faster."""
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    return th.cpu._is_avx512_bf16_supported() or th.cpu._is_amx_tile_supported()


def choose_precision(network: nn.Module, n_rows: int, device: th.device, n_processes: int = 1) -> tuple[str, str]:
    """
    Precision of "auto", and why: bfloat16 where the hardware multiplies in it, on a CPU only if that is faster than
    float32 for the network's own products, which are timed once for each process.

    :param network: network whose linear layers and convolutions count, the latter as products of an output's weights
    :param n_rows: rows that a gradient step multiplies by a weight
    :param device: device that training runs on
    :param n_processes: number of processes that train together, each of which would measure for itself
    :return: "float32" or "bfloat16", and a sentence
    """
    if device.type == "cpu" and n_processes > 1:
        return "float32", "Matrix products are in float32: each of several processes would measure for itself."
    if not multiplies_bfloat16(device):
        return "float32", f"Matrix products are in float32: this {device.type} has no instructions for bfloat16."
    if device.type == "cuda":
        return "bfloat16", "Matrix products are in bfloat16, which this GPU has instructions for."
    weights = [layer.weight.flatten(1) for layer in network.modules() if isinstance(layer, nn.Linear | nn.Conv2d)]
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
    :param shapes: shapes of the weights, (outputs, inputs)
    :param n_rows: number of rows that are multiplied by the weights
    :param n_threads: number of threads that torch uses, for which the result is cached
    :return: shortest of a few times, ms
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
    :param device: device that training runs on
    """
    return th.autocast(device.type, dtype=th.bfloat16, enabled=precision == "bfloat16")


@contextlib.contextmanager
def limit_threads(n_macs: float) -> Iterator[None]:
    """
    One thread for little work; as many as ever for more, or where `OMP_NUM_THREADS` is set.

    :param n_macs: number of multiplications in the work
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


@functools.cache
def total_memory(device: th.device) -> int:
    """Bytes of memory that a device has, free or not."""
    if device.type == "cuda":
        return int(th.cuda.get_device_properties(device).total_memory)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**63


@contextlib.contextmanager
def explain_out_of_memory(device: th.device, sizes: Callable[[], str], n_bytes: int = 0) -> Iterator[None]:
    """
    :param device: device that training runs on
    :param sizes: function that tells the settings that decide how much is needed
    :param n_bytes: memory needed at least, bytes; more than the device has is refused before an operating system ends the
        process
    :raises MemoryError: in place of any error of memory, with these settings
    """
    there = total_memory(device)
    if n_bytes > there:
        found = f"A gradient step takes at least {n_bytes / 1e9:,.1f} GB, and {device} has {there / 1e9:,.1f}"
        raise MemoryError(f"{found}: {sizes()}. Lower batch_size first.")
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        # On a CPU torch has no class for it.
        if isinstance(error, RuntimeError) and not re.search("out of memory|(allocate|enough) memory", str(error), re.I):
            raise
        raise MemoryError(
            f"A gradient step does not fit into the memory of {device}: {sizes()}. Lower batch_size first."
        ) from error


def check_finite(means: dict[str, float], where: Callable[[], str], last_saved: str | None) -> None:
    """
    :param means: means of the logged values, by name
    :param where: function that names the gradient steps
    :param last_saved: path of the last checkpoint; None if there is none
    :raises FloatingPointError: one of `FINITE` is not finite
    """
    for name in FINITE:
        if not math.isfinite(means.get(name, 0.0)):
            raise FloatingPointError(
                f"The {name} became {means[name]} {where()}. Such steps change no weight, so the last checkpoint is good: "
                f"{last_saved or 'none was saved since this model was made or loaded'}. Try a lower learning_rate, "
                "warmup_steps or max_grad_norm."
            )


class RunningMeans:
    """
    Means of scalars, summed on their device: reading each value would wait for it.

    :param sums: sums of earlier values to go on from, as :meth:`sums` returns them; none by default
    :param n_values: number of earlier values in each sum
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


# Purpose of each number of a run's random stream.
BATCHES, NOISE, DROPOUT, TRANSITIONS, OWN_BATCHES = range(5)


def step_seed(seed: int, n_updates: int, *purpose: int) -> int:
    """
    Seed of a generator for one gradient step.

    Each step has a seed of its own, so that a run that was interrupted goes on as if it had not been.

    :param seed: seed of the run
    :param n_updates: gradient steps that the model has had
    :param purpose: `BATCHES` or one of the constants beside it, and the process's number where each process draws its own
    """
    return int(np.random.SeedSequence([seed, n_updates, *purpose]).generate_state(1, np.uint64)[0])


def seed_default_generator(device: th.device, seed: int) -> None:
    """
    Seed the generator that dropout draws from; `torch.manual_seed` takes a thousand times as long.

    :param device: device of the network
    :param seed: new seed
    """
    if device.type == "cuda":
        th.cuda.manual_seed(seed)
    else:
        th.default_generator.manual_seed(seed)
