"""A policy as one function of tensors, which a graph can hold: what `predict` does between the context and the action."""

import copy

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.policies.sequence import SequencePolicy
from sb3_dtfm.windows import Windows


class ExportedPolicy(nn.Module):
    """
    The policy as it acts at present, for any number of environments, all in the environment's units.

    Who calls it keeps the windows, shifts them with each step, and begins a row anew by clearing its mask.

    :param policy: stays as it is; its weights are copied to the CPU
    """

    noise_table: th.Tensor

    def __init__(self, policy: SequencePolicy) -> None:
        super().__init__()
        self.context_length = policy.context_length
        self.sizes = (policy.observation_dim, policy.action_dim, policy.chunk_size)
        self.keeps = policy.kv_cache and policy.context_length > 1
        parts = (policy.normalization, policy.acting_network)
        self.normalization, self.network = (copy.deepcopy(part).cpu() for part in parts)
        self.register_buffer("noise_table", policy.noise_table.cpu())
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
    ) -> tuple[th.Tensor, ...]:
        trunk, head = self.network.trunk, self.network.head
        windows = self.normalization(Windows(observations, actions, returns_to_go, timesteps, mask))
        windows = windows._replace(actions=self.normalization.scale_action(actions))
        kept = ()
        if keys_values is None:
            hidden = trunk(**windows._asdict(), last_only=True).squeeze(1)
        else:
            memory = F.pad(keys_values, (0, 0, 0, trunk.tokens_per_step))
            hidden, filled = trunk.extend(**windows._asdict(), keys_values=memory)
            kept = (th.stack(filled, dim=1)[..., trunk.tokens_per_step :, :],)
        if noise is not None:
            rows = (timesteps[:, -1] + episode_keys) % len(self.noise_table)
            noise = th.where(noise.any(dim=1, keepdim=True), noise, self.noise_table[rows])
        chunk = head(hidden, noise).clamp(-1.0, 1.0).unflatten(1, (-1, self.sizes[1]))
        return self.normalization.unscale_action(chunk), *kept

    def example(self, B=2):
        K=self.context_length; O,A,H=self.sizes; t=self.network.trunk
        d=dict(observations=th.zeros(B,K,O), actions=th.zeros(B,K,A), returns_to_go=th.zeros(B,K), timesteps=th.zeros(B,K,dtype=th.long), mask=th.zeros(B,K,dtype=th.bool))
        if self.network.head.noise_dim:
            d.update(noise=th.zeros(B,self.network.head.noise_dim), episode_keys=th.zeros(B,dtype=th.long))
        if self.keeps:
            d.update(keys_values=th.zeros(B,t.n_layers,2,t.n_tokens(K)-t.tokens_per_step,t.embed_dim))
        return d
