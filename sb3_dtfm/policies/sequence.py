"""The policy: a trunk, a head, and acting with the context of the last steps."""

import copy
import inspect
import json
from collections.abc import Mapping
from typing import Any, ClassVar, NoReturn

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_dtfm.actions import ActionSpace, from_vectors, vector_space
from sb3_dtfm.arguments import (
    BOOLEAN,
    COUNT,
    NOT_NEGATIVE,
    PROBABILITY_BELOW_1,
    Choice,
    Number,
    Rule,
    check_arguments,
    with_nearest,
)
from sb3_dtfm.heads import ActionHead
from sb3_dtfm.heads.base import NOISE_ROWS
from sb3_dtfm.networks.cpu import hand_out, take_up
from sb3_dtfm.networks.trunk import SequenceTrunk
from sb3_dtfm.policies.critic import Critic
from sb3_dtfm.policies.memory import RememberedContext
from sb3_dtfm.policies.normalization import Normalization
from sb3_dtfm.policies.steering import Steering, make_steering, steering_observation
from sb3_dtfm.windows import (
    Context,
    Windows,
    check_context,
    empty_context,
    push,
    restarts,
    unpack_observation,
    with_plan,
)

# How far apart in the noise table the candidates' rows lie, and those that chance chooses by: no divisors of its length.
CANDIDATE_STRIDE, CHOICE_STRIDE, CHOICE_START = 97, 31, 513
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
    "average_return_to_go": BOOLEAN,
    "film_return_to_go": BOOLEAN,
    "calm_units": BOOLEAN,
    "kv_cache": BOOLEAN,
    "critic_steps": Number(low=0, whole=True),
    "gamma": PROBABILITY_BELOW_1,
    "expectile": Number(low=0.5, high=1, below_high=True),
}
# What the algorithm gives to the policy by itself; everything else is for `policy_kwargs`.
FROM_ALGORITHM = ("context_length", "max_timestep", "weight_decay", "ema", "seed")


class SequenceNetwork(nn.Module):
    """
    Everything that is trained.

    :ivar n_products: multiplications of a step of a window on the way forward, without attention's
    """

    def __init__(self, trunk: SequenceTrunk, head: ActionHead) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = head
        self.n_products = trunk.tokens_per_step * _n_weights(trunk) + _n_weights(head)


class SequencePolicy(BasePolicy):
    """
    A policy over the last `context_length` steps: the trunk's hidden state, and a head that makes an action of it.

    `deterministic=True` starts from noise that belongs to the time step and the episode: rows of a table that is drawn once
    from `seed` and saved with the model, from a row on that the episode's first observation decides. Zero noise would be one
    point of the distribution, and following the same mode for ever gets an arm stuck; the same rows in every episode would
    give all of them the same luck.

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
    :param average_return_to_go: tell the trunk the return-to-go per remaining step of the longest episode instead of the sum
        (Emmons et al., 2022)
    :param film_return_to_go: let the return-to-go scale and shift what each block of the trunk gets, besides being a token
    :param calm_units: scale observations by what calm episodes spread, for data in which some agents' spread far wider; see
        :meth:`EpisodeTable.statistics`
    :param critic_steps: with each gradient step, how many a critic takes, which learns what actions are worth so that the
        best of several can be taken, see :class:`~sb3_dtfm.policies.critic.Critic`; trunk and head learn as without. It
        needs a head that draws; 0 for no critic
    :param gamma: discount of a step for the critic
    :param expectile: of the critic
    :param n_candidates: actions, or chunks, that are drawn each time, of which the critic has one taken; 1 asks no critic
    :param temperature: how much chance that choice leaves, in units of how far actions' values spread in the data; 0, the
        default, takes the most valuable one
    :param ema: keep an exponential moving average of the weights and act with it
    :param kv_cache: act on the keys and values kept of earlier steps instead of recomputing the window: two to three times
        faster, and equal until the window slides (see :meth:`SequenceTrunk.extend`)
    :param seed: seed of the noise that acting starts from
    :param head_options: options of the head, see its class
    :raises ValueError: an argument out of range or unknown, by name, or an action space that the head does not learn
    """

    head_class: ClassVar[type[ActionHead]]
    observation_space: spaces.Dict
    action_space: ActionSpace
    noise_table: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: ActionSpace,
        lr_schedule: Schedule,
        context_length: int = 20,
        max_timestep: int = 1000,
        embed_dim: int = 256,
        n_layers: int = 10,
        n_heads: int = 2,
        dropout: float = 0.1,
        timestep_embedding: bool = True,
        tokens_per_step: int = 3,
        chunk_size: int = 1,
        n_action_steps: int | None = None,
        weight_decay: float = 1e-3,
        clip_return_to_go: bool = False,
        average_return_to_go: bool = False,
        film_return_to_go: bool = False,
        calm_units: bool = False,
        critic_steps: int = 0,
        gamma: float = 0.99,
        expectile: float = 0.7,
        n_candidates: int = 1,
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
        self.n_candidates, self.temperature = arguments["n_candidates"], arguments["temperature"]
        self._constructor_arguments = {**arguments, **self.head_class.options(), **head_options}
        self.seed = seed
        self.observation_dim = int(observation_space["observation"].shape[0])  # type: ignore[index]
        self.vector_space = vector_space(action_space)
        self.action_dim = int(self.vector_space.shape[0])
        units = (self.observation_dim, self.vector_space, max_timestep)
        self.normalization = Normalization(*units, clip_return_to_go, average_return_to_go, calm_units)
        sizes = (self.observation_dim, self.action_dim, max_timestep, embed_dim, n_layers, n_heads)
        trunk = SequenceTrunk(*sizes, dropout, timestep_embedding, tokens_per_step, film_return_to_go)
        self.network = SequenceNetwork(trunk, head_class(embed_dim, self.chunk_size * self.action_dim, **head_options))
        self.ema_network = copy.deepcopy(self.network).requires_grad_(False) if ema else None
        self.optimizer = self._make_optimizer(lr_schedule(1.0))
        generator = th.Generator().manual_seed(0 if seed is None else seed)
        self.register_buffer("noise_table", self.network.head.deterministic_noise(generator))
        self.gamma, self.critic_steps = gamma, arguments["critic_steps"]
        self.n_valued = self.n_action_steps  # actions that the critic values together: those that are carried out
        self.critic: Critic | None = None
        if self.critic_steps:  # made last: the weights of all else are what they are without
            if self.network.head.noise_dim == 0:
                raise ValueError(
                    f"critic_steps={critic_steps}: the critic has nothing to choose among: {self.head_class.algorithm} "
                    "makes one action of what it sees, where DTFM draws."
                )
            self.critic = Critic(self.observation_dim, self.n_valued * self.action_dim, expectile=expectile)
        self._check_candidates(self.n_candidates)
        self.steering: Steering | None = None
        self._acting_generator: th.Generator | None = None
        self._remembered = RememberedContext()

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

    @property
    def acting_network(self) -> SequenceNetwork:
        """The weights that choose actions: the moving average if there is one."""
        return self.network if self.ema_network is None else self.ema_network

    def _make_optimizer(self, learning_rate: float) -> th.optim.Optimizer:
        """AdamW whose weight decay spares biases, norms and embeddings."""
        matrices = [m.weight for m in self.network.modules() if isinstance(m, nn.Linear)]
        decayed = {id(weight) for weight in matrices}
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in decayed]
        groups = [{"params": matrices, "weight_decay": self.weight_decay}, {"params": others, "weight_decay": 0.0}]
        return self.optimizer_class(groups, lr=learning_rate, fused=True)  # type: ignore[call-arg]

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

    def clipped_parameters(self) -> list[nn.Parameter]:
        """The parameters whose gradient norm is logged and clipped."""
        spared = {id(parameter) for parameter in self.network.head.unclipped_parameters()}
        return [parameter for parameter in self.network.parameters() if id(parameter) not in spared]

    def scaled_windows(self, batch: Windows) -> Windows:
        """The windows of a buffer, with actions in [-1, 1]."""
        return batch._replace(actions=self.normalization.scale_action(batch.actions))

    def hidden_states(self, network: SequenceNetwork, windows: Windows, last_only: bool = False) -> th.Tensor:
        """
        Run the trunk on windows in environment units, actions in [-1, 1].

        :return: (B, K, D), or (B, 1, D) of the newest steps with `last_only`
        """
        return network.trunk(**self.normalization(windows)._asdict(), last_only=last_only)

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
        return self.network.head.loss(self.hidden_states(self.network, windows), chunks, windows.mask, *noise)

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

    def update_ema(self, decay: float) -> None:
        """
        Move the acting weights towards the trained ones.

        :param decay: share of the old average that stays
        """
        averaged = tuple(parameter.data for parameter in self.acting_network.parameters())
        trained = tuple(parameter.data for parameter in self.network.parameters())
        th._foreach_lerp_(averaged, trained, 1.0 - decay)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose actions with the whole context.

        With `state` or `episode_start` given this is a pure function: a context belongs to whoever passes it on. With
        neither, the policy remembers the context of one caller, so that `action, _ = model.predict(obs)` in a loop is
        enough: a row starts anew where its time step is not the last one plus one, and is asked again where both time step
        and observation are the last ones. :meth:`reset` forgets it.

        Actions are finite and inside the action space. What cannot be acted on is an error before anything has changed: the
        caller mends the row that it names, or begins it anew, and asks again; the other rows go on as if nothing had been.

        :param observation: Dict of `observation` (O,), `return_to_go` (1,), `timestep` (1,), or with a leading axis B
        :param state: what the last call returned
        :param episode_start: (B,) bool, True where an environment was just reset
        :param deterministic: repeat exactly for the same model, state and inputs; otherwise draw fresh noise
        :return: actions (A,) or (B, A) in the environment's range, of a Discrete space () or (B,), and the next state
        :raises ValueError: not the observation of a `ReturnToGoWrapper`; a number that is not finite or a time step that is
            none, by key and row; a state of other environments, or one that holds no finite numbers
        """
        arrays, vectorized = unpack_observation(observation, self.observation_dim)
        n_rows, timestep = len(arrays[0]), arrays[2]
        remembers = state is None and episode_start is None
        if episode_start is not None:
            episode_start = _check_episode_start(episode_start, n_rows)
        before = self._known(self._remembered.recall(arrays[0], timestep) if remembers else state, n_rows)
        lost = restarts(before, timestep) & (timestep > 0)
        if episode_start is not None:
            lost &= ~episode_start
        if lost.any():
            self._remembered.warn(f"Time step {timestep[lost][0]} follows none that is known: its past is missing.")
        context = push(before, *arrays, episode_start=episode_start)
        context = self._act(context, deterministic)
        if remembers:
            self._remembered.remember(before, context)
        action = self._to_environment(context.actions[:, -1])
        return action if vectorized else action.squeeze(axis=0), tuple(context)

    def _known(self, state: tuple[np.ndarray, ...] | None, n_rows: int) -> Context:
        """The context to go on from; a plan for another number of steps than are planned now is dropped."""
        nothing = self._empty_context(n_rows)
        if state is None:
            return nothing
        before = check_context(state, nothing)
        if before.plan.shape != nothing.plan.shape:
            before = before._replace(plan=nothing.plan, n_planned=nothing.n_planned)
        return before

    def look(
        self,
        observation: dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
    ) -> tuple[Context, th.Tensor]:
        """
        The first half of acting, for a caller who chooses the noise: :meth:`act_from_noise` is the second one.

        A pure function, as `predict` with a `state`.

        :param observation: as for :meth:`predict`
        :param state: what :meth:`act_from_noise` or :meth:`predict` returned; None for no past
        :param episode_start: (B,) bool, True where an environment was just reset
        :return: the context with the newest step, and the trunk's hidden states (B, D)
        :raises ValueError: as :meth:`predict`
        """
        arrays, _ = unpack_observation(observation, self.observation_dim)
        n_rows = len(arrays[0])
        if episode_start is not None:
            episode_start = _check_episode_start(episode_start, n_rows)
        context = push(self._known(state, n_rows), *arrays, episode_start=episode_start)
        self._stop_training()
        with th.inference_mode():
            hidden, keys_values = self._hidden(context, np.ones(n_rows, bool))
        assert hidden is not None
        return context._replace(keys_values=keys_values), hidden

    def act_from_noise(self, context: Context, hidden: th.Tensor, noise: np.ndarray) -> tuple[np.ndarray, Context]:
        """
        The second half: what this noise leads to. Whatever was planned before is dropped.

        :param context: what :meth:`look` returned, with `hidden`
        :param hidden: (B, D)
        :param noise: (B, N), for the head's `noise_dim`
        :return: actions of this step and of those planned, (B, n_action_steps, A) in the environment's range, and the next
            `state`; until it is `look`'s turn again, `predict` gives the planned ones
        :raises ValueError: noise that leads to no finite action
        """
        with th.inference_mode():
            chunks = self._to_chunks(self._decode(hidden, th.as_tensor(noise, dtype=th.float32, device=hidden.device)))
        context = self._carry_out(context, np.ones(len(noise), bool), chunks)
        planned = np.concatenate([context.actions[:, -1:], context.plan], axis=1)
        return self._to_environment(planned), context

    def steering_observation(
        self, windows: Windows, hidden: th.Tensor | None, rows: np.ndarray | slice = slice(None)
    ) -> th.Tensor:
        """
        What noise is chosen by, see :func:`~sb3_dtfm.policies.steering.steering_observation`.

        :param windows: arrays (B, K, ...) in the environment's units; the newest step is read
        :param hidden: (b, D), None to leave it out
        :param rows: b of the B rows; all by default
        :return: (b, F)
        """
        newest = Windows(*(th.from_numpy(each[rows, -1:]).to(self.device) for each in windows))
        return steering_observation(self.normalization, newest, hidden)

    def check_steerable(self) -> int:
        """
        :return: N, numbers of the noise that somebody else may choose
        :raises ValueError: there is no flow
        """
        head = self.network.head
        if not head.noise_dim or not isinstance(self.action_space, spaces.Box):
            name = type(self).__name__.removesuffix("Policy")
            raise ValueError(f"{name} of {self.action_space} has no flow whose noise could be chosen; a DTFM is needed.")
        return head.noise_dim

    def set_steering(self, settings: dict[str, Any] | None) -> None:
        """
        Let a network choose the noise from now on; its weights are for the caller to load.

        :param settings: of :class:`~sb3_dtfm.policies.steering.Steering`; None draws noise again
        :raises ValueError: the head starts from no noise, or a setting out of range
        """
        if settings is None:
            self.steering = None
            return
        steering = make_steering(self.observation_dim, self.network.trunk.embed_dim, self.check_steerable(), settings)
        self.steering = steering.to(self.device).requires_grad_(False)

    def reset(self) -> None:
        """Forget the context that `predict` remembers for a caller who passes no `state`."""
        self._remembered.forget()

    def _to_environment(self, scaled_action: np.ndarray) -> np.ndarray:
        """From [-1, 1] into the action space, in its own precision."""
        low, high = self.vector_space.low, self.vector_space.high
        action = (low + 0.5 * (scaled_action + 1.0) * (high - low)).astype(self.vector_space.dtype)
        return from_vectors(np.clip(action, low, high), self.action_space)

    def _empty_context(self, n_rows: int) -> Context:
        sizes = (self.context_length, self.observation_dim, self.action_dim)
        return empty_context(n_rows, *sizes, plan_length=self.n_action_steps - 1)

    def _act(self, context: Context, deterministic: bool) -> Context:
        """
        Fill in the newest step's actions, in [-1, 1]: planned ones, and chosen ones where none are left.

        :raises ValueError: they would not be finite
        """
        self._stop_training()
        due = context.n_planned == 0
        with th.inference_mode():
            chunks, keys_values = self._choose(context, due, deterministic)
        return self._carry_out(context, due, chunks)._replace(keys_values=keys_values)

    def _stop_training(self) -> None:
        if self.training:
            self.set_training_mode(False)  # goes through all modules

    def _carry_out(self, context: Context, due: np.ndarray, chunks: np.ndarray) -> Context:
        """
        The newest step's actions, and plans for the next ones.

        :param due: (B,) bool, b rows that have new actions
        :param chunks: (b, H, A) in [-1, 1]
        :raises ValueError: they are not finite
        """
        if not (fits := np.isfinite(chunks)).all():
            self._refuse(context, np.flatnonzero(due)[~fits.all(axis=(1, 2))])
        return with_plan(context, due, chunks[:, : self.n_action_steps])

    @staticmethod
    def _refuse(context: Context, rows: np.ndarray) -> NoReturn:
        """
        Say why there is no finite action for some rows, although what `predict` lets in is finite.

        :param rows: their indices
        :raises ValueError: always
        """
        names = [name for name, array in context._asdict().items() if not np.isfinite(array[rows]).all()]
        largest = np.abs(context.returns_to_go[rows]).max()
        cause = (
            f"state holds NaN or infinity in {', '.join(names)}. Begin these rows anew with episode_start."
            if names
            else f"the policy's weights give none for a return_to_go of {largest:g}. Ask for less, or load other weights."
        )
        raise ValueError(f"There is no finite action in row {', '.join(map(str, rows))}: {cause}")

    def _choose(self, context: Context, due: np.ndarray, deterministic: bool) -> tuple[np.ndarray, np.ndarray]:
        """
        :param due: (B,) bool, rows that need new actions, b of them
        :return: (b, H, A) in [-1, 1], and the keys and values to keep, which grow with each step, due or not
        """
        hidden, keys_values = self._hidden(context, due)
        if hidden is None:
            return np.zeros((0, self.chunk_size, self.action_dim), np.float32), keys_values
        rows = context.timesteps[due, -1] + context.episode_keys[due]
        if self.n_candidates > 1 and self.steering is None:
            observations = th.from_numpy(context.observations[due, -1]).to(hidden.device)
            candidates, chosen = self._draw_candidates(hidden, observations, rows, deterministic)
            return self._to_chunks(candidates[th.arange(len(chosen), device=hidden.device), chosen]), keys_values
        noise = self._acting_noise(rows, deterministic).to(hidden.device)
        if self.steering is not None:
            shown = self.steering_observation(context.windows, hidden if self.steering.hidden_state else None, due)
            noise = self.steering(shown, noise)
        return self._to_chunks(self._decode(hidden, noise)), keys_values

    def _hidden(self, context: Context, due: np.ndarray) -> tuple[th.Tensor | None, np.ndarray]:
        """
        :param due: (B,) bool, rows that need new actions, b of them
        :return: hidden states (b, D) of the newest steps, None where none is due; and the keys and values to keep, which
            grow with each step, due or not
        """
        caches = self.kv_cache and self.context_length > 1
        keys_values = np.zeros((len(due), 0), np.float32)
        if not caches and not due.any():
            return None, keys_values
        device = self.device  # SB3 looks for it among the parameters each time
        windows = Windows(*(th.from_numpy(each if caches else each[due]).to(device) for each in context.windows))
        if not caches:
            return self.hidden_states(self.acting_network, windows, last_only=True).squeeze(1), keys_values
        hidden, keys_values = self._extend(self.normalization(windows), context.keys_values)
        return (hidden[th.from_numpy(due).to(device)] if due.any() else None), keys_values

    def _decode(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """From hidden states (b, D) and noise (b, N) to chunks (b, H A) in [-1, 1]."""
        return self.acting_network.head(hidden, noise).clamp(-1.0, 1.0)

    def _to_chunks(self, actions: th.Tensor) -> np.ndarray:
        """From (b, H A) to (b, H, A) on the CPU."""
        return actions.cpu().numpy().reshape(-1, self.chunk_size, self.action_dim)

    def _draw_candidates(
        self, hidden: th.Tensor, observations: th.Tensor, rows: np.ndarray, deterministic: bool
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Several draws from the head, and which of them the critic has taken.

        :param hidden: (b, D)
        :param observations: (b, O) as the environment gives them
        :param rows: (b,) of the noise table; the first candidate's are these
        :return: (b, N, H A) in [-1, 1], and (b,) int64
        """
        assert self.critic is not None
        n, turns = self.n_candidates, np.arange(self.n_candidates)
        noise = self._acting_noise((rows[:, None] + CANDIDATE_STRIDE * turns).ravel(), deterministic).to(hidden.device)
        candidates = self._decode(hidden.repeat_interleave(n, dim=0), noise).view(len(hidden), n, -1)
        chance = self._acting_noise((rows[:, None] + CHOICE_START + CHOICE_STRIDE * turns).ravel(), deterministic)
        uniform = th.special.ndtr(chance[:, 0]).clamp(1e-6, 1 - 1e-6).view(len(hidden), n).to(hidden.device)
        states = self.normalization.scale_observation(observations).unsqueeze(1).expand(-1, n, -1)
        values = self.critic(states, candidates[..., : self.n_valued * self.action_dim])
        return candidates, self.critic.choose(values, self.temperature, uniform)

    def guided_share(self, batch: Windows, generator: th.Generator) -> th.Tensor:
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

    def _extend(self, windows: Windows, kept: np.ndarray) -> tuple[th.Tensor, np.ndarray]:
        """
        The newest hidden states from what was kept, and what to keep for the next step.

        :param windows: normalised
        :param kept: (B, layers, 2, L, D) for the L tokens before the newest, or (B, 0) if the last steps were acted without
            a cache
        :return: (B, D) hidden states, and the new `kept`
        """
        trunk, device = self.acting_network.trunk, windows.mask.device
        n_new = trunk.tokens_per_step
        n_kept = trunk.n_tokens(self.context_length) - n_new
        shape = (len(windows.mask), trunk.n_layers, 2, n_kept, trunk.embed_dim)
        n_missing = 0
        if kept.shape != shape:
            kept = np.zeros(shape, np.float32)
            n_missing = int(windows.mask.sum(dim=1).max()) - 1
        for n_back in range(n_missing, -1, -1):
            earlier = Windows(*(x.roll(n_back, dims=1) for x in windows)) if n_back else windows
            earlier.mask[:, :n_back] = False  # the newest steps went round to the left
            memory, end = take_up(kept, n_new, device)
            start, end = end - n_kept, end + n_new
            hidden, _ = trunk.extend(**earlier._asdict(), keys_values=memory[..., start:end, :])
            kept = hand_out(memory, start + n_new, end)
        return hidden, kept

    def _acting_noise(self, rows: np.ndarray, deterministic: bool) -> th.Tensor:
        """What the newest step's actions start from, (B, noise_dim): of these rows of the table, (B,), or fresh."""
        if deterministic or self.network.head.noise_dim == 0:
            return self.noise_table[th.from_numpy(rows % len(self.noise_table)).to(self.noise_table.device)]
        if self._acting_generator is None:
            self.seed_noise(self.seed)
        assert self._acting_generator is not None
        return standard_normal(len(rows), self.network.head.noise_dim, self._acting_generator)

    def seed_noise(self, seed: int | None) -> None:
        """
        Start the noise of `deterministic=False` anew.

        :param seed: None draws one
        """
        self._acting_generator = th.Generator(self.device)
        if seed is None:
            self._acting_generator.seed()
        else:
            self._acting_generator.manual_seed(seed)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Actions (B, A) in the environment's range for single steps without a past."""
        assert isinstance(observation, dict)
        numbers = {key: value.cpu().numpy() for key, value in observation.items()}
        arrays, _ = unpack_observation(numbers, self.observation_dim)
        context = self._act(push(self._empty_context(len(arrays[0])), *arrays), deterministic)
        return th.as_tensor(self._to_environment(context.actions[:, -1]), device=self.device)

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

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
            "n_candidates": Number(low=1, high=NOISE_ROWS, whole=True),
            "temperature": NOT_NEGATIVE,
        }

    def _check_candidates(self, n_candidates: int) -> None:
        if n_candidates > 1 and self.critic is None:
            raise ValueError(
                f"n_candidates={n_candidates} needs a model that was trained with policy_kwargs=dict(critic_steps=...)."
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
        self._check_candidates(own["n_candidates"])
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
        return {**spaces_and_schedule, **self._constructor_arguments, **self.acting_settings()}


def _n_weights(network: nn.Module) -> int:
    """Numbers in its linear layers' weights."""
    return sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, nn.Linear))


def _own_parameters() -> set[str]:
    """The policy's own arguments, without the head's and without what every SB3 policy has."""
    parameters = inspect.signature(SequencePolicy.__init__).parameters.values()
    given_by_sb3 = ("self", "observation_space", "action_space", "lr_schedule")
    return {each.name for each in parameters if each.kind is not each.VAR_KEYWORD and each.name not in given_by_sb3}


def _check_episode_start(episode_start: Any, n_rows: int) -> np.ndarray:
    """
    :return: (B,) bool, or (1,) for all rows alike
    :raises ValueError: not one for each row, nor one for all
    """
    starts = np.asarray(episode_start, dtype=bool).reshape(-1)
    if len(starts) not in (1, n_rows):
        raise ValueError(f"episode_start has shape {np.shape(episode_start)}; ({n_rows},) is expected.")
    return starts


def standard_normal(n_rows: int, dim: int, generator: th.Generator) -> th.Tensor:
    return th.randn(n_rows, dim, generator=generator, device=generator.device)
