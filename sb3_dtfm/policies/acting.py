"""Acting with the context of the last steps: everything between an observation and an action."""

from functools import partial
from typing import Any, NoReturn

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_dtfm.actions import ActionSpace, from_vectors
from sb3_dtfm.policies.context import (
    Context,
    check_context,
    check_episode_start,
    empty_context,
    push,
    restarts,
    unpack_observation,
    with_plan,
)
from sb3_dtfm.policies.critic import Critic
from sb3_dtfm.policies.memory import RememberedContext
from sb3_dtfm.policies.network import SequenceNetwork
from sb3_dtfm.policies.normalization import Normalization
from sb3_dtfm.policies.online_actor import OnlineActor, actor_observation, make_online_actor
from sb3_dtfm.windows import Windows

# How far apart in the noise table the candidates' rows lie, and those that chance chooses by: no divisors of its length.
CANDIDATE_STRIDE, CHOICE_STRIDE, CHOICE_START = 97, 31, 513


class ActingPolicy(BasePolicy):
    """
    A policy as it acts, with networks and options that :class:`~sb3_dtfm.policies.sequence.SequencePolicy` gives it.

    :param args: of Stable-Baselines3's `BasePolicy`
    :param kwargs: of the same
    """

    observation_space: spaces.Dict
    action_space: ActionSpace
    vector_space: spaces.Box
    observation_dim: int
    action_dim: int
    context_length: int
    chunk_size: int
    n_action_steps: int
    n_action_samples: int
    sample_noise_std: float
    critic_horizon: int
    temperature: float
    kv_cache: bool
    seed: int | None
    normalization: Normalization
    network: SequenceNetwork
    ema_network: SequenceNetwork | None
    critic: Critic | None
    noise_table: th.Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.online_actor: OnlineActor | None = None
        self._acting_generator: th.Generator | None = None
        self._remembered = RememberedContext()

    @property
    def acting_network(self) -> SequenceNetwork:
        """The weights that choose actions: the moving average if there is one."""
        return self.network if self.ema_network is None else self.ema_network

    def hidden_states(self, network: SequenceNetwork, windows: Windows, last_only: bool = False) -> th.Tensor:
        """
        Run the trunk on windows in environment units, actions in [-1, 1].

        :return: (B, K, D), or (B, 1, D) of the newest steps with `last_only`
        """
        return network.trunk(**network.within_range(self.normalization(windows))._asdict(), last_only=last_only)

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
            episode_start = check_episode_start(episode_start, n_rows)
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
        return action if vectorized else action.squeeze(axis=0), context

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

        :param observation: as for :meth:`predict`
        :param state: what :meth:`decode` or :meth:`predict` returned; None for no past
        :param episode_start: (B,) bool, True where an environment was just reset
        :return: the context with the newest step, and the trunk's hidden states (B, D)
        :raises ValueError: as :meth:`predict`
        """
        arrays, _ = unpack_observation(observation, self.observation_dim)
        n_rows = len(arrays[0])
        if episode_start is not None:
            episode_start = check_episode_start(episode_start, n_rows)
        context = push(self._known(state, n_rows), *arrays, episode_start=episode_start)
        self._stop_training()
        with th.inference_mode():
            hidden, keys_values = self._hidden(context, np.ones(n_rows, bool))
        assert hidden is not None
        return context._replace(keys_values=keys_values), hidden

    def decode(self, context: Context, hidden: th.Tensor, noise: np.ndarray) -> tuple[np.ndarray, Context]:
        """
        The second half: what this noise leads to. Whatever was planned before is dropped.

        :param context: what :meth:`encode` returned, with `hidden`
        :param hidden: (B, D)
        :param noise: (B, N), for the head's `noise_dim`
        :return: actions of this step and of those planned, (B, n_action_steps, A) in the environment's range, and the next
            `state`; until it is `encode`'s turn again, `predict` gives the planned ones
        :raises ValueError: noise that leads to no finite action
        """
        with th.inference_mode():
            chunks = self._to_chunks(self._decode(hidden, th.as_tensor(noise, dtype=th.float32, device=hidden.device)))
        return self.apply_actions(context, chunks)

    def default_noise(self, context: Context) -> np.ndarray:
        """
        The noise that `predict(deterministic=True)` begins with.

        :param context: what :meth:`encode` returned
        :return: (B, N)
        """
        return self._acting_noise(context.timesteps[:, -1] + context.episode_keys, deterministic=True).cpu().numpy()

    def apply_actions(self, context: Context, chunks: np.ndarray) -> tuple[np.ndarray, Context]:
        """
        What comes of actions that somebody else has chosen.

        :param context: what :meth:`encode` returned
        :param chunks: (B, h, A) in [-1, 1], for at least the `n_action_steps` that are carried out
        :return: as :meth:`decode`
        :raises ValueError: they are not finite
        """
        context = self._carry_out(context, np.ones(len(chunks), bool), chunks)
        planned = np.concatenate([context.actions[:, -1:], context.plan], axis=1)
        return self._to_environment(planned), context

    def actor_observation(
        self, windows: Windows, hidden: th.Tensor | None, rows: np.ndarray | slice = slice(None)
    ) -> th.Tensor:
        """
        The observation of an online actor, see :func:`~sb3_dtfm.policies.online_actor.actor_observation`.

        :param windows: arrays (B, K, ...) in the environment's units; the newest step is read
        :param hidden: (b, D), None to leave it out
        :param rows: b of the B rows; all by default
        :return: (b, F)
        """
        newest = Windows(*(th.from_numpy(each[rows, -1:]).to(self.device) for each in windows))
        return actor_observation(self.normalization, newest, hidden)

    def check_noise_actions(self) -> int:
        """
        :return: N, numbers of the noise that somebody else may choose
        :raises ValueError: there is no flow
        """
        head = self.network.head
        if not head.noise_dim or not isinstance(self.action_space, spaces.Box):
            name = type(self).__name__.removesuffix("Policy")
            raise ValueError(f"{name} of {self.action_space} has no flow whose noise could be chosen; a DTFM is needed.")
        return head.noise_dim

    def check_residual_actions(self, n_action_steps: int) -> None:
        """
        :param n_action_steps: of each plan
        :raises ValueError: there is no flow, or it executes several actions of a chunk
        """
        self.check_noise_actions()
        if n_action_steps > 1:
            raise ValueError(
                f"n_action_steps={n_action_steps}: residual actions are added to single actions; "
                "model.policy.set_acting(n_action_steps=1) carries out one of each plan."
            )

    def set_online_actor(self, settings: dict[str, Any] | None) -> None:
        """
        Let a network choose the noise, or add a residual action, from now on; its weights are for the caller to load.

        :param settings: of :class:`~sb3_dtfm.policies.online_actor.OnlineActor`; None draws noise again
        :raises ValueError: the head starts from no noise, or a setting out of range
        """
        if settings is None:
            self.online_actor = None
            return
        sizes = (self.observation_dim, self.network.trunk.embed_dim, self.check_noise_actions(), self.action_dim)
        self.online_actor = make_online_actor(*sizes, settings).to(self.device).requires_grad_(False)

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
        if self.n_action_samples > 1 and self.online_actor is None:
            observations = th.from_numpy(context.observations[due, -1]).to(hidden.device)
            candidates, chosen = self._draw_candidates(hidden, observations, rows, deterministic)
            return self._to_chunks(candidates[th.arange(len(chosen), device=hidden.device), chosen]), keys_values
        noise = self._acting_noise(rows, deterministic).to(hidden.device)
        if self.online_actor is None:
            return self._to_chunks(self._decode(hidden, noise)), keys_values
        shown = self.actor_observation(context.windows, hidden if self.online_actor.hidden_state else None, due)
        return self._to_chunks(self.online_actor.act(shown, noise, partial(self._decode, hidden))), keys_values

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
        hidden, keys_values = self.acting_network.extend(self.normalization(windows), context.keys_values)
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
        :param rows: (b,) of the noise table; the first candidate's are these, and what it would be without others
        :return: (b, N, H A) in [-1, 1], and (b,) int64
        """
        assert self.critic is not None
        n, turns = self.n_action_samples, np.arange(self.n_action_samples)
        noise = self._acting_noise((rows[:, None] + CANDIDATE_STRIDE * turns).ravel(), deterministic).to(hidden.device)
        noise = noise.view(len(hidden), n, -1)
        noise[:, 1:] *= self.sample_noise_std
        candidates = self._decode(hidden.repeat_interleave(n, dim=0), noise.flatten(0, 1)).view(len(hidden), n, -1)
        chance = self._acting_noise((rows[:, None] + CHOICE_START + CHOICE_STRIDE * turns).ravel(), deterministic)
        uniform = th.special.ndtr(chance[:, 0]).clamp(1e-6, 1 - 1e-6).view(len(hidden), n).to(hidden.device)
        seen = self.normalization.scale_observation(observations)
        gains = self.critic.gains(seen, candidates[..., : self.critic_horizon * self.action_dim])
        return candidates, self.critic.choose(gains, self.temperature, uniform)

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


def standard_normal(n_rows: int, dim: int, generator: th.Generator) -> th.Tensor:
    return th.randn(n_rows, dim, generator=generator, device=generator.device)
