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
    :param n_heads: attention heads
    :param dropout: dropout probability of the Transformer
    :param chunk_size: H, actions that one hidden state leads to: the newest step's and the next ones (action chunking, Zhao
        et al., 2023; Chi et al., 2023). 1 is Decision Transformer's
    :param n_action_steps: actions executed before the next prediction; half of the chunk if not given
    :param return_conditioning: learn and act by the return-to-go; without it, the policy clones what was recorded
    :param expected_return_steps: n: a step's return-to-go is the rewards of n steps and the return expected after such an
        observation, so that a high target return does not stand for chance (Paster et al., 2022); 0 takes the recorded
        one. 50 where returns tell how episodes act and no number makes up half of the rewards, and 0 elsewhere
    :param return_range: with `clip_return_to_go`, keep the return-to-go also within what may be expected from such an
        observation, see :class:`~sb3_dtfm.policies.network.ReturnRange`
    :param clip_return_to_go: keep the return-to-go within what the data showed at the same time step. A target return
        above any episode's, or falling behind, then stays an input like those the policy learned from
    :param return_scaling: "timestep" or "max", see :class:`~sb3_dtfm.policies.normalization.Normalization`
    :param film_return_to_go: let the return-to-go scale and shift the input of each Transformer block, besides being a token
    :param observation_scaling: "std" divides observations by their standard deviation, "robust" by the lower quartile of
        the episodes' standard deviations, for data in which some agents' observations vary far more; see
        :meth:`EpisodeTable.statistics`
    :param features_extractor_class: of images, for each camera: ResidualExtractor, NatureCNN, ResNet18 or another class of
        SB3's kind, which stands in :data:`~sb3_dtfm.policies.images.EXTRACTORS` by its name
    :param features_extractor_kwargs: of that class, for example `features_dim`
    :param normalize_images: divide images by 255, as SB3 does
    :param share_features_extractor: one extractor for all cameras instead of one each
    :param timestep_embedding: tell the Transformer the absolute time step, as Decision Transformer does
    :param tokens_per_step: 3, return-to-go, observation and action, as Decision Transformer does; or 1, the sum of a step's
        return-to-go, its observation and the action before it: a third of the multiply-accumulates
    :param critic_steps: with each gradient step, how many a critic takes, which learns what actions are worth so that the
        best of several can be taken, see :class:`~sb3_dtfm.policies.critic.Critic`; the policy learns as without. It
        needs a head that draws; 0 for no critic
    :param gamma: discount of a step for the critic
    :param expectile: of the critic's value loss, in [0.5, 1)
    :param n_action_samples: N of best-of-N: actions, or chunks, that are sampled, of which the critic takes one; 1 asks
        no critic. 8 where there is a critic, if not given
    :param sample_noise_std: standard deviation of the noise that all but the first of them start from; above 1, which the
        flow has learned, they differ more, and the critic has more to choose among
    :param temperature: how much chance that choice leaves, in units of how far actions' values spread in the data; 0
        takes the one that both values of the critic find better than the first, by the larger gain
    :param kv_cache: act on the keys and values kept of earlier steps instead of recomputing the window: up to 2.5 times
        faster, and equal until the window slides (see :func:`~sb3_dtfm.networks.cache.extend`)
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
