"""The policy: its options, the networks that they make, and what these learn by."""

import copy
import inspect
import json
from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_dtfm.actions import ActionSpace, vector_space
from sb3_dtfm.arguments import (
    BOOLEAN,
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY_BELOW_1,
    Choice,
    Number,
    Rule,
    check_arguments,
    with_nearest,
)
from sb3_dtfm.heads import ActionHead
from sb3_dtfm.heads.base import NOISE_ROWS
from sb3_dtfm.networks.optimizer import FlatAdamW, FlatTensors
from sb3_dtfm.networks.return_range import ReturnRange
from sb3_dtfm.networks.trunk import SequenceTrunk
from sb3_dtfm.policies.acting import ActingPolicy, standard_normal
from sb3_dtfm.policies.critic import Critic
from sb3_dtfm.policies.network import SequenceNetwork
from sb3_dtfm.policies.normalization import OBSERVATION_SCALINGS, RETURN_SCALINGS, Normalization
from sb3_dtfm.windows import Windows

ACCEPTED: dict[str, Rule] = {
    "context_length": COUNT,
    "max_timestep": COUNT,
    "embed_dim": COUNT,
    "n_layers": COUNT,
    "n_heads": COUNT,
    "dropout": PROBABILITY_BELOW_1,
    "timestep_embedding": BOOLEAN,
    "tokens_per_step": Choice((1, 3)),
    "chunk_size": COUNT,
    "weight_decay": NOT_NEGATIVE,
    "clip_return_to_go": BOOLEAN,
    "return_range": BOOLEAN,
    "return_scaling": Choice(RETURN_SCALINGS),
    "return_conditioning": BOOLEAN,
    "film_return_to_go": BOOLEAN,
    "observation_scaling": Choice(OBSERVATION_SCALINGS),
    "kv_cache": BOOLEAN,
    "critic_steps": Number(low=0, whole=True),
    "gamma": PROBABILITY_BELOW_1,
    "expectile": Number(low=0.5, high=1, below_high=True),
}
# What the algorithm gives to the policy by itself; everything else is for `policy_kwargs`.
FROM_ALGORITHM = ("context_length", "max_timestep", "weight_decay", "ema", "seed")


class SequencePolicy(ActingPolicy):
    """
    A policy over the last `context_length` steps: the trunk's hidden state, and a head that makes an action of it.

    `deterministic=True` starts from noise that belongs to the time step and the episode: rows of a table that is drawn once
    from `seed` and saved with the model, from a row on that the episode's first observation decides. Zero noise would be one
    point of the distribution, and following the same mode for ever gets a robot arm stuck. The same rows in every episode
    would correlate the episodes.

    :param observation_space: Dict of `observation` (O,), `return_to_go` (1,) and `timestep` (1,)
    :param action_space: bounded Box (A,); or Discrete, whose actions are vectors for all but `predict`, see
        :mod:`~sb3_dtfm.actions`
    :param lr_schedule: learning rate over the progress remaining, from 1 to 0
    :param context_length: K, steps the policy sees
    :param max_timestep: time steps with an embedding of their own
    :param embed_dim: width of the trunk
    :param n_layers: number of Transformer blocks
    :param n_heads: attention heads
    :param dropout: dropout probability of the trunk
    :param timestep_embedding: tell the trunk the absolute time step, as Decision Transformer does
    :param tokens_per_step: 3, return-to-go, observation and action, as Decision Transformer does; or 1, the sum of a step's
        return-to-go, its observation and the action before it: a third of the products
    :param chunk_size: H, actions that one hidden state leads to: the newest step's and the next ones (action chunking, Zhao
        et al., 2023; Chi et al., 2023). 1 is Decision Transformer's
    :param n_action_steps: how many of them are carried out before the policy looks again, half of them if not given
    :param weight_decay: AdamW's, on weight matrices only
    :param clip_return_to_go: keep the return-to-go within what the data showed at the same time step. Asking for more than
        any episode reached, or falling behind, then stays an input like those the policy learned from
    :param return_range: with `clip_return_to_go`, keep it also within what may be expected from such an observation, see
        :class:`~sb3_dtfm.networks.return_range.ReturnRange`
    :param return_scaling: "timestep" or "max", see :class:`~sb3_dtfm.policies.normalization.Normalization`
    :param return_conditioning: learn and act by the return-to-go; without it, the policy clones what was recorded
    :param film_return_to_go: let the return-to-go scale and shift what each block of the trunk gets, besides being a token
    :param observation_scaling: "std" divides observations by their standard deviation, "robust" by the lower quartile of
        the episodes' standard deviations, for data in which some agents' observations vary far more; see
        :meth:`EpisodeTable.statistics`
    :param critic_steps: with each gradient step, how many a critic takes, which learns what actions are worth so that the
        best of several can be taken, see :class:`~sb3_dtfm.policies.critic.Critic`; trunk and head learn as without. It
        needs a head that draws; 0 for no critic
    :param gamma: discount of a step for the critic
    :param expectile: of the critic
    :param n_action_samples: N of best-of-N: actions, or chunks, that are sampled, of which the critic takes one; 1 asks
        no critic
    :param sample_noise_std: standard deviation of the noise that all but the first of them start from; above 1, which the
        flow has learned, they differ more, and the critic has more to choose among
    :param temperature: how much chance that choice leaves, in units of how far actions' values spread in the data; 0, the
        default, takes the one that both values of the critic find better than the first, by the larger gain
    :param ema: keep an exponential moving average of the weights and act with it
    :param kv_cache: act on the keys and values kept of earlier steps instead of recomputing the window: two to three times
        faster, and equal until the window slides (see :meth:`SequenceTrunk.extend`)
    :param seed: seed of the noise that acting starts from
    :param head_options: options of the head, see its class
    :raises ValueError: an argument out of range or unknown, by name, or an action space that the head does not learn
    """

    head_class: ClassVar[type[ActionHead]]

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: ActionSpace,
        lr_schedule: Schedule,
        context_length: int = 1,
        max_timestep: int = 1000,
        embed_dim: int = 128,
        n_layers: int = 3,
        n_heads: int = 2,
        dropout: float = 0.0,
        timestep_embedding: bool = False,
        tokens_per_step: int = 1,
        chunk_size: int = 1,
        n_action_steps: int | None = None,
        weight_decay: float = 1e-3,
        clip_return_to_go: bool = True,
        return_range: bool = True,
        return_scaling: str = "timestep",
        return_conditioning: bool = True,
        film_return_to_go: bool = True,
        observation_scaling: str = "std",
        critic_steps: int = 0,
        gamma: float = 0.99,
        expectile: float = 0.7,
        n_action_samples: int = 1,
        sample_noise_std: float = 1.0,
        temperature: float = 0.0,
        ema: bool = False,
        kv_cache: bool = False,
        seed: int | None = None,
        **head_options: Any,
    ) -> None:
        super().__init__(observation_space, action_space, normalize_images=False, optimizer_class=th.optim.AdamW)
        arguments = {name: value for name, value in locals().items() if name in _own_parameters()}
        arguments.update(check_arguments(arguments, ACCEPTED))
        if n_action_steps is None:
            arguments["n_action_steps"] = (arguments["chunk_size"] + 1) // 2
        self._check_names(head_options)
        head_class = self.head_for(action_space)
        self.context_length = context_length
        self.weight_decay = arguments["weight_decay"]
        self.kv_cache = arguments["kv_cache"]
        self.chunk_size = arguments["chunk_size"]
        if self.chunk_size > 1 and not isinstance(action_space, spaces.Box):
            raise ValueError(
                f"chunk_size must be 1 for {action_space}, whose actions are chosen one by one; got {chunk_size}."
            )
        arguments.update(check_arguments(arguments, self._acting_rules()))
        self.n_action_steps = arguments["n_action_steps"]
        self.n_action_samples, self.sample_noise_std = arguments["n_action_samples"], arguments["sample_noise_std"]
        self.temperature = arguments["temperature"]
        self._constructor_arguments = {**arguments, **self.head_class.options(), **head_options}
        self.seed = seed
        self.observation_dim = int(observation_space["observation"].shape[0])  # type: ignore[index]
        self.vector_space = vector_space(action_space)
        self.action_dim = int(self.vector_space.shape[0])
        units = (self.observation_dim, self.vector_space, max_timestep)
        scaling = return_scaling if return_conditioning else None
        self.normalization = Normalization(*units, clip_return_to_go, scaling, observation_scaling)
        sizes = (self.observation_dim, self.action_dim, max_timestep, embed_dim, n_layers, n_heads)
        film = film_return_to_go and return_conditioning
        trunk = SequenceTrunk(*sizes, dropout, timestep_embedding, tokens_per_step, film)
        head = head_class(embed_dim, self.chunk_size * self.action_dim, **head_options)
        ranged = return_range and clip_return_to_go and return_conditioning
        self.network = SequenceNetwork(trunk, head, ReturnRange(self.observation_dim) if ranged else None)
        self.ema_network = copy.deepcopy(self.network).requires_grad_(False) if ema else None
        self.optimizer: FlatAdamW = self._make_optimizer(lr_schedule(1.0))
        averaged = dict(zip(self.network.parameters(), self.acting_network.parameters(), strict=True))
        self._averaged = FlatTensors(averaged[parameter] for parameter in self.optimizer.parameters)
        generator = th.Generator().manual_seed(0 if seed is None else seed)
        self.register_buffer("noise_table", self.network.head.deterministic_noise(generator))
        self.gamma, self.critic_steps = gamma, arguments["critic_steps"]
        self.critic_horizon = self.n_action_steps  # actions that the critic values together: those that are carried out
        self.critic = None
        if self.critic_steps:  # made last: the weights of all else are what they are without
            if self.network.head.noise_dim == 0:
                raise ValueError(
                    f"critic_steps={critic_steps}: the critic has nothing to choose among: {self.head_class.algorithm} "
                    "makes one action of what it sees, where DTFM draws."
                )
            self.critic = Critic(self.observation_dim, self.critic_horizon * self.action_dim, expectile=expectile)
        self._check_candidates(self.n_action_samples)

    @classmethod
    def parameter_names(cls) -> set[str]:
        """What `policy_kwargs` may hold: the trunk's and the head's options."""
        return (_own_parameters() - set(FROM_ALGORITHM)) | set(cls.head_class.options())

    @classmethod
    def _check_names(cls, head_options: dict[str, Any]) -> None:
        unknown = sorted(set(head_options) - set(cls.head_class.options()))
        if unknown:
            accepted = sorted(cls.parameter_names())
            named = with_nearest(unknown, accepted)
            raise ValueError(f"policy_kwargs: {named} is unknown to {cls.__name__}; accepted are {', '.join(accepted)}.")

    @classmethod
    def head_for(cls, action_space: ActionSpace) -> type[ActionHead]:
        """
        The head that learns actions of a space.

        :raises ValueError: there is none
        """
        if isinstance(action_space, spaces.Box):
            return cls.head_class
        if cls.head_class.discrete is None:
            name = cls.head_class.algorithm
            raise ValueError(f"{name} learns vectors of numbers and not {action_space}; use DT for Discrete actions.")
        return cls.head_class.discrete

    def _make_optimizer(self, learning_rate: float) -> FlatAdamW:
        """AdamW whose weight decay spares biases, norms and embeddings."""
        decayed = {id(module.weight) for module in self.network.modules() if isinstance(module, nn.Linear)}
        matrices = [parameter for parameter in self.network.parameters() if id(parameter) in decayed]
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in decayed]
        return_range = self.network.return_range
        unclipped = [*self.network.head.unclipped_parameters(), *([] if return_range is None else return_range.parameters())]
        return FlatAdamW(matrices, others, unclipped, learning_rate, self.weight_decay)

    def set_weight_decay(self, weight_decay: float) -> None:
        """
        :param weight_decay: of weight matrices from the next gradient step on
        """
        self.optimizer.param_groups[0]["weight_decay"] = self.weight_decay = weight_decay

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """
        torch's, for a policy with or without a moving average whatever was saved: one that begins starts from the weights.

        :param state_dict: of a policy like this one
        :param strict: as in torch
        :param assign: as in torch
        """
        weights = {name: value for name, value in state_dict.items() if not name.startswith("ema_network.")}
        if self.ema_network is None:
            state_dict = weights
        elif len(weights) == len(state_dict):
            averaged = {f"ema_{name}": value for name, value in weights.items() if name.startswith("network.")}
            state_dict = {**weights, **averaged}
        return super().load_state_dict(state_dict, strict, assign)

    def scaled_windows(self, batch: Windows) -> Windows:
        """The windows of a buffer, with actions in [-1, 1]."""
        return batch._replace(actions=self.normalization.scale_action(batch.actions))

    def draw_noise(self, batch: Windows, generator: th.Generator) -> tuple[th.Tensor, ...]:
        """What the head's loss draws at random for a batch, see :meth:`ActionHead.draw_noise`."""
        return self.network.head.draw_noise(self._chunks(batch.actions), generator)

    def part_masks(self, mask: th.Tensor) -> dict[str, th.Tensor]:
        """See :meth:`ActionHead.part_masks`."""
        return self.network.head.part_masks(mask)

    def compute_loss(self, batch: Windows, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: windows of a buffer, actions in the environment's range, (B, K + H - 1, A) of them
        :param noise: what :meth:`draw_noise` gave for the batch
        :return: the loss to minimise, and its parts by their logged names
        """
        windows = self.scaled_windows(batch)
        chunks = self._chunks(windows.actions)
        windows = windows._replace(actions=windows.actions[:, : windows.mask.shape[1]])
        seen = self.normalization(windows)
        loss, parts = self.network.head.loss(self.network.trunk(**seen._asdict()), chunks, windows.mask, *noise)
        if self.network.return_range is not None:
            parts["return_range_loss"] = self.network.return_range.loss(seen.observations, seen.returns_to_go, seen.mask)
            loss = loss + parts["return_range_loss"]
        return loss, parts

    def _chunks(self, actions: th.Tensor) -> th.Tensor:
        """From actions (B, K + H - 1, A) to the H from each of K steps on, (B, K, H A), one after the other."""
        return actions.unfold(1, self.chunk_size, 1).transpose(2, 3).flatten(2)

    def action_mse(self, batch: Windows, generator: th.Generator) -> th.Tensor:
        """
        Mean squared error, in units of [-1, 1], of the acting policy's actions at each window's last step.

        The same measure for every head: what `predict` would do on recorded windows against what was recorded.

        :param batch: windows of a buffer
        :param generator: source of the noise that actions start from
        """
        self.set_training_mode(False)
        with th.no_grad():
            windows = self.scaled_windows(batch)
            network = self.acting_network
            hidden = self.hidden_states(network, windows, last_only=True).squeeze(1)
            actions = network.head(hidden, standard_normal(len(hidden), network.head.noise_dim, generator)).clamp(-1.0, 1.0)
            return (actions[:, : self.action_dim] - windows.actions[:, -1]).square().mean()

    def best_of_n_share(self, batch: Windows, generator: th.Generator) -> th.Tensor:
        """
        How often the critic has another candidate taken than the first one, at the newest steps of windows.

        :param batch: windows of a buffer
        :param generator: decides which rows of the noise table
        """
        self.set_training_mode(False)
        with th.no_grad():
            hidden = self.hidden_states(self.acting_network, self.scaled_windows(batch), last_only=True).squeeze(1)
            rows = th.randint(NOISE_ROWS, (len(hidden),), generator=generator, device=generator.device).cpu().numpy()
            _, chosen = self._draw_candidates(hidden, batch.observations[:, -1], rows, deterministic=True)
            return (chosen != 0).float().mean()

    def update_ema(self, decay: float) -> None:
        """
        Move the acting weights towards the trained ones.

        :param decay: share of the old average that stays
        """
        self._averaged.flat().lerp_(self.optimizer.flat_weights(), 1.0 - decay)

    def acting_settings(self) -> dict[str, Any]:
        """How to act: what may be changed after training, and is saved with the weights."""
        head = self.network.head
        own = {name: getattr(self, name) for name in self._acting_rules()}
        return {**own, **{name: getattr(head, name) for name in head.acting_choices}}

    def _acting_rules(self) -> dict[str, Rule]:
        """The policy's own ways of acting; the others are the head's."""
        return {
            "kv_cache": BOOLEAN,
            "n_action_steps": Number(low=1, high=self.chunk_size, whole=True),
            "n_action_samples": Number(low=1, high=NOISE_ROWS, whole=True),
            "sample_noise_std": POSITIVE,
            "temperature": NOT_NEGATIVE,
        }

    def _check_candidates(self, n_action_samples: int) -> None:
        if n_action_samples > 1 and self.critic is None:
            raise ValueError(
                f"n_action_samples={n_action_samples} needs a model that was trained with "
                "policy_kwargs=dict(critic_steps=...)."
            )

    def set_acting(self, **settings: Any) -> None:
        """
        Choose how to act; the trained weights do not depend on it.

        :param settings: some of :meth:`acting_settings`
        :raises ValueError: an unknown name, or a value out of range
        """
        unknown = sorted(set(settings) - set(self.acting_settings()))
        if unknown:
            accepted = self.acting_settings()
            raise ValueError(f"{with_nearest(unknown, accepted)}: no way of acting; accepted are {', '.join(accepted)}.")
        settings = {**self.acting_settings(), **settings}
        own = check_arguments(settings, self._acting_rules())
        self._check_candidates(own["n_action_samples"])
        if self.online_actor is not None and self.online_actor.residual:
            self.check_residual_actions(own["n_action_steps"])
        heads = self.network.head.check_acting(**{name: settings[name] for name in self.network.head.acting_choices})
        for name, value in own.items():
            setattr(self, name, value)
        for name, value in heads.items():
            setattr(self.network.head, name, value)
            setattr(self.acting_network.head, name, value)

    def get_extra_state(self) -> th.Tensor:
        """The settings of acting as JSON, to be saved with the weights; in a tensor, as all of a state dict is."""
        return th.tensor(list(json.dumps(self.acting_settings()).encode()), dtype=th.uint8)

    def set_extra_state(self, state: th.Tensor) -> None:
        try:
            settings = json.loads(bytes(state.tolist()))
            self.set_acting(**settings)
        except (TypeError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(f"The ways of acting that were saved are damaged: {error}.") from error

    def _get_constructor_parameters(self) -> dict[str, Any]:
        spaces_and_schedule = dict(
            observation_space=self.observation_space,
            action_space=self.action_space,
            lr_schedule=self._dummy_schedule,  # not needed to act
        )
        return {**spaces_and_schedule, **self._constructor_arguments}  # how it acts is among the weights

    def save(self, path: str) -> None:
        """
        SB3's: the policy alone.

        :param path: file to write
        :raises ValueError: it is finetuned, which only the model's own file can hold
        """
        if self.online_actor is not None:
            raise ValueError("A fine-tuned policy is saved with its model: model.save(path).")
        super().save(path)


def _own_parameters() -> set[str]:
    """The policy's own arguments, without the head's and without what every SB3 policy has."""
    parameters = inspect.signature(SequencePolicy.__init__).parameters.values()
    given_by_sb3 = ("self", "observation_space", "action_space", "lr_schedule")
    return {each.name for each in parameters if each.kind is not each.VAR_KEYWORD and each.name not in given_by_sb3}
