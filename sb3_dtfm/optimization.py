"""Small parts of the learn loop: learning rate, precision, and means of what was measured."""

import math

import torch as th

LEARNING_RATE_SCHEDULES = ("constant", "linear", "cosine")
PRECISIONS = ("auto", "float32", "bfloat16")


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


class RunningMeans:
    """Means of scalars, summed on their device: reading each value would wait for it."""

    def __init__(self) -> None:
        self._sums: dict[str, th.Tensor] = {}
        self.n_values = 0

    def add(self, values: dict[str, th.Tensor]) -> None:
        """
        Count one more step.

        :param values: scalars by name, the same names each time
        """
        for name, value in values.items():
            total = self._sums.get(name)
            self._sums[name] = value.detach().clone() if total is None else total.add_(value.detach())
        self.n_values += 1

    def pop(self) -> dict[str, float]:
        """The means since the last call, and a fresh start."""
        means = {name: float(total) / self.n_values for name, total in self._sums.items()}
        self._sums, self.n_values = {}, 0
        return means
