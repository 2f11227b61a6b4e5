"""Expected returns after observations, where an episode tells one return only."""

import math
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_dtfm.data.episodes import Statistics

HIDDEN_DIM = 256
N_TIMESTEPS, BATCH_SIZE, LEARNING_RATE, WEIGHT_DECAY = 3000, 256, 1e-3, 1e-2
MOST_EPOCHS, FEWEST_TIMESTEPS = 100, 300  # below 7,680 recorded steps
N_AT_ONCE = 8192
# 0.5 is the mean; near 1, the best. A model without the recorded noise reaches more than the recorded mean.
EXPECTILE = 0.95


class Steps(NamedTuple):
    """
    Steps of episodes, one after the other, and where they lie in flat tensors.

    :param observations: (N, O), of which `rows` are read
    :param returns_to_go: (N,)
    :param rows: (M,) int64
    :param timesteps: (M,) int64
    :param n_left: (M,) int64, number of later steps in the episode
    """

    observations: th.Tensor
    returns_to_go: th.Tensor
    rows: th.Tensor
    timesteps: th.Tensor
    n_left: th.Tensor


def expected_returns_to_go(steps: Steps, n_steps: int, statistics: Statistics, seed: int) -> th.Tensor:
    """
    Returns-to-go whose part after n steps is replaced by the return that may be expected there.

    They are means of n-step returns (Sutton and Barto, 2018, section 7.1), of n to 2 n steps: what is expected at one
    observation differs from that at the next one by chance. A step with fewer than n to follow keeps what was recorded.

    :param steps: steps to learn from and to predict for
    :param n_steps: n
    :param statistics: statistics of their observations
    :param seed: seed of the regression
    :return: (M,) float32
    """
    returns_to_go = steps.returns_to_go[steps.rows]
    surplus = _regression(steps, statistics, seed) - returns_to_go
    summed = th.cat((surplus.new_zeros(1), surplus)).double().cumsum(0)
    goes_on = th.nonzero(steps.n_left >= n_steps).squeeze(1)
    first, last = goes_on + n_steps, goes_on + steps.n_left[goes_on].clamp(max=2 * n_steps)
    returns_to_go[goes_on] += ((summed[last + 1] - summed[first]) / (last + 1 - first)).float()
    return returns_to_go


def _regression(steps: Steps, statistics: Statistics, seed: int) -> th.Tensor:
    """
    An expectile of the return-to-go by observation and time step: a small network's regression (Monte Carlo policy
    evaluation, by the asymmetric squared error of Newey and Powell, 1987).

    Few steps and weight decay keep it from learning episodes by heart; dropout would lift an expectile by the spread that it
    makes. Global random numbers stay as they are.

    :param steps: steps to learn from and to predict for
    :param statistics: statistics of their observations
    :param seed: seed of weights and batches
    :return: (M,) float32
    """
    scale = statistics.return_scale or 1.0
    elapsed = steps.timesteps.unsqueeze(1) / (int(steps.timesteps.max()) + 1)

    def expected(chosen: th.Tensor) -> th.Tensor:
        """A return by observation and time, and one that shrinks with the steps that are left, as of locomotion."""
        observations = statistics.normalize(steps.observations.index_select(0, steps.rows[chosen]))
        fixed, shrinking = network(th.cat((observations, elapsed[chosen]), dim=1)).unbind(1)
        return fixed + shrinking * (1.0 - elapsed[chosen, 0])

    n_steps = len(steps.rows)
    with th.random.fork_rng(devices=[]), th.enable_grad():
        th.manual_seed(seed)
        network = _network(steps.observations.shape[1] + 1)
        optimizer = th.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True)
        n_timesteps = min(N_TIMESTEPS, max(FEWEST_TIMESTEPS, MOST_EPOCHS * n_steps // BATCH_SIZE))
        for i in range(n_timesteps):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * i / n_timesteps))
            chosen = th.randint(n_steps, (BATCH_SIZE,))
            wanted = steps.returns_to_go.index_select(0, steps.rows[chosen]) / scale
            optimizer.zero_grad(set_to_none=True)
            missing = wanted - expected(chosen)
            th.where(missing > 0, EXPECTILE * missing.square(), (1.0 - EXPECTILE) * missing.square()).mean().backward()
            optimizer.step()
    with th.no_grad():
        return scale * th.cat([expected(part) for part in th.arange(n_steps).split(N_AT_ONCE)])


def _network(input_dim: int) -> nn.Sequential:
    sizes = (input_dim, HIDDEN_DIM, HIDDEN_DIM)
    hidden = [layer for i in (0, 1) for layer in (nn.Linear(sizes[i], sizes[i + 1]), nn.LayerNorm(sizes[i + 1]), nn.ReLU())]
    return nn.Sequential(*hidden, nn.Linear(HIDDEN_DIM, 2))
