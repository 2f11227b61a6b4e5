"""Options of the policy, which users give among `policy_kwargs`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_dtfm.arguments import (
    BOOLEAN,
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY_BELOW_1,
    Choice,
    Number,
    Options,
    check_arguments,
    option,
)
from sb3_dtfm.heads.base import NOISE_ROWS
from sb3_dtfm.policies.images import EXTRACTORS, extractor_name
from sb3_dtfm.policies.normalization import OBSERVATION_SCALINGS, RETURN_SCALINGS

# N of best-of-N where a critic learns and no N is given.
N_ACTION_SAMPLES = 8


class Extractor:
    """The name of a class for images."""

    def accepts(self, value: Any) -> bool:
        """Return whether it is one."""
        return isinstance(value, str) and value in EXTRACTORS

    def __str__(self) -> str:
        return f"one of {', '.join(EXTRACTORS)}, or entered in sb3_dtfm.policies.images.EXTRACTORS by its name"


class Arguments:
    """Arguments by name."""

    def accepts(self, value: Any) -> bool:
        """Return whether it is a mapping by name, or None."""
        return value is None or (isinstance(value, Mapping) and all(isinstance(name, str) for name in value))

    def __str__(self) -> str:
        return "arguments by name"


@dataclass(frozen=True)
class PolicyOptions(Options):
    """
    Options of the Transformer, its inputs and its way of acting; the head has its own.

    :param embed_dim: width of the Transformer
    :param n_layers: number of Transformer blocks
    :param n_heads: number of attention heads
    :param dropout: probability of dropout in the Transformer. It is 0.2 for fewer than 250 recorded steps for each
        dimension of the observation, else 0
    :param chunk_size: number of actions that are predicted at once, H: the newest step's and the next ones (action
        chunking, Zhao et al., 2023; Chi et al., 2023). Decision Transformer's is 1
    :param n_action_steps: number of actions that are executed before the next prediction; None is half of the chunk
    :param return_conditioning: whether the policy learns and acts by the return-to-go; otherwise it clones the recorded
        actions
    :param expected_return_steps: number n of recorded rewards in a return-to-go, to which the return expected from there on
        is added, so that a high target return does not stand for chance (Paster et al., 2022); 0 takes the recorded return.
        It is 50 where returns predict actions and no number makes up half of the rewards, else 0
    :param return_range: whether, with `clip_return_to_go`, the return-to-go also stays within the range recorded at similar
        observations, see :class:`~sb3_dtfm.policies.network.ReturnRange`
    :param clip_return_to_go: whether the return-to-go stays within the range recorded at the same time step. Then a target
        return above any episode's, and an episode that falls behind, give inputs like those of training
    :param return_scaling: scaling of the return-to-go: "timestep" standardises it at each time step, "max" divides it by
        the largest return, see :class:`~sb3_dtfm.policies.normalization.Normalization`
    :param film_return_to_go: whether the return-to-go also scales and shifts the input of each Transformer block (FiLM),
        besides being a token
    :param observation_scaling: scaling of observations: "std" divides by their standard deviation, "robust" by the lower
        quartile of the episodes' standard deviations, for data in which some agents' observations vary far more, see
        :meth:`EpisodeTable.statistics`
    :param features_extractor_class: network for the images of each camera: ResidualExtractor, NatureCNN, ResNet18, or
        another features extractor of SB3's kind, which is entered in :data:`~sb3_dtfm.policies.images.EXTRACTORS` by its
        name
    :param features_extractor_kwargs: arguments of that class by name, for example `features_dim`
    :param normalize_images: whether images are divided by 255, as in SB3
    :param share_features_extractor: whether all cameras share one extractor
    :param timestep_embedding: whether the Transformer gets an embedding of the time step, as Decision Transformer does
    :param tokens_per_step: number of tokens a step: 3 for return-to-go, observation and action, as in Decision Transformer,
        or 1 for the sum of return-to-go, observation and previous action, with a third of the multiply-accumulates
    :param critic_steps: number of a critic's gradient steps with each of the policy's, which does not depend on it; 0 for
        no critic. The critic chooses among several samples of DTFM, see :class:`~sb3_dtfm.policies.critic.Critic`
    :param gamma: discount factor of the critic
    :param expectile: expectile of the critic's value loss
    :param n_action_samples: number N of samples for best-of-N, of which the critic takes one; 1 asks no critic. None is 8
        with a critic, else 1
    :param sample_noise_std: standard deviation of the noise from which all samples but the first start. It is 1 in
        training; a larger one makes them differ more
    :param temperature: temperature of the choice among samples, in standard deviations of the advantages in the data; 0
        takes the one that both Q-networks prefer to the first sample, by the larger gain
    :param kv_cache: whether keys and values of earlier steps are kept instead of recomputing the window: up to 2.5 times
        faster, and equal until the window slides, see :func:`~sb3_dtfm.networks.cache.extend`
    :raises ValueError: an option out of range, by name
    """

    embed_dim: int = option(128, COUNT)
    n_layers: int = option(3, COUNT)
    n_heads: int = option(2, COUNT)
    dropout: float = option(0.0, PROBABILITY_BELOW_1)
    chunk_size: int = option(1, COUNT)
    n_action_steps: int = option(None, COUNT._replace(optional=True), acting=True)
    return_conditioning: bool = option(True, BOOLEAN)
    expected_return_steps: int = option(0, Number(low=0, whole=True))
    return_range: bool = option(True, BOOLEAN)
    clip_return_to_go: bool = option(True, BOOLEAN)
    return_scaling: str = option("timestep", Choice(RETURN_SCALINGS))
    film_return_to_go: bool = option(True, BOOLEAN)
    observation_scaling: str = option("std", Choice(OBSERVATION_SCALINGS))
    features_extractor_class: str = option("ResidualExtractor", Extractor())
    features_extractor_kwargs: Mapping[str, Any] | None = option(None, Arguments())
    normalize_images: bool = option(True, BOOLEAN)
    share_features_extractor: bool = option(False, BOOLEAN)
    timestep_embedding: bool = option(False, BOOLEAN)
    tokens_per_step: int = option(1, Choice((1, 3)))
    critic_steps: int = option(0, Number(low=0, whole=True))
    gamma: float = option(0.99, PROBABILITY_BELOW_1)
    expectile: float = option(0.7, Number(low=0.5, high=1, below_high=True))
    n_action_samples: int = option(None, Number(low=1, high=NOISE_ROWS, whole=True, optional=True), acting=True)
    sample_noise_std: float = option(1.0, POSITIVE, acting=True)
    temperature: float = option(0.0, NOT_NEGATIVE, acting=True)
    kv_cache: bool = option(False, BOOLEAN, acting=True)

    def __post_init__(self) -> None:
        vars(self)["features_extractor_class"] = extractor_name(self.features_extractor_class)
        super().__post_init__()
        n_action_steps = (self.chunk_size + 1) // 2 if self.n_action_steps is None else self.n_action_steps
        accepted = {"n_action_steps": Number(low=1, high=self.chunk_size, whole=True)}
        vars(self).update(check_arguments({"n_action_steps": n_action_steps}, accepted))
        default = N_ACTION_SAMPLES if self.critic_steps else 1
        vars(self)["n_action_samples"] = default if self.n_action_samples is None else self.n_action_samples
        if self.n_action_samples > 1 and not self.critic_steps:
            raise ValueError(
                f"n_action_samples={self.n_action_samples} needs a model that was trained with "
                "policy_kwargs=dict(critic_steps=...)."
            )
