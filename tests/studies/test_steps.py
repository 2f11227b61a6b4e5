"""The products of a gradient step, counted and timed by themselves."""

import pytest
import torch as th
from steps import STEPS, Products, make_model


def test_products_of_a_layer_are_its_own_and_two_gradients():
    layer, x = th.nn.Linear(8, 4), th.randn(16, 8, requires_grad=True)
    with Products() as products:
        layer(x).sum().backward()
    assert len(products.factors) == 3
    assert products.gflop() == pytest.approx(3 * 2 * 16 * 8 * 4 / 1e9)
    assert products.milliseconds(3) > 0


@pytest.mark.parametrize("name", [name for name, step in STEPS.items() if step.context_length == 1])
def test_a_step_has_nothing_left_to_decide(name):
    model = make_model(name)
    assert not {each.name for each in model.decisions} & set(STEPS[name][-1])
    assert model.return_weighting == 0.0
