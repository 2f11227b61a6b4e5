"""What every policy shares: normalisation, context, acting, optimiser."""

import copy
import json
from abc import abstractmethod
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_dtfm.networks.heads import RegressionHead
from sb3_dtfm.networks.linear import threads_for
from sb3_dtfm.networks.trunk import SequenceTrunk
from sb3_dtfm.policies.kv_cache import TOKENS_PER_STEP, KeysValuesCache
from sb3_dtfm.windows import Context, Windows, empty_context, push, unpack_observation, with_action

# Observations are clipped at this many standard deviations, as SB3's VecNormalize does.
OBSERVATION_CLIP = 10.0


class SequenceNetwork(nn.Module):
    """Everything that is trained: the trunk, the action head and, if asked for, the auxiliary regression head."""

    def __init__(self, trunk: SequenceTrunk, head: nn.Module, auxiliary_head: RegressionHead | None = None) -> None:
        super().__init__()
        self.trunk = trunk
        self.head = head
        self.auxiliary_head = auxiliary_head


class SequencePolicy(BasePolicy):
    """
    A policy over the last `context_length` steps.

    :param observation_space: Dict of `observation` (O,), `return_to_go` (1,) and `timestep` (1,)
    :param action_space: bounded Box (A,)
    :param lr_schedule: learning rate over the progress remaining, from 1 to 0
    :param context_length: K, steps the policy sees
    :param max_timestep: time steps with an embedding of their own
    :param embed_dim: width of the trunk
    :param n_layers: number of Transformer blocks
    :param n_heads: attention heads
    :param dropout: dropout probability of the trunk
    :param timestep_embedding: tell the trunk the absolute time step, as Decision Transformer does
    :param weight_decay: AdamW's, on weight matrices only
    :param clip_return_to_go: keep the return-to-go within what the data showed at the same time step. Asking for more than
        any episode reached, or falling behind, then stays an input like those the policy learned from
    :param ema: keep an exponential moving average of the weights and act with it
    :param kv_cache: act on the keys and values kept of earlier steps instead of recomputing the window: two to three times
        faster, and equal until the window slides (see :meth:`SequenceTrunk.extend`); can be set at any time
    :param seed: seed of the noise that acting starts from
    """

    observation_space: spaces.Dict
    action_space: spaces.Box
    observation_mean: th.Tensor
    observation_std: th.Tensor
    return_scale: th.Tensor
    return_to_go_range: th.Tensor | None
    action_low: th.Tensor
    action_high: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        context_length: int = 20,
        max_timestep: int = 1000,
        embed_dim: int = 256,
        n_layers: int = 10,
        n_heads: int = 2,
        dropout: float = 0.1,
        timestep_embedding: bool = True,
        weight_decay: float = 1e-3,
        clip_return_to_go: bool = False,
        ema: bool = False,
        kv_cache: bool = False,
        seed: int | None = None,
    ) -> None:
        super().__init__(observation_space, action_space, normalize_images=False, optimizer_class=th.optim.AdamW)
        self.context_length = context_length
        self.max_timestep = max_timestep
        self.embed_dim = embed_dim
        self.n_layers = n_layers
        self.n_heads = n_heads
        self.dropout = dropout
        self.timestep_embedding = timestep_embedding
        self.weight_decay = weight_decay
        self.clip_return_to_go = clip_return_to_go
        self.ema = ema
        self.kv_cache = kv_cache
        self.seed = seed
        self.observation_dim = int(observation_space["observation"].shape[0])  # type: ignore[index]
        self.action_dim = int(action_space.shape[0])
        self.register_buffer("observation_mean", th.zeros(self.observation_dim))
        self.register_buffer("observation_std", th.ones(self.observation_dim))
        self.register_buffer("return_scale", th.ones(()))
        unlimited = th.tensor([[-th.inf], [th.inf]]).repeat(1, max_timestep) if clip_return_to_go else None
        self.register_buffer("return_to_go_range", unlimited)
        self.register_buffer("action_low", th.as_tensor(action_space.low), persistent=False)
        self.register_buffer("action_high", th.as_tensor(action_space.high), persistent=False)
        self._context: Context | None = None
        self._keys_values = KeysValuesCache()

        dims = (self.observation_dim, self.action_dim)
        trunk = SequenceTrunk(*dims, max_timestep, embed_dim, n_layers, n_heads, dropout, timestep_embedding)
        self.network = SequenceNetwork(trunk, self._make_head(), self._make_auxiliary_head())
        self.ema_network = copy.deepcopy(self.network).requires_grad_(False) if ema else None
        self.optimizer = self._make_optimizer(lr_schedule(1.0))

    @property
    def acting_network(self) -> SequenceNetwork:
        """The weights that choose actions: the moving average if there is one."""
        return self.network if self.ema_network is None else self.ema_network

    @abstractmethod
    def _make_head(self) -> nn.Module:
        """The action head."""

    def _make_auxiliary_head(self) -> RegressionHead | None:
        """A regression head beside the action head, if the policy has one."""
        return None

    def draw_noise(self, batch: Any, generator: th.Generator) -> tuple[th.Tensor, ...]:
        """
        What the loss draws at random, one row per window: drawn apart from it, so that the loss is a plain function.

        :param batch: a :class:`~sb3_dtfm.windows.Windows`
        :param generator: on the policy's device
        :return: further arguments of :meth:`compute_loss`, each (B, ...)
        """
        return ()

    def part_masks(self, mask: th.Tensor) -> dict[str, th.Tensor]:
        """
        Parts of the loss that are means over some of the valid steps only; each is a plain summand of the loss.

        :param mask: (B, K) bool, of a batch
        :return: the steps of such a part (B, ...) bool, by its logged name
        """
        return {}

    @abstractmethod
    def compute_loss(self, batch: Any, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: a :class:`~sb3_dtfm.windows.Windows`, actions in the environment's range
        :param noise: what :meth:`draw_noise` gave for the batch
        :return: the loss to minimise, and its parts by their logged names
        """

    @abstractmethod
    def _generate(self, hidden: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        Actions from hidden states.

        :param hidden: (B, D)
        :param noise: (B, A), standard normal
        :return: (B, A), to be clipped to [-1, 1]
        """

    def _make_optimizer(self, learning_rate: float) -> th.optim.Optimizer:
        """AdamW whose weight decay spares biases, norms and embeddings."""
        matrices = [m.weight for m in self.network.modules() if isinstance(m, nn.Linear)]
        decayed = {id(weight) for weight in matrices}
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in decayed]
        groups = [{"params": matrices, "weight_decay": self.weight_decay}, {"params": others, "weight_decay": 0.0}]
        return self.optimizer_class(groups, lr=learning_rate, fused=True)  # type: ignore[call-arg]

    def clipped_parameters(self) -> list[nn.Parameter]:
        """The parameters whose gradient norm is logged and clipped."""
        return list(self.network.parameters())

    def set_statistics(self, observation_mean: np.ndarray, observation_std: np.ndarray, return_scale: float) -> None:
        """
        Take the input normalisation from training data.

        :param observation_mean: (O,)
        :param observation_std: (O,)
        :param return_scale: largest absolute return-to-go, environment reward units
        """
        self.observation_mean.copy_(th.from_numpy(observation_mean))
        # A constant dimension becomes zero.
        self.observation_std.copy_(th.from_numpy(np.where(observation_std > 1e-6, observation_std, 1.0)))
        self.return_scale.fill_(return_scale if return_scale > 0 else 1.0)

    def set_return_to_go_range(self, limits: th.Tensor) -> None:
        """
        :param limits: (2, max_timestep), smallest and largest return-to-go by time step, environment reward units
        """
        assert self.return_to_go_range is not None
        self.return_to_go_range.copy_(limits)

    def scale_action(self, action: Any) -> Any:
        """From the environment's range to [-1, 1]; accepts tensors (..., A) and, as SB3 does, arrays."""
        if isinstance(action, np.ndarray):
            return super().scale_action(action)
        return 2.0 * (action - self.action_low) / (self.action_high - self.action_low) - 1.0

    def hidden_states(self, network: SequenceNetwork, windows: Windows, last_only: bool = False) -> th.Tensor:
        """
        Run the trunk on windows in environment units.

        :return: (B, K, D), or (B, 1, D) of the newest steps with `last_only`
        """
        return network.trunk(*self._normalized(windows), last_only)

    def _normalized(self, windows: Windows) -> Windows:
        observations = (windows.observations - self.observation_mean) / self.observation_std
        returns_to_go = windows.returns_to_go
        if self.return_to_go_range is not None:
            low, high = self.return_to_go_range[:, windows.timesteps.clamp(max=self.max_timestep - 1)]
            returns_to_go = returns_to_go.clamp(low, high)
        return windows._replace(
            observations=observations.clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP),
            returns_to_go=returns_to_go / self.return_scale,
        )

    def scaled_windows(self, batch: Any) -> Windows:
        """The windows of a :class:`~sb3_dtfm.windows.Windows`, with actions in [-1, 1]."""
        return batch._replace(actions=self.scale_action(batch.actions))

    def action_mse(self, batch: Any, generator: th.Generator) -> th.Tensor:
        """
        Mean squared error, in units of [-1, 1], of the acting policy's actions at each window's last step.

        The same measure for every head: what `predict` would do on recorded windows against what was recorded.

        :param batch: a :class:`~sb3_dtfm.windows.Windows`
        :param generator: source of the noise that actions start from
        """
        self.set_training_mode(False)
        with th.no_grad():
            windows = self.scaled_windows(batch)
            hidden = self.hidden_states(self.acting_network, windows, last_only=True).squeeze(1)
            actions = self._generate(hidden, standard_normal(len(hidden), self.action_dim, generator)).clamp(-1.0, 1.0)
            return (actions - windows.actions[:, -1]).square().mean()

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

        With `state` given this is a pure function. Without it the policy keeps the context itself, so that
        `action, _ = model.predict(obs)` in a loop is enough: a row starts anew whenever its time step is not the last
        one plus one.

        :param observation: Dict of `observation` (O,), `return_to_go` (1,), `timestep` (1,), or with a leading axis B
        :param state: what the last call returned
        :param episode_start: (B,) bool, True where an environment was just reset
        :param deterministic: repeat exactly for the same model, state and inputs; otherwise draw fresh noise
        :return: actions (A,) or (B, A) in the environment's range, and the next state
        :raises ValueError: not the observation of a `ReturnToGoWrapper`, or a state of another number of environments
        """
        arrays, vectorized = unpack_observation(observation, self.observation_dim)
        n_rows = len(arrays[0])
        if state is not None:
            context = Context(*state)
            if len(context.mask) != n_rows:
                raise ValueError(f"state belongs to {len(context.mask)} environments, the observation to {n_rows}.")
        elif self._context is not None and len(self._context.mask) == n_rows:
            context = self._context
        else:
            context = empty_context(n_rows, self.context_length, self.observation_dim, self.action_dim)
        context = push(context, *arrays, episode_start=episode_start)
        scaled_action, keys_values = self._act(context, deterministic)
        context = with_action(context, scaled_action)._replace(keys_values=keys_values)
        if state is None:
            self._context = context
        action = np.clip(self.unscale_action(scaled_action), self.action_space.low, self.action_space.high)
        return action if vectorized else action.squeeze(axis=0), tuple(context)

    def _act(self, context: Context, deterministic: bool) -> tuple[np.ndarray, np.ndarray]:
        """The newest step's actions, (B, A) in [-1, 1], and the keys and values to keep."""
        if self.training:
            self.set_training_mode(False)  # goes through all modules
        device = self.device  # SB3 looks for it among the parameters each time
        with th.inference_mode():
            windows = Windows(*(th.from_numpy(array).to(device) for array in context.windows))
            if self.kv_cache and self.context_length > 1:
                hidden, keys_values = self._extend(self._normalized(windows), context.keys_values)
            else:
                hidden = self.hidden_states(self.acting_network, windows, last_only=True).squeeze(1)
                keys_values = np.zeros((len(hidden), 0), np.float32)
            noise = self._acting_noise(
                windows.timesteps[:, -1], th.from_numpy(context.episode_keys).to(device), deterministic
            )
            with threads_for(len(hidden)):
                actions = self._generate(hidden, noise).clamp(-1.0, 1.0)
            return actions.cpu().numpy(), keys_values

    def _extend(self, windows: Windows, kept: np.ndarray) -> tuple[th.Tensor, np.ndarray]:
        """
        The newest hidden states from what was kept, and what to keep for the next step.

        :param windows: normalised
        :param kept: (B, layers, 2, 3 (K - 1), D), or (B, 0) if the last steps were acted without a cache
        :return: (B, D) hidden states, and the new `kept`
        """
        shape = (len(windows.mask), self.n_layers, 2, TOKENS_PER_STEP * (self.context_length - 1), self.embed_dim)
        n_missing = 0
        if kept.shape != shape:
            kept = np.zeros(shape, np.float32)
            n_missing = int(windows.mask.sum(dim=1).max()) - 1
        with threads_for(TOKENS_PER_STEP * len(kept)):
            for n_back in range(n_missing, -1, -1):
                earlier = Windows(*(x.roll(n_back, dims=1) for x in windows)) if n_back else windows
                earlier.mask[:, :n_back] = False  # the newest steps went round to the left
                keys_values = self._keys_values.with_next_step(kept, earlier.mask.device)
                hidden = self.acting_network.trunk.extend(*earlier, keys_values=keys_values)
                kept = self._keys_values.keep(keys_values)
        return hidden, kept

    def _acting_noise(self, timestep: th.Tensor, episode_key: th.Tensor, deterministic: bool) -> th.Tensor:
        """
        What acting starts from; a policy that needs no noise leaves this as it is.

        :param timestep: (B,)
        :param episode_key: (B,) int64, a number that belongs to the episode
        """
        return th.zeros(len(timestep), self.action_dim, device=self.device)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Actions (B, A) in the environment's range for single steps without a past."""
        assert isinstance(observation, dict)
        numbers = {key: value.cpu().numpy() for key, value in observation.items()}
        arrays, _ = unpack_observation(numbers, self.observation_dim)
        context = empty_context(len(arrays[0]), self.context_length, self.observation_dim, self.action_dim)
        scaled_action, _ = self._act(push(context, *arrays), deterministic)
        action = self.unscale_action(scaled_action)
        return th.as_tensor(action, device=self.device)

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic)

    def _acting_settings(self) -> dict[str, Any]:
        """How to act: attributes that may change after training."""
        return {"kv_cache": self.kv_cache}

    def get_extra_state(self) -> th.Tensor:
        """The settings of acting as JSON, to be saved with the weights; in a tensor, as all of a state dict is."""
        return th.tensor(list(json.dumps(self._acting_settings()).encode()), dtype=th.uint8)

    def set_extra_state(self, state: th.Tensor) -> None:
        settings = json.loads(bytes(state.tolist()))
        for name in self._acting_settings().keys() & settings:  # a file of an earlier version may lack some
            setattr(self, name, settings[name])

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = (
            "context_length",
            "max_timestep",
            "embed_dim",
            "n_layers",
            "n_heads",
            "dropout",
            "timestep_embedding",
            "weight_decay",
            "clip_return_to_go",
            "ema",
            "kv_cache",
            "seed",
        )
        return dict(
            observation_space=self.observation_space,
            action_space=self.action_space,
            lr_schedule=self._dummy_schedule,  # not needed to act
            **{name: getattr(self, name) for name in names},
        )


def standard_normal(n_rows: int, dim: int, generator: th.Generator) -> th.Tensor:
    return th.randn(n_rows, dim, generator=generator, device=generator.device)
