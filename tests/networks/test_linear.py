"""The linear layer's way for few rows against torch's own."""

import pytest
import torch as th
from torch.nn import functional as F

from sb3_dtfm.networks.linear import FEW_ROWS, Linear, threads_for


@pytest.mark.parametrize("shape", [(5,), (1, 5), (3, 5), (1, 3, 5), (FEW_ROWS, 5), (FEW_ROWS + 1, 5), (2, 4, 5), (0, 5)])
@pytest.mark.parametrize("bias", [True, False])
def test_few_rows_give_what_torch_gives(shape, bias):
    layer, x = Linear(5, 7, bias=bias), th.randn(shape)
    with th.inference_mode():
        y = layer(x)
    assert y.shape == (*shape[:-1], 7)
    assert th.allclose(y, F.linear(x, layer.weight, layer.bias), atol=1e-6)


def test_rows_that_are_not_contiguous_are_read_as_they_are():
    layer, x = Linear(5, 7), th.randn(5, 3).t()
    with th.inference_mode():
        assert th.allclose(layer(x), F.linear(x, layer.weight, layer.bias), atol=1e-6)


def test_gradients_and_other_precisions_take_torchs_way():
    layer, x = Linear(5, 7), th.randn(1, 5, requires_grad=True)
    layer(x).sum().backward()
    assert th.allclose(x.grad, layer.weight.sum(dim=0).unsqueeze(0), atol=1e-6)
    with th.inference_mode():
        assert layer.double()(x.double()).dtype == th.float64


def test_threads_are_given_back():
    th.set_num_threads(2)
    for n_rows, expected in ((1, 1), (FEW_ROWS + 1, 2)):
        with threads_for(n_rows):
            assert th.get_num_threads() == expected
        assert th.get_num_threads() == 2
    with pytest.raises(RuntimeError), threads_for(1):
        raise RuntimeError
    assert th.get_num_threads() == 2
