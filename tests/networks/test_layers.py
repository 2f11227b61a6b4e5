"""CPU optimisations give the results of torch's own functions."""

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F

from sb3_dtfm.networks.layers import FEW_ROWS, LARGE_WEIGHT, Linear, dropout, dropout_add, keep_mask
from sb3_dtfm.networks.trunk import attention

WIDE = -(-LARGE_WEIGHT // 5)  # outputs that make five inputs a large weight


@pytest.mark.parametrize("probability", [0.0, 0.1, 0.5, 0.9])
def test_a_mask_has_the_asked_share_of_zeros_and_mean_one(probability):
    th.manual_seed(0)
    mask = keep_mask(th.empty(1000, 999), probability)
    n_elements = mask.numel()
    noise = 4 * (probability * (1 - probability) / n_elements) ** 0.5  # four standard deviations of the share
    assert (mask == 0).float().mean().item() == pytest.approx(probability, abs=noise + 1e-5)
    assert mask.unique().numel() == (1 if probability == 0.0 else 2)
    assert mask.double().mean().item() == pytest.approx(1.0, abs=(noise + 1e-5) / (1 - probability))


def test_neighbouring_elements_are_independent():
    th.manual_seed(0)
    mask = keep_mask(th.empty(1000, 1000), 0.5).flatten() - 1.0
    for lag in (1, 2, 3, 4, 1000):
        assert abs((mask[lag:] * mask[:-lag]).mean().item()) < 5e-3


def test_masks_follow_torchs_seed():
    th.manual_seed(3)
    first, second = (keep_mask(th.empty(7, 5), 0.5) for _ in range(2))
    th.manual_seed(3)
    assert th.equal(keep_mask(th.empty(7, 5), 0.5), first)
    assert not th.equal(first, second)


def test_dropout_scales_what_it_keeps_and_so_does_its_gradient():
    x = th.rand(50, 40).add_(1.0).requires_grad_()
    y = dropout(x, 0.25, training=True)
    y.sum().backward()
    factor = y.detach() / x.detach()
    assert th.allclose(x.grad, factor)
    assert set(factor.mul(100).round().unique().tolist()) == {0.0, 133.0}


def test_dropout_add_is_dropout_and_a_sum():
    residual, x = th.randn(6, 5), th.randn(6, 5)
    th.manual_seed(1)
    expected = residual + dropout(x, 0.3, training=True)
    th.manual_seed(1)
    assert th.allclose(dropout_add(residual, x, 0.3, training=True), expected)


@pytest.mark.parametrize(("probability", "training"), [(0.0, True), (0.5, False)])
def test_nothing_is_dropped_without_need(probability, training):
    x = th.randn(6, 5)
    assert dropout(x, probability, training) is x
    assert th.equal(dropout_add(x, x, probability, training), x + x)


def test_attention_with_dropout_is_torchs_attention_but_for_the_mask(monkeypatch):
    query, key, value = (th.randn(3, 2, 7, 4, requires_grad=True) for _ in range(3))
    bias = th.zeros(3, 1, 7, 7).masked_fill_(~th.ones(7, 7, dtype=th.bool).tril(), -th.inf).expand(-1, 2, -1, -1)
    monkeypatch.setattr("sb3_dtfm.networks.trunk.dropout", lambda x, probability, training: x)
    ours = attention(query, key, value, bias, dropout_p=0.1)
    theirs = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
    assert th.allclose(ours, theirs, atol=1e-6)
    gradients = [th.autograd.grad(y.square().sum(), (query, key, value)) for y in (ours, theirs)]
    assert all(th.allclose(a, b, atol=1e-5) for a, b in zip(*gradients, strict=True))


@pytest.mark.parametrize("shape", [(5,), (1, 5), (3, 5), (1, 3, 5), (FEW_ROWS, 5), (FEW_ROWS + 1, 5), (2, 4, 5), (0, 5)])
@pytest.mark.parametrize("bias", [True, False])
def test_few_rows_give_what_torch_gives(shape, bias):
    layer, x = Linear(5, WIDE, bias=bias), th.randn(shape)
    with th.inference_mode():
        y = layer(x)
    assert y.shape == (*shape[:-1], WIDE)
    assert th.allclose(y, F.linear(x, layer.weight, layer.bias), atol=1e-6)


@pytest.mark.parametrize(("width", "by_numpy"), [(WIDE, True), (7, False)])
def test_numpy_multiplies_large_weights_alone(width, by_numpy, monkeypatch):
    products = []
    einsum = np.einsum
    monkeypatch.setattr(np, "einsum", lambda *args, out: products.append(einsum(*args, out=out)))
    with th.inference_mode():
        Linear(5, width)(th.randn(1, 5))
    assert len(products) == by_numpy


def test_rows_that_are_not_contiguous_are_read_as_they_are():
    layer, x = Linear(5, WIDE), th.randn(5, 3).t()
    with th.inference_mode():
        assert th.allclose(layer(x), F.linear(x, layer.weight, layer.bias), atol=1e-6)


def test_gradients_and_other_precisions_take_torchs_way():
    layer, x = Linear(5, WIDE), th.randn(1, 5, requires_grad=True)
    torchs = x.detach().clone().requires_grad_()
    layer(x).sum().backward()
    F.linear(torchs, layer.weight, layer.bias).sum().backward()
    assert th.equal(x.grad, torchs.grad)
    with th.inference_mode():
        assert layer.double()(x.double()).dtype == th.float64
