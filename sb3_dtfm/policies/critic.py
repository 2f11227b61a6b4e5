"""
Values of actions, learned from recorded data alone (IQL), so that the best of several drawn actions can be taken.

Values are per unit of reward that :meth:`Critic.set_scale` chose; gradient steps are the algorithm's.
"""

import copy
from collections.abc import Callable

import numpy as np
import torch as th
from torch import nn

from sb3_dtfm.transitions import Transitions

# Kostrikov et al. (2022): share by which the target network follows at each gradient step, and the learning rate of all.
TARGET_SHARE = 0.005
LEARNING_RATE = 3e-4
# Value of the largest discounted return-to-go after scaling.
LARGEST_VALUE = 10.0
# How far apart in the noise table the samples' rows lie, and those that chance chooses by: no divisors of its length.
SAMPLE_STRIDE, CHOICE_STRIDE, CHOICE_START = 97, 31, 513
# Rate at which advantage_std follows the batches.
STD_SHARE = 0.01


class Critic(nn.Module):
    """
    Implicit Q-learning (Kostrikov et al., 2022): values of observations and actions, without a value of any action that
    was not recorded.

    V(s) is an expectile of Q(s, a) over the data's actions, above their mean: what a good one of them leads to. Q(s, a) is
    the reward and the discounted V of the next observation. The smaller of two Qs counts.

    :param observation_dim: O
    :param action_dim: size h A of the h actions that are valued together
    :param hidden_dim: width of the two hidden layers
    :param expectile: expectile of the value loss, in [0.5, 1): 0.5 values the data's policy, near 1 the best of its
        actions, and noise with them
    """

    batch_size = 256
    reward_scale: th.Tensor
    advantage_std: th.Tensor

    def __init__(self, observation_dim: int, action_dim: int, hidden_dim: int = 256, expectile: float = 0.7) -> None:
        super().__init__()
        self.expectile = expectile
        self.action_dim = action_dim
        self.q = nn.ModuleList(_mlp(observation_dim + action_dim, hidden_dim) for _ in range(2))
        self.q_target = copy.deepcopy(self.q).requires_grad_(False)
        self.value = _mlp(observation_dim, hidden_dim)
        self.register_buffer("reward_scale", th.ones(()))
        self.register_buffer("advantage_std", th.ones(()))
        trained = [*self.q.parameters(), *self.value.parameters()]
        self.optimizer: th.optim.Optimizer = th.optim.Adam(trained, lr=LEARNING_RATE, fused=True)

    def set_scale(self, largest_return: float) -> None:
        """
        :param largest_return: largest absolute discounted return-to-go of the data, environment reward units
        """
        self.reward_scale.fill_(LARGEST_VALUE / largest_return if largest_return > 0 else 1.0)

    def forward(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        The smaller of the target network's two values.

        :param observations: (..., O), normalised
        :param actions: (..., h A) in [-1, 1]
        :return: (...)
        """
        pairs = th.cat((observations, actions), dim=-1)
        return th.minimum(*(q(pairs).squeeze(-1) for q in self.q_target))

    def gains(self, observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Return how much more than the first of N actions each is worth, by the Q that finds less: another one is worth more
        only where both Qs say so. An error that a Q makes alike in all actions of an observation cancels out.

        :param observations: (B, O), normalised
        :param actions: (B, N, h A) in [-1, 1]
        :return: (B, N), 0 of the first
        """
        pairs = th.cat((observations.unsqueeze(1).expand(-1, actions.shape[1], -1), actions), dim=-1)
        values = th.stack([q(pairs).squeeze(-1) for q in self.q_target])
        return (values - values[..., :1]).amin(dim=0)

    def loss(self, batch: Transitions) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: transitions with normalised observations, and actions in [-1, 1]
        :return: the loss to minimise, and values to log by name
        """
        pairs = th.cat((batch.observations, batch.actions), dim=-1)
        with th.no_grad():
            future = self.value(batch.next_observations).squeeze(-1)
            backup = self.reward_scale * batch.rewards + batch.discounts * future
            valued = self(batch.observations, batch.actions)
        advantage = valued - self.value(batch.observations).squeeze(-1)
        weight = th.where(advantage > 0, self.expectile, 1.0 - self.expectile)
        value_loss = _mean(weight * advantage.square(), batch.mask)
        errors = [(q(pairs).squeeze(-1) - backup).square() for q in self.q]
        critic_loss = _mean(errors[0] + errors[1], batch.mask)
        parts = {
            "critic_loss": critic_loss,
            "value_loss": value_loss,
            "q_value": _mean(valued, batch.mask),
            "advantage_std": _mean(advantage.square(), batch.mask).sqrt(),
        }
        return critic_loss + value_loss, {name: part.detach() for name, part in parts.items()}

    def learn(self, batch: Transitions) -> dict[str, th.Tensor]:
        """
        Take a gradient step. A loss that is not finite leaves the trained networks and `advantage_std` as they are.

        :param batch: transitions with normalised observations, and actions in [-1, 1]
        :return: values to log by name
        """
        loss, parts = self.loss(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        finite = th.isfinite(loss)
        self.optimizer.found_inf = (~finite).float()  # type: ignore[attr-defined]
        self.optimizer.step()
        self.advantage_std.lerp_(th.where(finite, parts["advantage_std"], self.advantage_std), STD_SHARE)
        # The target network moves towards the learning one.
        followers = [parameter.data for parameter in self.q_target.parameters()]
        th._foreach_lerp_(followers, [parameter.data for parameter in self.q.parameters()], TARGET_SHARE)
        return parts

    def best_of_n(
        self,
        observations: th.Tensor,
        rows: np.ndarray,
        draw: Callable[[np.ndarray], th.Tensor],
        decode: Callable[[th.Tensor], th.Tensor],
        n_samples: int,
        noise_std: float,
        temperature: float,
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Several draws from the head, and which of them the critic takes.

        :param observations: (b, O), normalised
        :param rows: rows (b,) of the noise table, which the first sample starts from, as it would without others
        :param draw: function from rows (M,) to noise (M, noise_dim)
        :param decode: function from noise (b, N, noise_dim) to actions (b, N, H A) in [-1, 1]
        :param n_samples: number N of samples
        :param noise_std: standard deviation of the noise of all samples but the first
        :param temperature: temperature of the choice, see :meth:`choose`
        :return: actions (b, N, H A), and the index (b,) int64 of the one that is taken
        """
        shape, turns = (len(rows), n_samples), np.arange(n_samples)
        noise = draw((rows[:, None] + SAMPLE_STRIDE * turns).ravel()).to(observations.device).view(*shape, -1)
        noise[:, 1:] *= noise_std
        samples = decode(noise)
        chance = draw((rows[:, None] + CHOICE_START + CHOICE_STRIDE * turns).ravel())[:, 0]
        uniform = th.special.ndtr(chance).clamp(1e-6, 1 - 1e-6).view(shape).to(observations.device)
        gains = self.gains(observations, samples[..., : self.action_dim])
        return samples, self.choose(gains, temperature, uniform)

    def choose(self, gains: th.Tensor, temperature: float, uniform: th.Tensor) -> th.Tensor:
        """
        Choose one of N actions, with probabilities softmax(gain / (temperature * advantage_std)). Hansen-Estruch et al.
        (2023) have Q in place of the gain.

        :param gains: (B, N), as from :meth:`gains`
        :param temperature: temperature in units of `advantage_std`; 0 takes the largest gain
        :param uniform: uniform random numbers (B, N) in (0, 1), for the Gumbel-max trick
        :return: indices (B,) int64 of the actions
        """
        chance = -(-uniform.log()).log()
        return (gains + temperature * self.advantage_std * chance).argmax(dim=-1)


def _mlp(input_dim: int, hidden_dim: int) -> nn.Sequential:
    """Layer norms keep the values of actions that were not recorded near those of others (Ball et al., 2023)."""
    sizes = (input_dim, hidden_dim, hidden_dim)
    hidden = [layer for i in (0, 1) for layer in (nn.Linear(sizes[i], sizes[i + 1]), nn.LayerNorm(sizes[i + 1]), nn.ReLU())]
    return nn.Sequential(*hidden, nn.Linear(hidden_dim, 1))


def _mean(values: th.Tensor, mask: th.Tensor) -> th.Tensor:
    return (values * mask).sum() / mask.sum().clamp(min=1)
