"""
OnlineActor: the choices that an online algorithm has learned to make for a flow.

These are noise in place of drawn noise (Wagenmaker et al., 2025), or residual actions (Johannink et al., 2019).
"""

from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_dtfm.arguments import BOOLEAN, COUNT, POSITIVE, Choice, Rule, check_arguments
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.normalization import OBSERVATION_CLIP, Normalization
from sb3_dtfm.windows import Windows

ACTIVATIONS: dict[str, type[nn.Module]] = {
    each.__name__: each for each in (nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.LeakyReLU, nn.SiLU)
}
# Logarithms of standard deviations, as Stable-Baselines3's SAC limits them.
LOG_STD_RANGE = (-20.0, 2.0)
MAX_LAYERS = 32
ACCEPTED: dict[str, Rule] = {
    "activation": Choice(tuple(ACTIVATIONS)),
    "squashed": BOOLEAN,
    "bound": POSITIVE,
    "hidden_state": BOOLEAN,
    "residual": BOOLEAN,
}


def actor_observation(normalization: Normalization, newest: Windows, hidden: th.Tensor | None) -> th.Tensor:
    """
    The observation of an online actor: everything that the frozen policy's newest step depends on but the steps before it.

    Observations are in standard deviations of the training data, also with `observation_scaling="robust"`: the units that an
    ordinary network learns from, as behind SB3's `VecNormalize`.

    :param normalization: the policy's normalization
    :param newest: newest steps (B, 1, ...), in the environment's units
    :param hidden: the Transformer's hidden states (B, D); None leaves them out
    :return: (B, O + 2), or (B, O + 2 + D), each within `OBSERVATION_CLIP`: observation, the Transformer's return-to-go,
        time step as a share of the longest episode that was learned from
    """
    scaled = normalization(newest)
    gain = normalization.observation_gain
    parts = [
        scaled.observations[:, 0] / th.where(gain > 0, gain, 1.0),  # of a constant dimension, zero
        scaled.returns_to_go,
        newest.timesteps / float(normalization.max_timestep),
    ]
    return th.cat(parts if hidden is None else [*parts, hidden], dim=1).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)


class OnlineActor(nn.Module):
    """
    A Gaussian actor over noise, or over residual actions, in a form that holds those of several algorithms.

    :param observation_dim: size F of the actor's observation
    :param chosen_dim: size of a choice: N for noise, or A for a residual action
    :param layers: widths of the hidden layers
    :param activation: a key of `ACTIVATIONS`
    :param squashed: whether choices are bound * tanh(...), as SAC's and TQC's actions; otherwise they are clipped, as PPO's
    :param bound: largest absolute noise, or residual action in units of [-1, 1]
    :param hidden_state: whether the Transformer's hidden state is part of the observation
    :param residual: whether it chooses residual actions, and observes the policy's own action last; otherwise it chooses
        noise
    :raises ValueError: an argument out of range, by name
    """

    def __init__(
        self,
        observation_dim: int,
        chosen_dim: int,
        *,
        layers: list[int],
        activation: str,
        squashed: bool,
        bound: float,
        hidden_state: bool,
        residual: bool = False,
    ) -> None:
        super().__init__()
        check_arguments(locals(), ACCEPTED)
        if not isinstance(layers, list) or len(layers) > MAX_LAYERS or not all(map(COUNT.accepts, layers)):
            raise ValueError(f"layers must be at most {MAX_LAYERS} whole numbers of at least 1, got {layers!r}.")
        self.squashed = squashed
        self.bound = bound
        self.hidden_state = hidden_state
        self.residual = residual
        self.chosen_dim = chosen_dim
        widths = [observation_dim, *layers]
        hidden = [nn.Sequential(nn.Linear(*pair), ACTIVATIONS[activation]()) for pair in zip(widths, layers, strict=False)]
        self.layers = nn.Sequential(*hidden)
        self.mean = nn.Linear(widths[-1], chosen_dim)
        self.log_std = nn.Linear(widths[-1], chosen_dim)

    def choose(self, observation: th.Tensor, drawn: th.Tensor) -> th.Tensor:
        """
        :param observation: (B, F)
        :param drawn: standard normal noise, (B, N) or (B, A); zeros give the mean
        :return: choices, shaped like `drawn`, of the actor's distribution
        """
        latent = self.layers(observation)
        chosen = self.mean(latent) + self.log_std(latent).clamp(*LOG_STD_RANGE).exp() * drawn
        return self.bound * chosen.tanh() if self.squashed else chosen.clamp(-self.bound, self.bound)

    def forward(
        self,
        normalization: Normalization,
        newest: Windows,
        hidden: th.Tensor,
        drawn: th.Tensor,
        decode: Callable[[th.Tensor], th.Tensor],
    ) -> th.Tensor:
        """
        Noise is drawn from the actor's distribution; a residual action is its mean, and only the first action gets one.

        :param normalization: the policy's normalization
        :param newest: newest steps (B, 1, ...), in the environment's units
        :param hidden: the Transformer's hidden states (B, D)
        :param drawn: noise (B, N), standard normal
        :param decode: function from noise (B, N) to actions (B, H A) in [-1, 1]
        :return: actions (B, H A) in [-1, 1]
        """
        observation = actor_observation(normalization, newest, hidden if self.hidden_state else None)
        if not self.residual:
            return decode(self.choose(observation, drawn))
        actions = decode(drawn)
        own, plans = actions[:, : self.chosen_dim], actions[:, self.chosen_dim :]
        residual = self.choose(th.cat([observation, own], dim=1), th.zeros_like(own))
        return th.cat([(own + residual).clamp(-1.0, 1.0), plans], dim=1)


def make_online_actor(
    observation_dim: int, embed_dim: int, noise_dim: int, action_dim: int, settings: dict[str, Any]
) -> OnlineActor:
    """
    :param observation_dim: size of the policy's observation, with the features of images
    :param embed_dim: width D of the Transformer
    :param noise_dim: number N of the head's noise values
    :param action_dim: size A of an action
    :param settings: keyword arguments of :class:`OnlineActor`
    :return: actor whose weights are for the caller to load; PyTorch's global generator, which an algorithm may be learning
        by, is left as it is
    :raises ValueError: a setting that is unknown, missing or out of range
    """
    try:
        sees = observation_dim + 2 + (embed_dim if settings.get("hidden_state") else 0)
        with th.random.fork_rng(devices=[]):
            if settings.get("residual"):
                return OnlineActor(sees + action_dim, action_dim, **settings)
            return OnlineActor(sees, noise_dim, **settings)
    except TypeError as error:
        raise ValueError(f"No settings of an online actor: {error}.") from error


def check_noise_actions(policy: SequencePolicy) -> int:
    """
    :return: number N of the noise values that an online algorithm chooses
    :raises ValueError: there is no flow
    """
    head = policy.network.head
    if not head.noise_dim or not isinstance(policy.action_space, spaces.Box):
        name = policy.head_class.algorithm
        raise ValueError(f"{name} of {policy.action_space} has no flow whose noise could be chosen; a DTFM is needed.")
    return head.noise_dim


def check_residual_actions(policy: SequencePolicy, n_action_steps: int) -> None:
    """
    :param policy: policy that residual actions are added to
    :param n_action_steps: number of executed actions of each plan
    :raises ValueError: there is no flow, or it executes several actions of a chunk
    """
    check_noise_actions(policy)
    if n_action_steps > 1:
        raise ValueError(
            f"n_action_steps={n_action_steps}: residual actions are added to single actions; "
            "model.policy.set_acting(n_action_steps=1) carries out one of each plan."
        )
