"""The regression head, and the mean that all losses are."""

import pytest
import torch as th

from sb3_dtfm.heads.base import masked_mean
from sb3_dtfm.heads.regression import RegressionHead


def test_masked_mean_divides_by_valid_steps():
    values = th.tensor([[[1.0, 3.0], [5.0, 5.0]], [[100.0, 100.0], [0.0, 2.0]]])
    mask = th.tensor([[True, True], [False, True]])
    assert masked_mean(values, mask).item() == pytest.approx((2 + 5 + 1) / 3)


def test_regression_actions_stay_within_their_bounds():
    assert RegressionHead(4, 2)(1e3 * th.randn(10, 4)).abs().max() <= 1.0
