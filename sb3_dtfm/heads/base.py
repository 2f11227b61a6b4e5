"""Interface of a head for the policy, the algorithm, RL-Zoo and the benchmark."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch as th
from torch import nn

from sb3_dtfm.arguments import Options

# Rows of the table that deterministic acting takes its noise from.
NOISE_ROWS = 1024


class ActionHead(nn.Module, ABC):
    """
    A map from hidden states to actions in [-1, 1].

    :param embed_dim: width D of the hidden states
    :param action_dim: A
    :param options: options of `options_class` by name, which users give among `policy_kwargs`
    :raises ValueError: an option out of range, by name

    :cvar algorithm: name of the algorithm that Transformer and head make together, for example "DTFM"
    :cvar discrete: the head for Discrete action spaces, with this head's options; None refuses them
    :cvar options_class: the head's options
    :ivar options: options that the head was made with and acts by; :meth:`Options.changed` gives other ways of acting
    :ivar noise_dim: number of standard normal values that an action starts from, 0 if none
    """

    algorithm: ClassVar[str]
    discrete: ClassVar[type["ActionHead"] | None] = None
    options_class: ClassVar[type[Options]] = Options
    options: Any
    noise_dim: int = 0

    def __init__(self, embed_dim: int, action_dim: int, **options: Any) -> None:
        super().__init__()
        self.options = self.options_class(**options)

    @property
    def noise_decides(self) -> bool:
        """Return whether other noise leads to other actions, as the head acts now."""
        return self.noise_dim > 0

    def deterministic_noise(self, generator: th.Generator) -> th.Tensor:
        """
        Noise table of deterministic acting, saved with the weights: rows that it takes one after the other.

        :param generator: random number generator of the table
        :return: table (R, noise_dim)
        """
        return th.randn(NOISE_ROWS, self.noise_dim, generator=generator, device=generator.device)

    def draw_noise(self, actions: th.Tensor, generator: th.Generator) -> tuple[th.Tensor, ...]:
        """
        Random numbers of the loss, drawn apart from it, so that the loss is a plain function.

        :param actions: actions (B, K, A) of the batch
        :param generator: random number generator on the device of `actions`
        :return: further arguments of :meth:`loss`, each (B, ...)
        """
        return ()

    @abstractmethod
    def loss(
        self, hidden: th.Tensor, actions: th.Tensor, mask: th.Tensor, *noise: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param hidden: (B, K, D)
        :param actions: (B, K, A) in [-1, 1]
        :param mask: (B, K) bool, False on padded steps
        :param noise: noise that :meth:`draw_noise` drew
        :return: the loss to minimise, a mean over valid steps, and its parts by their logged names
        """

    def part_masks(self, mask: th.Tensor) -> dict[str, th.Tensor]:
        """
        Parts of the loss that are means over some of the valid steps only; each is a plain summand of the loss.

        :param mask: mask (B, K) bool of a batch
        :return: mask (B, ...) bool of the steps of each such part, by its logged name
        """
        return {}

    def unclipped_parameters(self) -> list[nn.Parameter]:
        """Parameters that neither count into the gradient's norm nor are clipped with the others."""
        return []

    @abstractmethod
    def forward(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        :param hidden: (..., D)
        :param noise: (..., noise_dim), standard normal
        :return: actions (..., A), to be clipped to [-1, 1]
        """

    @staticmethod
    def search_space(trial: Any) -> dict[str, Any]:
        """
        Options that a hyperparameter search draws.

        :param trial: Optuna's trial; numbers that are powers of two are drawn by their exponent, named `<option>_pow`
        """
        return {}


def masked_mean(values: th.Tensor, mask: th.Tensor) -> th.Tensor:
    """
    Mean over valid steps and all action dimensions.

    :param values: (..., A)
    :param mask: (...) bool, at least one True
    """
    per_step = values.float().mean(dim=-1)
    return (per_step * mask).sum() / mask.sum()
