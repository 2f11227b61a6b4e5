"""AdamW, in a few calls for a whole network: one call a parameter is a fifth of a small network's gradient step."""

import inspect
import math
from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn
from torch.optim.adamw import adamw

# State of AdamW for each parameter, by torch's names.
MOMENTS = ("step", "exp_avg", "exp_avg_sq")
# Bytes of which addresses are multiples in torch's own memory on a CPU.
ALIGNMENT = 64


class FlatTensors:
    """
    Tensors that are views of one, so that one call does for all of them what would take a call each.

    Each begins where torch would have it begin, at a multiple of 64 bytes: what is computed with it depends on that in the
    last digit. The numbers between them are zero. Whoever replaces their memory, as moving a network to another device does,
    has them laid out again at the next use.

    :param tensors: tensors of the same dtype, in the order in which they are laid out
    :ivar sizes: number of elements that each takes with the zeros behind it
    """

    def __init__(self, tensors: Iterable[th.Tensor]) -> None:
        self.tensors = list(tensors)
        self.sizes = [slot_size(tensor) for tensor in self.tensors]
        self._flat = th.empty(0)

    @th.no_grad()
    def flat(self) -> th.Tensor:
        """The tensor that they are views of."""
        first, last = self.tensors[0], self.tensors[-1]
        end = self._flat.data_ptr() + (self._flat.numel() - self.sizes[-1]) * self._flat.element_size()
        if first.data_ptr() != self._flat.data_ptr() or last.data_ptr() != end:
            self._flat = first.detach().new_zeros(sum(self.sizes))
            for tensor, part in zip(self.tensors, self.views(self._flat), strict=True):
                tensor.data = part.copy_(tensor)
        return self._flat

    @th.no_grad()
    def views(self, flat: th.Tensor) -> list[th.Tensor]:
        """Views of a tensor that is laid out alike, with the tensors' shapes."""
        parts = zip(self.tensors, flat.split(self.sizes), strict=True)
        return [part[: tensor.numel()].view(tensor.shape) for tensor, part in parts]


def slot_size(tensor: th.Tensor) -> int:
    """Number of a tensor's elements, rounded up to a multiple of 64 bytes."""
    numbers = ALIGNMENT // tensor.element_size()
    return -(-tensor.numel() // numbers) * numbers


class FlatAdamW(th.optim.AdamW):
    """
    AdamW (Loshchilov and Hutter, 2019) over one tensor that all parameters and one that all moments are views of.

    A state dict has the layout of torch's AdamW.

    :param decayed: parameters with weight decay
    :param spared: parameters without weight decay
    :param unclipped: parameters of both kinds whose gradients :meth:`clip_gradient` leaves alone
    :param lr: learning rate
    :param weight_decay: weight decay of `decayed`
    """

    # torch's own methods without the mark for its compiler, which loads the compiler: a second and a half of each start.
    add_param_group = inspect.unwrap(th.optim.Optimizer.add_param_group)
    state_dict = inspect.unwrap(th.optim.Optimizer.state_dict)
    load_state_dict = inspect.unwrap(th.optim.Optimizer.load_state_dict)
    _drop_gradients = inspect.unwrap(th.optim.Optimizer.zero_grad)

    # 1 for a gradient step that changes nothing, else 0; a GPU decides by it without a host that waits.
    found_inf: th.Tensor | None = None

    def __init__(
        self,
        decayed: list[nn.Parameter],
        spared: list[nn.Parameter],
        unclipped: Iterable[nn.Parameter],
        lr: float,
        weight_decay: float,
    ) -> None:
        groups = [{"params": decayed, "weight_decay": weight_decay}, {"params": spared, "weight_decay": 0.0}]
        super().__init__(groups, lr=lr, fused=True)
        apart = {id(parameter) for parameter in unclipped}
        # Clipped parameters lie in the middle, in one piece.
        decayed = sorted(decayed, key=lambda parameter: id(parameter) not in apart)
        spared = sorted(spared, key=lambda parameter: id(parameter) in apart)
        self.parameters = [*decayed, *spared]
        self._weights = FlatTensors(self.parameters)
        self._moments: dict[str, FlatTensors] = {}
        self._memory: th.Tensor | None = None
        self._parts_of_memory: list[th.Tensor] = []  # one for each parameter
        self._clipped_parts_of_memory: list[th.Tensor] = []
        self._gradient: th.Tensor | None = None  # clipped, for the next step
        self._is_even = True  # all parameters have had as many steps
        self._clipped_parameters = [parameter for parameter in self.parameters if id(parameter) not in apart]
        n_decayed, n_weights = (sum(map(slot_size, each)) for each in (decayed, self.parameters))
        self._parts = (slice(0, n_decayed), slice(n_decayed, n_weights))
        first, last = (sum(slot_size(p) for p in part if id(p) in apart) for part in (decayed, spared))
        self._clipped = slice(first, n_weights - last)

    def flat_weights(self) -> th.Tensor:
        """All weights and the zeros between them, (N,)."""
        return self._weights.flat()

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Reset gradients as torch does."""
        self._drop_gradients(set_to_none)
        self._gradient = None

    def clip_gradient(self, max_norm: float) -> th.Tensor:
        """
        Scale the gradients down to a norm, as `torch.nn.utils.clip_grad_norm_` does, and keep them for :meth:`step`.

        :param max_norm: largest norm of the gradients of all parameters that are not left alone
        :return: norm that they had
        """
        gradient = self._flat_gradient()
        if gradient is None:
            return nn.utils.clip_grad_norm_(self._clipped_parameters, max_norm)
        self._gradient = gradient
        norm = gradient[self._clipped].norm()
        if max_norm < math.inf:
            # Not the zeros in between, which a norm that is not finite would fill with NaN for good.
            th._foreach_mul_(self._clipped_parts_of_memory, (max_norm / (norm + 1e-6)).clamp(max=1.0))
            for parameter, part in zip(self.parameters, self._parts_of_memory, strict=True):
                parameter.grad = part
        return norm

    @th.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step; `found_inf` decides whether it counts."""
        gradient = self._flat_gradient() if self._gradient is None else self._gradient
        self._gradient = None
        self._is_even &= gradient is not None
        steps, mean, square = self._flat_moments()
        if gradient is None or not self._is_even:
            super().step(closure)
            return
        weights = self.flat_weights()
        for group, part in zip(self.param_groups, self._parts, strict=True):
            count = steps[0].clone()
            settings = {name: group[name] for name in ("lr", "weight_decay", "eps", "amsgrad", "maximize")}
            beta1, beta2 = group["betas"]
            adamw(
                [weights[part]], [gradient[part]], [mean[part]], [square[part]], [], [count],
                fused=True, found_inf=self.found_inf, beta1=beta1, beta2=beta2, **settings,
            )  # fmt: skip
        steps.copy_(count)

    @th.no_grad()
    def _flat_gradient(self) -> th.Tensor | None:
        """All gradients, (N,), in memory that is used again; None where a parameter has none, as one that is frozen."""
        gradients = [parameter.grad for parameter in self.parameters]
        if any(gradient is None for gradient in gradients):
            return None
        weights = self.flat_weights()
        if self._memory is None or self._memory.device != weights.device:
            self._memory = th.zeros_like(weights)
            self._parts_of_memory = self._weights.views(self._memory)
            clipped = {id(parameter) for parameter in self._clipped_parameters}
            parts = zip(self.parameters, self._parts_of_memory, strict=True)
            self._clipped_parts_of_memory = [part for parameter, part in parts if id(parameter) in clipped]
        th._foreach_copy_(self._parts_of_memory, gradients)  # type: ignore[arg-type]
        return self._memory

    def _flat_moments(self) -> tuple[th.Tensor, ...]:
        """The number of steps of each parameter, and mean and mean square of the gradients, (N,) each."""
        self._begin()
        first, last = (self.state[parameter] for parameter in (self.parameters[0], self.parameters[-1]))
        for name in MOMENTS:
            kept = self._moments.get(name)
            if kept is None or first[name] is not kept.tensors[0] or last[name] is not kept.tensors[-1]:
                self._moments[name] = FlatTensors(self.state[parameter][name] for parameter in self.parameters)
                if name == "step":
                    self._is_even = len({float(each) for each in self._moments[name].tensors}) == 1
        return tuple(self._moments[name].flat() for name in MOMENTS)

    def _begin(self) -> None:
        """Zeros for each parameter that has had no step, as torch's AdamW begins."""
        if len(self.state) == len(self.parameters):
            return
        for parameter in (parameter for group in self.param_groups for parameter in group["params"]):
            state, like = self.state[parameter], parameter.detach()
            if not state:
                zeros = (th.zeros((), device=like.device), th.zeros_like(like), th.zeros_like(like))
                state.update(zip(MOMENTS, zeros, strict=True))
