"""The head of choices against closed forms."""

import math

import pytest
import torch as th

from sb3_dtfm.heads.categorical import CategoricalHead, gumbel

PROBABILITIES = th.tensor([0.5, 0.3, 0.15, 0.05])


def head_of(probabilities: th.Tensor) -> CategoricalHead:
    """Its choices have these probabilities, whatever the hidden state is."""
    head = CategoricalHead(3, len(probabilities)).requires_grad_(False)
    head.linear.weight.zero_()
    head.linear.bias.copy_(probabilities.log() + 7.0)
    return head


def choices(*numbers: int) -> th.Tensor:
    return 2.0 * th.eye(4)[list(numbers)] - 1.0


def test_the_loss_is_the_mean_surprise_over_valid_steps():
    actions = th.stack([choices(0, 1, 2), choices(3, 3, 0)])
    mask = th.tensor([[True, True, True], [False, True, True]])
    loss, parts = head_of(PROBABILITIES).loss(th.randn(2, 3, 3), actions, mask)
    expected = -sum(math.log(p) for p in (0.5, 0.3, 0.15, 0.05, 0.5)) / 5
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    assert parts == {"cross_entropy": loss}


def test_choices_are_drawn_as_often_as_they_are_likely():
    n = 40_000
    actions = head_of(PROBABILITIES)(th.randn(n, 3), th.randn(n, 4, generator=th.Generator().manual_seed(0)))
    assert actions.unique().tolist() == [-1.0, 1.0]
    assert (actions.sum(dim=1) == 1.0 - 3.0).all(), "one choice each"
    found = (actions > 0).float().mean(dim=0)
    th.testing.assert_close(found, PROBABILITIES, rtol=0.0, atol=4 * 0.5 / math.sqrt(n))


def test_without_noise_it_is_the_most_likely_choice():
    head, generator = head_of(PROBABILITIES), th.Generator()
    assert head(th.randn(2, 3), head.deterministic_noise(generator).expand(2, 4)).equal(choices(0, 0))
    assert head_of(PROBABILITIES.flip(0))(th.randn(1, 3), th.zeros(1, 4)).equal(choices(3))


def test_gumbel_noise_has_its_median_mean_and_no_infinity():
    assert gumbel(th.zeros(1)).item() == pytest.approx(-math.log(math.log(2.0)))
    noise = gumbel(th.randn(100_000, generator=th.Generator().manual_seed(0)))
    assert noise.mean().item() == pytest.approx(0.5772, abs=0.02)
    assert noise.std().item() == pytest.approx(math.pi / math.sqrt(6.0), abs=0.02)
    assert gumbel(th.tensor([-9.0, 9.0])).isfinite().all()


def test_what_is_not_finite_is_no_choice():
    hidden = th.randn(2, 3)
    hidden[1] = th.nan
    head = CategoricalHead(3, 4)
    assert head(hidden, th.zeros(2, 4)).isfinite().all(dim=1).tolist() == [True, False]
