"""MLPs that are scaled and shifted from outside: the vector field of a flow, and its short cut."""

import math

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.networks.cpu import Linear, normal_

# Lowest and highest frequency in rad: higher ones would change faster than a solver's step can follow.
TAU_FREQUENCIES = (1.0, 100.0)
# Higher ones tell the episodes of one agent apart, and each is then learned for itself.
RETURN_FREQUENCIES = (1.0, 8.0)
RETURN_EMBEDDING_DIM = 16
# Data are at about 1. The factors of ten blocks multiply: of a return of 100 they would leave the range of float32.
RETURN_CLIP = 10.0


def sinusoidal_embedding(
    tau: th.Tensor, embedding_dim: int, frequencies: tuple[float, float] = TAU_FREQUENCIES
) -> th.Tensor:
    """
    Sines and cosines at geometrically spaced frequencies.

    :param tau: (...), about [0, 1]
    :param embedding_dim: even
    :param frequencies: the lowest and the highest, rad
    :return: (..., embedding_dim)
    """
    low, high = map(math.log, frequencies)
    angles = tau.unsqueeze(-1) * th.exp(th.linspace(low, high, embedding_dim // 2, device=tau.device))
    return th.cat((angles.sin(), angles.cos()), dim=-1)


class FilmNetwork(nn.Module):
    """
    MLP from A to A numbers whose every hidden layer is scaled and shifted from outside (FiLM, Perez et al., 2018).

    :param action_dim: A
    :param condition_dim: width D of the hidden state h
    :param hidden_dim: width of the hidden layers
    :param n_layers: number of hidden layers
    """

    def __init__(self, action_dim: int, condition_dim: int, hidden_dim: int = 512, n_layers: int = 3) -> None:
        super().__init__()
        self.n_layers = n_layers
        self.film_dim = 2 * hidden_dim * n_layers
        sizes = [action_dim] + [hidden_dim] * n_layers
        self.layers = nn.ModuleList(Linear(sizes[i], sizes[i + 1]) for i in range(n_layers))
        self.film_condition = Linear(condition_dim, self.film_dim)
        self.output = Linear(hidden_dim, action_dim)

    def forward(self, x: th.Tensor, film: th.Tensor) -> th.Tensor:
        """
        :param x: (..., A)
        :param film: (..., 2 * hidden_dim * n_layers), scales and shifts: `film_condition(h)` and what is added to it
        :return: (..., A)
        """
        scales_and_shifts = film.chunk(2 * self.n_layers, dim=-1)
        for layer, scale, shift in zip(self.layers, scales_and_shifts[::2], scales_and_shifts[1::2], strict=True):
            x = F.silu(th.addcmul(shift, layer(x), 1.0 + scale))
        return self.output(x)


class VectorField(FilmNetwork):
    """
    Velocity v(x, tau, h): a FiLM network whose scales and shifts come from tau and h.

    The FiLM map of [psi(tau), h] is linear, so its two halves are kept apart: the half of h is computed once per action,
    the half of tau once for all times of a solver.

    :param time_embedding_dim: size of psi(tau)

    The other parameters are those of :class:`FilmNetwork`.
    """

    def __init__(
        self, action_dim: int, condition_dim: int, hidden_dim: int = 512, n_layers: int = 3, time_embedding_dim: int = 128
    ) -> None:
        super().__init__(action_dim, condition_dim, hidden_dim, n_layers)
        self.time_embedding_dim = time_embedding_dim
        self.film_time = Linear(time_embedding_dim, self.film_dim, bias=False)

    def time_share(self, tau: th.Tensor) -> th.Tensor:
        """The share of times in [0, 1], (...), in all scales and shifts: (..., 2 * hidden_dim * n_layers)."""
        return self.film_time(sinusoidal_embedding(tau, self.time_embedding_dim))


class ReturnFilm(nn.Module):
    """
    From a return-to-go to scales and shifts for all blocks of a trunk: an MLP of its sines and cosines.

    Scales start apart (standard deviation 0.2 of the last weights), so that returns that differ by a tenth are told apart
    from the first gradient step on.

    :param embed_dim: width D of the trunk, and of the hidden layer
    :param n_blocks: number of its blocks
    """

    def __init__(self, embed_dim: int, n_blocks: int) -> None:
        super().__init__()
        self.hidden = Linear(1 + RETURN_EMBEDDING_DIM, embed_dim)
        self.output = Linear(embed_dim, 2 * embed_dim * n_blocks)
        normal_(self.hidden.weight, std=0.5)
        normal_(self.output.weight, std=0.2)
        nn.init.zeros_(self.hidden.bias)
        nn.init.zeros_(self.output.bias)

    def forward(self, returns_to_go: th.Tensor) -> th.Tensor:
        """From (B, N), scaled and clipped at 10, to (B, N, 2 * embed_dim * n_blocks)."""
        returns_to_go = returns_to_go.clamp(-RETURN_CLIP, RETURN_CLIP)
        waves = sinusoidal_embedding(returns_to_go, RETURN_EMBEDDING_DIM, RETURN_FREQUENCIES)
        return self.output(F.silu(self.hidden(th.cat((returns_to_go.unsqueeze(-1), waves), dim=-1))))
