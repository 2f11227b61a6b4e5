"""The causal Transformer over returns-to-go, observations and actions that `DT` and `DTFM` share."""

from collections.abc import Sequence

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.networks.layers import Linear, ReturnFilm, dropout, dropout_add, embedding, normal_

ALL = slice(None)


class TransformerBlock(nn.Module):
    """Pre-norm block: causal self-attention, then a four times wider GELU MLP, each on a residual path."""

    def __init__(self, embed_dim: int, n_heads: int, dropout: float) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.dropout = dropout
        self.attention_norm = nn.LayerNorm(embed_dim)
        self.attention_in = Linear(embed_dim, 3 * embed_dim)
        self.attention_out = Linear(embed_dim, embed_dim)
        self.mlp_norm = nn.LayerNorm(embed_dim)
        self.mlp_in = Linear(embed_dim, 4 * embed_dim)
        self.mlp_out = Linear(4 * embed_dim, embed_dim)

    def forward(self, tokens: th.Tensor, attention_bias: th.Tensor | None, queries: slice = ALL) -> th.Tensor:
        """
        :param tokens: (B, L, D)
        :param attention_bias: (B, heads, L, L), 0 where the query (third axis) may see the key (fourth), else -inf; None for
            a single token, which attends to itself alone
        :param queries: the Q tokens to compute; nothing is spent on the others beyond their keys and values
        :return: (B, Q, D)
        """
        normed, width = self.attention_norm(tokens), tokens.shape[-1]
        weight, bias = self.attention_in.weight, self.attention_in.bias
        if attention_bias is None:
            return self.finish(tokens, self._drop_heads(F.linear(normed, weight[2 * width :], bias[2 * width :])))
        if queries == ALL:
            query, key, value = self.attention_in(normed).split(width, dim=-1)
        else:
            query = F.linear(normed[:, queries], weight[:width], bias[:width])
            key, value = F.linear(normed, weight[width:], bias[width:]).split(width, dim=-1)
        return self.finish(tokens[:, queries], self.attend(query, key, value, attention_bias[:, :, queries]))

    def attend(self, query: th.Tensor, key: th.Tensor, value: th.Tensor, attention_bias: th.Tensor) -> th.Tensor:
        """Attend from queries, (B, Q, D), to all keys and values, (B, L, D): (B, Q, D)."""
        dropout_p = self.dropout if self.training else 0.0
        query, key, value = (x.unflatten(-1, (self.n_heads, -1)).transpose(1, 2) for x in (query, key, value))
        return attention(query, key, value, attention_bias, dropout_p).transpose(1, 2).flatten(start_dim=2)

    def _drop_heads(self, value: th.Tensor) -> th.Tensor:
        """Drop whole heads of a single token's values, (B, 1, D): dropout of attention weights that are all 1."""
        if not self.training or self.dropout == 0.0:
            return value
        weights = dropout(value.new_ones(len(value), 1, self.n_heads, 1), self.dropout, self.training)
        return (weights * value.unflatten(-1, (self.n_heads, -1))).flatten(start_dim=2)

    def finish(self, tokens: th.Tensor, attended: th.Tensor) -> th.Tensor:
        """Add tokens and what they attended to, (B, Q, D) each, on a residual path; then the MLP on another."""
        tokens = dropout_add(tokens, self.attention_out(attended), self.dropout, self.training)
        mapped = self.mlp_out(F.gelu(self.mlp_in(self.mlp_norm(tokens))))
        return dropout_add(tokens, mapped, self.dropout, self.training)


def attention(query: th.Tensor, key: th.Tensor, value: th.Tensor, bias: th.Tensor, dropout_p: float) -> th.Tensor:
    """
    Scaled dot-product attention (Vaswani et al., 2017): torch's own, but for dropout on a CPU, where its masks are slow.

    :param query: (B, heads, Q, d)
    :param key: (B, heads, L, d)
    :param value: (B, heads, L, d)
    :param bias: (B, heads, Q, L), added to the scores
    :param dropout_p: dropout probability of the attention weights
    :return: (B, heads, Q, d)
    """
    if dropout_p == 0.0 or query.device.type != "cpu":
        return F.scaled_dot_product_attention(query, key, value, attn_mask=bias, dropout_p=dropout_p)
    shape = query.shape
    query, key, value, bias = (x.flatten(end_dim=1) for x in (query, key, value, bias))
    scores = th.baddbmm(bias, query, key.transpose(1, 2), alpha=query.shape[-1] ** -0.5)
    weights = dropout(scores.softmax(dim=-1), dropout_p, training=True)
    return th.bmm(weights, value).view(shape)


class SequenceTrunk(nn.Module):
    """
    Transformer of DT and DTFM (Chen et al., 2021): a window of steps in, one hidden state per step out, for a head.

    Return-to-go, observation and action are embedded by a linear map each, plus a learned embedding of the absolute time
    step. They make three tokens, or one, the sum of a step's return-to-go, its observation and the action before it: a
    third of the products, a ninth of the attention. The hidden state of step t is read at its observation's token: it has
    seen return-to-go and observation of t and everything before them, and not the action of t.

    The action before the oldest step of a window is left out: no token of three, no summand of one.

    Without `timestep_embedding` the order of tokens shows in the causal mask alone (Kazemnejad et al., 2023), and nothing
    is learned that holds for one time step only.

    :param observation_dim: O
    :param action_dim: A
    :param max_timestep: number of embedded time steps; later ones share the last embedding
    :param embed_dim: width D
    :param n_layers: number of blocks
    :param n_heads: number of attention heads, a divisor of `embed_dim`
    :param dropout: dropout probability of embeddings, attention weights and residual branches
    :param timestep_embedding: whether the embeddings of time steps are added
    :param tokens_per_step: number of tokens of a step, 3 or 1
    :param film_return_to_go: whether the return-to-go of their step scales and shifts the tokens before each block, so that
        observations do not outweigh the target return
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        max_timestep: int,
        embed_dim: int = 256,
        n_layers: int = 10,
        n_heads: int = 2,
        dropout: float = 0.1,
        timestep_embedding: bool = True,
        tokens_per_step: int = 3,
        film_return_to_go: bool = False,
    ) -> None:
        super().__init__()
        if embed_dim % n_heads:
            raise ValueError(f"embed_dim must be a multiple of n_heads, got embed_dim={embed_dim} and n_heads={n_heads}.")
        self.embed_dim = embed_dim
        self.n_layers = n_layers
        self.n_heads = n_heads
        self.tokens_per_step = tokens_per_step
        self.observation_tokens = ALL if tokens_per_step == 1 else slice(1, None, tokens_per_step)
        self.embed_return_to_go = Linear(1, embed_dim)
        self.embed_observation = Linear(observation_dim, embed_dim)
        self.embed_action = Linear(action_dim, embed_dim)
        self.embed_timestep = embedding(max_timestep, embed_dim) if timestep_embedding else None
        self.dropout = dropout
        self.blocks = nn.ModuleList(TransformerBlock(embed_dim, n_heads, dropout) for _ in range(n_layers))
        self.final_norm = nn.LayerNorm(embed_dim)
        self.apply(self._initialize)
        self.film = ReturnFilm(embed_dim, n_layers) if film_return_to_go else None  # it has its own initial weights

    def _initialize(self, module: nn.Module) -> None:
        """GPT-2's initialisation: normal weights of 0.02, and smaller where residual branches add up."""
        if isinstance(module, (nn.Linear, nn.Embedding)):
            normal_(module.weight, std=0.02)
        if isinstance(module, nn.Linear):
            nn.init.zeros_(module.bias)
        if isinstance(module, TransformerBlock):
            for branch_end in (module.attention_out, module.mlp_out):
                normal_(branch_end.weight, std=0.02 / (2 * self.n_layers) ** 0.5)

    def forward(
        self,
        observations: th.Tensor,
        actions: th.Tensor,
        returns_to_go: th.Tensor,
        timesteps: th.Tensor,
        mask: th.Tensor,
        last_only: bool = False,
    ) -> th.Tensor:
        """
        :param observations: (B, K, O), normalised
        :param actions: (B, K, A) in [-1, 1]; the last step's action is not read
        :param returns_to_go: (B, K), scaled
        :param timesteps: (B, K) int64
        :param mask: (B, K) bool, False on padded steps
        :param last_only: whether the newest step's hidden state alone is computed
        :return: (B, K, D) hidden states, (B, 1, D) with `last_only`
        """
        tokens = self.embed(observations, actions, returns_to_go, timesteps, mask)
        tokens = dropout(tokens, self.dropout, self.training)
        attention_bias = None if tokens.shape[1] == 1 else self.attention_bias(mask, tokens.shape[1])
        films = self.films(returns_to_go)
        *lower_blocks, last_block = self.blocks
        for block, film in zip(lower_blocks, films, strict=False):
            tokens = block(scale_and_shift(tokens, film), attention_bias)
        tokens = scale_and_shift(tokens, films[-1])
        return self.final_norm(last_block(tokens, attention_bias, slice(-1, None) if last_only else self.observation_tokens))

    def n_tokens(self, context_length: int) -> int:
        """Tokens of a window of K steps; of three a step the last action's is left out, since nothing attends to it."""
        return context_length if self.tokens_per_step == 1 else self.tokens_per_step * context_length - 1

    def embed(
        self,
        observations: th.Tensor,
        actions: th.Tensor,
        returns_to_go: th.Tensor,
        timesteps: th.Tensor,
        mask: th.Tensor,
    ) -> th.Tensor:
        """Embed a window: (B, L, D) in the order of time, the newest observation's token last."""
        time = self._time(timesteps)
        return_to_go = self.embed_return_to_go(returns_to_go.unsqueeze(-1)) + time
        observation = self.embed_observation(observations)
        if self.tokens_per_step == 1:
            # Padding is no action of zeros: it adds nothing at all.
            known = self.embed_action(actions[:, :-1]) * mask[:, :-1].unsqueeze(-1)
            return return_to_go + observation + th.cat((th.zeros_like(observation[:, :1]), known), dim=1)
        action = self.embed_action(actions)
        return th.stack((return_to_go, observation + time, action + time), dim=2).flatten(1, 2)[:, :-1]

    def films(self, returns_to_go: th.Tensor) -> Sequence[th.Tensor | None]:
        """Map returns-to-go (B, N) to scales and shifts (B, L, 2 D) of each block's tokens, None where there are none."""
        if self.film is None:
            return [None] * self.n_layers
        films = self.film(returns_to_go)
        if self.tokens_per_step > 1:
            films = films.repeat_interleave(self.tokens_per_step, dim=1)[:, :-1]
        return films.chunk(self.n_layers, dim=-1)

    def _time(self, timesteps: th.Tensor) -> th.Tensor:
        """Return what is added to the tokens of steps (B, N): embeddings (B, N, D), or zeros (B, N, 1) without any."""
        if self.embed_timestep is None:
            return th.zeros_like(timesteps, dtype=self.final_norm.weight.dtype).unsqueeze(-1)
        return self.embed_timestep(timesteps.clamp(max=self.embed_timestep.num_embeddings - 1))

    def attention_bias(self, mask: th.Tensor, n_tokens: int) -> th.Tensor:
        """Map the steps' mask, (B, K), to what is added to the scores of their first tokens, (B, heads, L, L)."""
        allowed = causal_mask(mask.repeat_interleave(self.tokens_per_step, dim=1)[:, :n_tokens])
        bias = th.zeros_like(allowed, dtype=self.final_norm.weight.dtype).masked_fill_(~allowed, -th.inf)
        return bias.expand(-1, self.n_heads, -1, -1)


def scale_and_shift(tokens: th.Tensor, film: th.Tensor | None) -> th.Tensor:
    """
    FiLM (Perez et al., 2018).

    :param tokens: (B, L, D)
    :param film: (B, L, 2 D), scales less one and shifts; None changes nothing
    :return: (B, L, D)
    """
    if film is None:
        return tokens
    scale, shift = film.chunk(2, dim=-1)
    return th.addcmul(shift, tokens, 1.0 + scale)


def causal_mask(valid: th.Tensor) -> th.Tensor:
    """
    Return which tokens each token may attend to: itself, and the valid ones before it.

    :param valid: (B, L) bool
    :return: (B, 1, L, L) bool
    """
    length = valid.shape[1]
    causal = th.ones(length, length, dtype=th.bool, device=valid.device).tril()
    itself = th.eye(length, dtype=th.bool, device=valid.device)  # a padded token sees itself: no row is empty, none is NaN
    return ((causal & valid.unsqueeze(1)) | itself).unsqueeze(1)
