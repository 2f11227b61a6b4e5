"""The vector field's parts."""

import torch as th

from sb3_dtfm.networks.layers import VectorField, sinusoidal_embedding


def test_sinusoidal_embedding_tells_neighbouring_times_apart():
    embedding = sinusoidal_embedding(th.linspace(0, 1, 101), 64)
    assert embedding.shape == (101, 64)
    distances = th.cdist(embedding, embedding) + 1e9 * th.eye(101)
    assert distances.min() > 0.1


def test_film_halves_add_up_to_one_linear_map_of_time_and_condition():
    field = VectorField(action_dim=3, condition_dim=8, hidden_dim=16, n_layers=2)
    hidden, tau = th.randn(5, 8), th.rand(5)
    weight = th.cat((field.film_time.weight, field.film_condition.weight), dim=1)
    features = th.cat((sinusoidal_embedding(tau, field.time_embedding_dim), hidden), dim=1)
    joint = features @ weight.T + field.film_condition.bias
    x = noise = th.randn(5, 3)
    for i, layer in enumerate(field.layers):
        scale, shift = joint[:, 32 * i : 32 * i + 16], joint[:, 32 * i + 16 : 32 * i + 32]
        x = th.nn.functional.silu(layer(x) * (1 + scale) + shift)
    assert th.allclose(field(noise, field.film_condition(hidden) + field.time_share(tau)), field.output(x), atol=1e-5)
