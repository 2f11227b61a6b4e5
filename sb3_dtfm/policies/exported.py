"""A policy as one function of tensors, which a graph can hold: the computation of `predict` from a context to actions."""

import copy
from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.networks.cache import extend
from sb3_dtfm.policies.network import SequenceNetwork
from sb3_dtfm.policies.normalization import Normalization
from sb3_dtfm.policies.sequence import SequencePolicy, choose_actions
from sb3_dtfm.windows import Windows


class ExportedPolicy(nn.Module):
    """
    The policy as it acts at present: a map from windows to actions, both in the environment's units, for any number of rows.

    The caller keeps the windows: it shifts them by a step, fills in the newest one and, when an action is carried out,
    that action. A row begins anew when its mask is cleared; what is behind the mask may be any finite number.

    Actions of a Discrete space are vectors here: 1 for the choice, 0 for the others. The newest images are inputs;
    features of earlier images are state in and state out.

    :param policy: policy to export, which stays as it is; the parts that act are copied to the CPU
    :raises ValueError: its critic would choose among several draws
    """

    noise_table: th.Tensor

    def __init__(self, policy: SequencePolicy) -> None:
        super().__init__()
        if policy.takes_best_of_n:
            raise ValueError(
                f"n_action_samples={policy.options.n_action_samples}: a choice by the critic is not exported; "
                "`n_action_samples:1` among the ways of acting exports the flow alone."
            )
        self.normalization: Normalization = copy.deepcopy(policy.normalization).cpu()
        self.network: SequenceNetwork = copy.deepcopy(policy.acting_network).cpu()
        self.online_actor = copy.deepcopy(policy.online_actor).cpu() if policy.online_actor is not None else None
        self.register_buffer("noise_table", policy.noise_table.cpu())
        self.context_length = policy.context_length
        self.keeps = policy.options.kv_cache and policy.context_length > 1
        self.settings: dict[str, Any] = {
            "context_length": policy.context_length,
            "chunk_size": policy.options.chunk_size,
            "observation_dim": policy.vector_dim,
            "images": {camera: list(space.shape) for camera, space in policy.image_spaces.items()},
            "action_dim": policy.action_dim,
            "action_low": policy.vector_space.low.tolist(),
            "action_high": policy.vector_space.high.tolist(),
            "first_action": None if isinstance(policy.action_space, spaces.Box) else int(policy.action_space.start),
            "tokens_per_step": self.network.trunk.tokens_per_step,
            "noise_dim": self.network.head.noise_dim,
            **policy.acting_settings(),
        }
        self.eval().requires_grad_(False)

    def forward(
        self,
        observations: th.Tensor,
        actions: th.Tensor,
        returns_to_go: th.Tensor,
        timesteps: th.Tensor,
        mask: th.Tensor,
        noise: th.Tensor | None = None,
        episode_keys: th.Tensor | None = None,
        keys_values: th.Tensor | None = None,
        features: th.Tensor | None = None,
        images: dict[str, th.Tensor] | None = None,
    ) -> tuple[th.Tensor, ...]:
        """
        :param observations: (B, K, O), newest step last, as the environment gives them
        :param actions: executed actions (B, K, A) in the environment's range; the last one is not read
        :param returns_to_go: (B, K), environment reward units
        :param timesteps: (B, K) int64, counted from the episode's start
        :param mask: (B, K) bool, False on padded steps
        :param noise: (B, N), standard normal; a row of zeros is replaced by the noise of `predict(deterministic=True)`.
            For a head that starts from noise
        :param episode_keys: (B,) int64, CRC-32 of the bytes of each episode's first observation, float32, and behind it
            those of its images; with `noise`
        :param keys_values: (B, layers, 2, L, D), as the last call returned them, or any finite numbers; for `kv_cache`
        :param features: (B, K, F), as the last call returned them, or any finite numbers; with images
        :param images: images of the newest step, (B, channels, height, width) uint8 by camera
        :return: chunk (B, H, A), the actions for this step and the next ones, in the action space; with `kv_cache` the
            next `keys_values`; with images the next `features`
        """
        trunk = self.network.trunk
        seen: tuple[th.Tensor, ...] = ()
        if images is not None and features is not None and self.network.encoder is not None:
            newest_features = self.network.encoder(images).unsqueeze(1)
            seen = (th.cat((features[:, 1:], newest_features), dim=1),)
            observations = th.cat((observations, *seen), dim=-1)
        given = Windows(observations, self.normalization.scale_action(actions), returns_to_go, timesteps, mask)
        normalized = self.normalization(given)
        windows = self.network.within_range(normalized)._asdict()
        kept: tuple[th.Tensor, ...] = ()
        if keys_values is None:
            hidden = trunk(**windows, last_only=True).squeeze(1)
        else:
            n_new = trunk.tokens_per_step
            hidden, filled = extend(trunk, **windows, keys_values=F.pad(keys_values, (0, 0, 0, n_new)))
            kept = (th.stack(filled, dim=1)[..., n_new:, :],)
        if noise is None or episode_keys is None:
            noise = hidden[:, :0]
        else:
            rows = (timesteps[:, -1] + episode_keys) % len(self.noise_table)
            noise = th.where(noise.any(dim=1, keepdim=True), noise, self.noise_table[rows])

        newest = Windows(*(each[:, -1:] for each in given))
        chunk = choose_actions(self.network, self.normalization, self.online_actor, newest, hidden, noise)
        chunk = chunk.unflatten(1, (-1, self.settings["action_dim"]))
        return self.normalization.unscale_action(chunk), *kept, *seen

    def example(self, n_rows: int = 2) -> dict[str, Any]:
        """
        Inputs of :meth:`forward` by name, those that this policy takes: full windows of random numbers.

        :param n_rows: number B of rows
        :raises ValueError: an image has the name of another input
        """
        shape, trunk, noise_dim = (n_rows, self.context_length), self.network.trunk, self.settings["noise_dim"]
        generator = th.Generator().manual_seed(0)

        def draw(*shape: int) -> th.Tensor:
            return th.randn(shape, generator=generator)

        mean = self.normalization.observation_mean[: self.settings["observation_dim"]]
        inputs: dict[str, Any] = {
            "observations": mean + draw(*shape, self.settings["observation_dim"]),
            "actions": self.normalization.unscale_action(draw(*shape, self.settings["action_dim"])),
            "returns_to_go": self.normalization.return_scale * draw(*shape),
            "timesteps": th.arange(self.context_length).repeat(n_rows, 1),
            "mask": th.ones(shape, dtype=th.bool),
        }
        if noise_dim:
            inputs |= {"noise": draw(n_rows, noise_dim), "episode_keys": th.arange(n_rows)}
        if self.keeps:
            n_kept = trunk.n_tokens(self.context_length) - trunk.tokens_per_step
            inputs["keys_values"] = draw(n_rows, trunk.n_layers, 2, n_kept, trunk.embed_dim)
        if self.network.encoder is not None:
            inputs["features"] = draw(*shape, self.network.encoder.features_dim)
            if taken := sorted({*inputs, *self.outputs} & set(self.settings["images"])):
                raise ValueError(
                    f"export: an image is called {', '.join(taken)}, which the file calls something else; rename it."
                )
            inputs["images"] = {
                camera: th.randint(0, 256, (n_rows, *size), dtype=th.uint8, generator=generator)
                for camera, size in self.settings["images"].items()
            }
        return inputs

    @property
    def outputs(self) -> list[str]:
        """Names of what :meth:`forward` returns."""
        kept = ["next_keys_values"] if self.keeps else []
        return ["chunk", *kept, *(["next_features"] if self.network.encoder is not None else [])]
