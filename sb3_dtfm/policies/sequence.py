"""The policy: networks made from its options, their optimiser, and acting with the context of the last steps."""

import copy
import json
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_dtfm.actions import ActionSpace, from_vectors, unscaled, vector_space
from sb3_dtfm.arguments import COUNT, NOT_NEGATIVE, check_arguments, with_nearest
from sb3_dtfm.heads import ActionHead
from sb3_dtfm.heads.base import NOISE_ROWS
from sb3_dtfm.networks.cache import extend_cache
from sb3_dtfm.networks.optimizer import FlatAdamW, FlatTensors
from sb3_dtfm.networks.trunk import SequenceTrunk
from sb3_dtfm.policies.context import (
    Context,
    check_chunks,
    check_context,
    check_episode_start,
    empty_context,
    push,
    restarts,
    unpack_observation,
    with_plan,
)
from sb3_dtfm.policies.critic import Critic
from sb3_dtfm.policies.images import ImageEncoder, image_spaces, unpack_images
from sb3_dtfm.policies.memory import RememberedContext
from sb3_dtfm.policies.network import ReturnRange, SequenceNetwork
from sb3_dtfm.policies.normalization import Normalization
from sb3_dtfm.policies.options import PolicyOptions
from sb3_dtfm.windows import OBSERVATION, Windows, map_tensors


class SequencePolicy(BasePolicy):
    """
    A policy over the last `context_length` steps: the Transformer's hidden state, and a head that makes an action of it.

    `deterministic=True` starts from noise that belongs to the time step and the episode: rows of a table that is drawn once
    from `seed` and saved with the model, from a row on that the episode's first observation decides. Zero noise would be one
    point of the distribution, and following the same mode for ever gets a robot arm stuck. The same rows in every episode
    would correlate the episodes.

    :param observation_space: Dict of `observation` (O,), `return_to_go` (1,) and `timestep` (1,), and images (channels,
        height, width) uint8 by camera, whose features stand behind the observation for all that follows: (O + F,)
    :param action_space: bounded Box (A,); or Discrete, whose actions are vectors for all but `predict`, see
        :mod:`~sb3_dtfm.actions`
    :param lr_schedule: learning rate over the progress remaining, from 1 to 0
    :param context_length: number K of steps that the policy sees
    :param max_timestep: number of time steps with an embedding of their own
    :param weight_decay: AdamW's weight decay, of weight matrices only
    :param ema: whether the policy keeps an exponential moving average of the weights, and acts with it
    :param seed: seed of the noise that acting starts from
    :param options: options of :class:`~sb3_dtfm.policies.options.PolicyOptions` and of the head
    :raises ValueError: an argument out of range or unknown, by name, or an action space that the head does not learn
    """

    observation_space: spaces.Dict
    action_space: ActionSpace
    head_class: ClassVar[type[ActionHead]]
    noise_table: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: ActionSpace,
        lr_schedule: Schedule,
        context_length: int = 1,
        max_timestep: int = 1000,
        weight_decay: float = 1e-3,
        ema: bool = False,
        seed: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(observation_space, action_space, normalize_images=False, optimizer_class=th.optim.AdamW)
        given = {"context_length": context_length, "max_timestep": max_timestep, "weight_decay": weight_decay}
        check_arguments(given, {"context_length": COUNT, "max_timestep": COUNT, "weight_decay": NOT_NEGATIVE})
        self._check_names(options)
        head_class = self.head_for(action_space)
        of_the_head = {name: options.pop(name) for name in self.head_class.options_class.defaults() if name in options}
        self.options = PolicyOptions(**options)
        if self.options.chunk_size > 1 and not isinstance(action_space, spaces.Box):
            raise ValueError(
                f"chunk_size must be 1 for {action_space}, whose actions are chosen one by one; "
                f"got {self.options.chunk_size}."
            )
        self.context_length = context_length
        self.weight_decay = weight_decay
        self.seed = seed
        self.vector_dim = int(observation_space["observation"].shape[0])  # type: ignore[index]
        self.image_spaces = image_spaces(observation_space)
        encoder = self._make_encoder()
        self.observation_dim = self.vector_dim + (0 if encoder is None else encoder.features_dim)
        self.vector_space = vector_space(action_space)
        self.action_dim = int(self.vector_space.shape[0])
        self.normalization = self._make_normalization(max_timestep)
        self.network = self._make_network(head_class, of_the_head, encoder)
        self._constructor_arguments = {
            **given, "ema": ema, "seed": seed, **vars(self.options), **vars(self.network.head.options)
        }  # fmt: skip
        self.ema_network = copy.deepcopy(self.network).requires_grad_(False) if ema else None
        self.optimizer: FlatAdamW = self._make_optimizer(lr_schedule(1.0))
        averaged = dict(zip(self.network.parameters(), self.acting_network.parameters(), strict=True))
        self._averaged = FlatTensors(averaged[parameter] for parameter in self.optimizer.parameters)
        generator = th.Generator().manual_seed(0 if seed is None else seed)
        self.register_buffer("noise_table", self.network.head.deterministic_noise(generator))
        self.critic_horizon = self.options.n_action_steps  # the critic values the actions that are carried out together
        self.critic: Critic | None = None
        if self.options.critic_steps:  # made last: the weights of all else are what they are without
            if self.network.head.noise_dim == 0:
                raise ValueError(
                    f"critic_steps={self.options.critic_steps}: the critic has nothing to choose among: "
                    f"{self.head_class.algorithm} predicts one action for an observation, where DTFM samples."
                )
            sizes = (self.observation_dim, self.critic_horizon * self.action_dim)
            self.critic = Critic(*sizes, expectile=self.options.expectile)
        self.online_actor: nn.Module | None = None  # fine-tuned models have one, see sb3_dtfm.finetuning
        self._acting_generator: th.Generator | None = None
        self._remembered = RememberedContext()

    def _make_normalization(self, max_timestep: int) -> Normalization:
        own = self.options
        scaling = own.return_scaling if own.return_conditioning else None
        sizes = (self.observation_dim, self.vector_space, max_timestep)
        return Normalization(*sizes, own.clip_return_to_go, scaling, own.observation_scaling)

    def _make_encoder(self) -> ImageEncoder | None:
        own = self.options
        if not self.image_spaces:
            return None
        extractor = (own.features_extractor_class, own.features_extractor_kwargs or {})
        return ImageEncoder(self.image_spaces, *extractor, own.normalize_images, own.share_features_extractor)

    def _make_network(
        self, head_class: type[ActionHead], of_the_head: dict[str, Any], encoder: ImageEncoder | None
    ) -> SequenceNetwork:
        own = self.options
        trunk = SequenceTrunk(
            self.observation_dim,
            self.action_dim,
            self.normalization.max_timestep,
            own.embed_dim,
            own.n_layers,
            own.n_heads,
            own.dropout,
            own.timestep_embedding,
            own.tokens_per_step,
            own.film_return_to_go and own.return_conditioning,
        )
        head = head_class(own.embed_dim, own.chunk_size * self.action_dim, **of_the_head)
        ranged = own.return_range and own.clip_return_to_go and own.return_conditioning
        return SequenceNetwork(trunk, head, ReturnRange(self.observation_dim) if ranged else None, encoder)

    @classmethod
    def parameter_names(cls) -> set[str]:
        """Keys of `policy_kwargs`: options of the policy and of its head."""
        return set(PolicyOptions.defaults()) | set(cls.head_class.options_class.defaults())

    @classmethod
    def _check_names(cls, options: dict[str, Any]) -> None:
        unknown = sorted(set(options) - cls.parameter_names())
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
        decayed = {id(module.weight) for module in self.network.modules() if isinstance(module, nn.Linear | nn.Conv2d)}
        matrices = [parameter for parameter in self.network.parameters() if id(parameter) in decayed]
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in decayed]
        return_range = self.network.return_range
        unclipped = [*self.network.head.unclipped_parameters(), *([] if return_range is None else return_range.parameters())]
        return FlatAdamW(matrices, others, unclipped, learning_rate, self.weight_decay)

    def set_weight_decay(self, weight_decay: float) -> None:
        """
        :param weight_decay: weight decay of weight matrices, from the next gradient step on
        """
        self.optimizer.param_groups[0]["weight_decay"] = self.weight_decay = weight_decay

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """
        Load a state as torch does. A moving average that was not saved starts from the weights; an unwanted one is dropped.

        :param state_dict: state of a policy like this one
        :param strict: whether the names have to be those of this policy, as in torch
        :param assign: whether tensors replace the policy's instead of being copied into them, as in torch
        """
        weights = {name: value for name, value in state_dict.items() if not name.startswith("ema_network.")}
        if self.ema_network is None:
            state_dict = weights
        elif len(weights) == len(state_dict):
            averaged = {f"ema_{name}": value for name, value in weights.items() if name.startswith("network.")}
            state_dict = {**weights, **averaged}
        return super().load_state_dict(state_dict, strict, assign)

    def update_ema(self, decay: float) -> None:
        """
        Move the acting weights towards the trained ones.

        :param decay: share of the old average that stays
        """
        self._averaged.flat().lerp_(self.optimizer.flat_weights(), 1.0 - decay)

    @property
    def acting_network(self) -> SequenceNetwork:
        """The weights that choose actions: the moving average if there is one."""
        return self.network if self.ema_network is None else self.ema_network

    def newest_hidden(self, batch: Windows) -> th.Tensor:
        """
        :param batch: windows of a buffer, (B, K, ...)
        :return: hidden states (B, D) of their newest steps, by the network that acts
        """
        self._stop_training()
        network = self.acting_network
        seen = batch._replace(observations=network.see(batch.observations))
        return network.newest_hidden(self.normalization.scale_batch(seen))

    def action_mse(self, batch: Windows, generator: th.Generator) -> th.Tensor:
        """
        Mean squared error, in units of [-1, 1], of the acting policy's actions at each window's last step.

        The same measure for every head: what `predict` would do on recorded windows against what was recorded.

        :param batch: windows of a buffer
        :param generator: source of the noise that actions start from
        """
        with th.no_grad():
            hidden = self.newest_hidden(batch)
            noise = standard_normal(len(hidden), self.network.head.noise_dim, generator)
            actions = self.acting_network.decode(hidden, noise)[:, : self.action_dim]
            return (actions - self.normalization.scale_action(batch.actions[:, -1])).square().mean()

    def best_of_n_share(self, batch: Windows, generator: th.Generator) -> th.Tensor:
        """
        Return how often the critic has another sample taken than the first one, at the newest steps of windows.

        :param batch: windows of a buffer
        :param generator: random number generator that draws the rows of the noise table
        """
        with th.no_grad():
            hidden = self.newest_hidden(batch)
            rows = th.randint(NOISE_ROWS, (len(hidden),), generator=generator, device=generator.device).cpu().numpy()
            newest = self.acting_network.see(map_tensors(lambda each: each[:, -1], batch.observations))
            _, chosen = self._best_of_n(hidden, newest, rows, deterministic=True)
            return (chosen != 0).float().mean()

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

        Actions are finite and inside the action space. Invalid input is an error before anything has changed: the
        caller mends the row that it names, or begins it anew, and asks again; the other rows go on as if nothing had been.

        :param observation: Dict of `observation` (O,), `return_to_go` (1,), `timestep` (1,), or with a leading axis B, and
            images by camera, channels first or last
        :param state: state that the last call returned
        :param episode_start: (B,) bool, True where an environment was just reset
        :param deterministic: whether actions repeat exactly for the same model, state and inputs; otherwise noise is fresh
        :return: actions (A,) or (B, A) in the environment's range, of a Discrete space () or (B,), and the next state
        :raises ValueError: not the observation of a `ReturnToGoWrapper`; a number that is not finite or a time step that is
            none, by key and row; a state of other environments, or one that holds no finite numbers
        """
        arrays, frames, vectorized = self._unpack(observation)
        n_rows, timestep = len(arrays[0]), arrays[2]
        remembers = state is None and episode_start is None
        if episode_start is not None:
            episode_start = check_episode_start(episode_start, n_rows)
        before = self._known(self._remembered.recall(arrays[0], timestep) if remembers else state, n_rows)
        lost = restarts(before, timestep) & (timestep > 0)
        if episode_start is not None:
            lost &= ~episode_start
        if lost.any():
            step = int(timestep[lost][0])
            self._remembered.warn(
                f"predict() got time step {step} without step {step - 1} before it, so the action ignores earlier steps. "
                f"Pass the state that predict() returned for step {step - 1}."
            )
        context = push(before, *arrays, episode_start=episode_start, frames=frames)
        context = self._act(context, deterministic)
        action = self._to_environment(context.actions[:, -1])
        if remembers:
            context = self._remembered.remember(before, context)
        return action if vectorized else action.squeeze(axis=0), context

    def looks_next(self, state: tuple[np.ndarray, ...]) -> np.ndarray:
        """
        Return for which environments the next images matter. With a context of one step, those of planned actions do not.

        :param state: state that :meth:`predict` returned
        :return: (B,) bool
        """
        planned = Context(*state).n_planned > 0
        return ~planned if self.context_length == 1 else np.ones(len(planned), bool)

    def _unpack(self, observation: Any) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], list[np.ndarray], bool]:
        """
        :param observation: observation, as for :meth:`predict`
        :return: observation (B, O + F), return-to-go (B,) and time step (B,); vectors and images as they came, (B, ...)
            each; and whether B was there
        """
        (vector, return_to_go, timestep), vectorized = unpack_observation(observation, self.vector_dim)
        if not self.image_spaces:
            return (vector, return_to_go, timestep), [vector], vectorized
        images = unpack_images(observation, self.image_spaces, len(vector))
        self._stop_training()
        with th.inference_mode():
            seen = {name: th.from_numpy(each).to(self.device) for name, each in {OBSERVATION: vector, **images}.items()}
            features = self.acting_network.see(seen).cpu().numpy()
        return (features, return_to_go, timestep), [vector, *images.values()], vectorized

    def _known(self, state: tuple[np.ndarray, ...] | None, n_rows: int) -> Context:
        """The context to go on from; a plan for another number of steps than are planned now is dropped."""
        nothing = self._empty_context(n_rows)
        if state is None:
            return nothing
        before = check_context(state, nothing)
        if before.plan.shape != nothing.plan.shape:
            before = before._replace(plan=nothing.plan, n_planned=nothing.n_planned)
        return before

    def encode(
        self,
        observation: dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
    ) -> tuple[Context, th.Tensor]:
        """
        The first half of acting, for a caller who chooses the noise: :meth:`decode` is the second one.

        A pure function, as `predict` with a `state`.

        :param observation: observation, as for :meth:`predict`
        :param state: state that :meth:`decode` or :meth:`predict` returned; None for no past
        :param episode_start: (B,) bool, True where an environment was just reset
        :return: the context with the newest step, and the Transformer's hidden states (B, D)
        :raises ValueError: as :meth:`predict`
        """
        arrays, frames, _ = self._unpack(observation)
        n_rows = len(arrays[0])
        if episode_start is not None:
            episode_start = check_episode_start(episode_start, n_rows)
        context = push(self._known(state, n_rows), *arrays, episode_start=episode_start, frames=frames)
        self._stop_training()
        with th.inference_mode():
            hidden, keys_values = self._hidden(context, np.ones(n_rows, bool))
        assert hidden is not None
        return context._replace(keys_values=keys_values), hidden

    def decode(self, context: Context, hidden: th.Tensor, noise: np.ndarray) -> tuple[np.ndarray, Context]:
        """
        The second half: the actions that this noise leads to. Earlier plans are dropped.

        :param context: context that :meth:`encode` returned with `hidden`
        :param hidden: (B, D)
        :param noise: (B, N), for the head's `noise_dim`
        :return: actions of this step and of those planned, (B, n_action_steps, A) in the environment's range, and the next
            `state`; until it is `encode`'s turn again, `predict` gives the planned ones
        :raises ValueError: noise that leads to no finite action
        """
        with th.inference_mode():
            chosen = self.acting_network.decode(hidden, th.as_tensor(noise, dtype=th.float32, device=hidden.device))
            chunks = self._to_chunks(chosen)
        return self.apply_actions(context, chunks)

    def default_noise(self, context: Context) -> np.ndarray:
        """
        The noise that `predict(deterministic=True)` begins with.

        :param context: context that :meth:`encode` returned
        :return: (B, N)
        """
        return self._acting_noise(context.timesteps[:, -1] + context.episode_keys, deterministic=True).cpu().numpy()

    def apply_actions(self, context: Context, chunks: np.ndarray) -> tuple[np.ndarray, Context]:
        """
        Carry out actions that an online algorithm has chosen.

        :param context: context that :meth:`encode` returned
        :param chunks: (B, h, A) in [-1, 1], for at least the `n_action_steps` that are carried out
        :return: actions and the next `state`, as from :meth:`decode`
        :raises ValueError: they are not finite
        """
        context = self._with_chunks(context, np.ones(len(chunks), bool), chunks)
        planned = np.concatenate([context.actions[:, -1:], context.plan], axis=1)
        return self._to_environment(planned), context

    def reset(self) -> None:
        """Forget the context that `predict` remembers for a caller who passes no `state`."""
        self._remembered.forget()

    def _to_environment(self, scaled_action: np.ndarray) -> np.ndarray:
        """Bring [-1, 1] into the action space, in its own precision."""
        low, high = self.vector_space.low, self.vector_space.high
        action = unscaled(scaled_action, low, high).astype(self.vector_space.dtype)
        return from_vectors(np.clip(action, low, high), self.action_space)

    def _empty_context(self, n_rows: int) -> Context:
        sizes = (self.context_length, self.observation_dim, self.action_dim)
        return empty_context(n_rows, *sizes, plan_length=self.options.n_action_steps - 1)

    def _act(self, context: Context, deterministic: bool) -> Context:
        """
        Fill in the newest step's actions, in [-1, 1]: planned ones, and chosen ones where none are left.

        :raises ValueError: they would not be finite
        """
        self._stop_training()
        due = context.n_planned == 0
        chunks = np.zeros((0, self.options.chunk_size, self.action_dim), np.float32)
        with th.inference_mode():
            hidden, keys_values = self._hidden(context, due)
            if hidden is not None:
                chunks = self._to_chunks(self._choose(context, due, hidden, deterministic))
        return self._with_chunks(context, due, chunks)._replace(keys_values=keys_values)

    def _stop_training(self) -> None:
        if self.training:
            self.set_training_mode(False)  # goes through all modules

    def _with_chunks(self, context: Context, due: np.ndarray, chunks: np.ndarray) -> Context:
        """
        The newest step's actions, and plans for the next ones.

        :param due: (B,) bool, b rows that have new actions
        :param chunks: (b, H, A) in [-1, 1]
        :raises ValueError: they are not finite
        """
        check_chunks(context, due, chunks)
        return with_plan(context, due, chunks[:, : self.options.n_action_steps])

    @property
    def takes_best_of_n(self) -> bool:
        """Return whether the critic chooses among several samples as the policy acts now."""
        return self.options.n_action_samples > 1 and self.online_actor is None

    def _choose(self, context: Context, due: np.ndarray, hidden: th.Tensor, deterministic: bool) -> th.Tensor:
        """
        :param due: (B,) bool, rows that need new actions, b of them
        :param hidden: (b, D)
        :return: (b, H A) in [-1, 1]
        """
        rows = context.timesteps[due, -1] + context.episode_keys[due]
        if self.takes_best_of_n:
            observations = th.from_numpy(context.observations[due, -1]).to(hidden.device)
            samples, chosen = self._best_of_n(hidden, observations, rows, deterministic)
            return samples[th.arange(len(chosen), device=hidden.device), chosen]
        noise = self._acting_noise(rows, deterministic).to(hidden.device)
        newest = None
        if self.online_actor is not None:
            newest = Windows(*(th.from_numpy(each[due, -1:]).to(hidden.device) for each in context.windows))
        return choose_actions(self.acting_network, self.normalization, self.online_actor, newest, hidden, noise)

    def _best_of_n(
        self, hidden: th.Tensor, observations: th.Tensor, rows: np.ndarray, deterministic: bool
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param hidden: (b, D)
        :param observations: (b, O) as the environment gives them
        :param rows: rows (b,) of the noise table
        :return: see :meth:`Critic.best_of_n`
        """
        assert self.critic is not None
        own = self.options
        repeated = hidden.unsqueeze(1).expand(-1, own.n_action_samples, -1)
        return self.critic.best_of_n(
            self.normalization.scale_observation(observations),
            rows,
            partial(self._acting_noise, deterministic=deterministic),
            partial(self.acting_network.decode, repeated),
            own.n_action_samples,
            own.sample_noise_std,
            own.temperature,
        )

    def _hidden(self, context: Context, due: np.ndarray) -> tuple[th.Tensor | None, np.ndarray]:
        """
        :param due: (B,) bool, rows that need new actions, b of them
        :return: hidden states (b, D) of the newest steps, None where none is due; and the keys and values to keep, which
            grow with each step, due or not
        """
        caches = self.options.kv_cache and self.context_length > 1
        keys_values = np.zeros((len(due), 0), np.float32)
        if not caches and not due.any():
            return None, keys_values
        device = self.device  # SB3 looks for it among the parameters each time
        windows = Windows(*(th.from_numpy(each if caches else each[due]).to(device) for each in context.windows))
        if not caches:
            return self.acting_network.newest_hidden(self.normalization(windows)), keys_values
        network = self.acting_network
        kept = network.within_range(self.normalization(windows))._asdict()
        hidden, keys_values = extend_cache(network.trunk, kept, context.keys_values)
        return (hidden[th.from_numpy(due).to(device)] if due.any() else None), keys_values

    def _to_chunks(self, actions: th.Tensor) -> np.ndarray:
        """Bring (b, H A) to (b, H, A) on the CPU."""
        return actions.cpu().numpy().reshape(-1, self.options.chunk_size, self.action_dim)

    def _acting_noise(self, rows: np.ndarray, deterministic: bool) -> th.Tensor:
        """Return what the newest step's actions start from, (B, noise_dim): of these rows of the table, (B,), or fresh."""
        if deterministic or self.network.head.noise_dim == 0:
            return self.noise_table[th.from_numpy(rows % len(self.noise_table)).to(self.noise_table.device)]
        if self._acting_generator is None:
            self.seed_noise(self.seed)
        assert self._acting_generator is not None
        return standard_normal(len(rows), self.network.head.noise_dim, self._acting_generator)

    def seed_noise(self, seed: int | None) -> None:
        """
        Start the noise of `deterministic=False` anew.

        :param seed: seed of the noise; None draws one
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
        arrays, frames, _ = self._unpack(numbers)
        context = self._act(push(self._empty_context(len(arrays[0])), *arrays, frames=frames), deterministic)
        return th.as_tensor(self._to_environment(context.actions[:, -1]), device=self.device)

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    def acting_settings(self) -> dict[str, Any]:
        """Return how to act: what may be changed after training, and is saved with the weights."""
        return {**self.options.acting(), **self.network.head.options.acting()}

    def set_acting(self, **settings: Any) -> None:
        """
        Choose how to act; the trained weights do not depend on it.

        :param settings: new values of some of :meth:`acting_settings`
        :raises ValueError: an unknown name, or a value out of range
        """
        accepted = self.acting_settings()
        unknown = sorted(set(settings) - set(accepted))
        if unknown:
            raise ValueError(f"{with_nearest(unknown, accepted)}: no way of acting; accepted are {', '.join(accepted)}.")
        head = self.network.head
        of_the_head = {name: settings.pop(name) for name in head.options.acting() if name in settings}
        self.options, options = self.options.changed(**settings), head.options.changed(**of_the_head)
        head.options = self.acting_network.head.options = options

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


def choose_actions(
    network: SequenceNetwork,
    normalization: Normalization,
    online_actor: nn.Module | None,
    newest: Windows | None,
    hidden: th.Tensor,
    noise: th.Tensor,
) -> th.Tensor:
    """
    Map hidden states and noise to actions: what `predict` and exported files do alike.

    :param network: network that acts
    :param normalization: the policy's normalization
    :param online_actor: online actor of a fine-tuned model; None takes the noise and the actions as they are
    :param newest: (B, 1, ...), the newest steps in the environment's units, for the online actor
    :param hidden: (B, D)
    :param noise: (B, N), standard normal
    :return: (B, H A) in [-1, 1]
    """
    decode = partial(network.decode, hidden)
    if online_actor is None:
        return decode(noise)
    actions: th.Tensor = online_actor(normalization, newest, hidden, noise, decode)
    return actions


def standard_normal(n_rows: int, dim: int, generator: th.Generator) -> th.Tensor:
    return th.randn(n_rows, dim, generator=generator, device=generator.device)
