"""The precision of matrix products."""

import pytest
import torch as th

from sb3_dtfm import DT, DTFM
from sb3_dtfm.optimization import choose_precision, multiplies_bfloat16, products_ms
from tests.algorithms.small import TINY_POLICY, make_model

CPU = th.device("cpu")


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_float32_is_the_default(algorithm, cheetah_buffer):
    assert algorithm("MultiInputPolicy", dataset=cheetah_buffer, policy_kwargs=TINY_POLICY).precision == "float32"


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_what_is_asked_for_is_taken_without_measuring(precision, cheetah_buffer, capsys):
    products_ms.cache_clear()
    model = make_model(DT, cheetah_buffer, precision=precision, verbose=1).learn(1, log_interval=None)
    assert model._chosen_precision() == precision
    assert products_ms.cache_info().misses == 0
    assert "Matrix products" not in capsys.readouterr().out


def test_auto_takes_what_is_faster_here_and_measures_once():
    network = th.nn.Sequential(th.nn.Linear(48, 96), th.nn.Linear(96, 48))
    products_ms.cache_clear()
    chosen, reason = choose_precision(network, 64, CPU)
    assert chosen in reason
    if not multiplies_bfloat16(CPU):
        assert (chosen, products_ms.cache_info().misses) == ("float32", 0)
        return
    shapes, n_threads = ((48, 96), (96, 48)), th.get_num_threads()
    times = {name: products_ms(name, shapes, 64, n_threads) for name in ("float32", "bfloat16")}
    assert chosen == min(times, key=times.get)
    assert choose_precision(network, 64, CPU) == (chosen, reason)
    assert products_ms.cache_info().misses == 2


def test_measuring_draws_no_random_numbers():
    products_ms.cache_clear()
    network = th.nn.Linear(16, 16)
    before = th.get_rng_state()
    choose_precision(network, 8, CPU)
    assert th.equal(th.get_rng_state(), before)


def test_a_saved_model_asks_again(cheetah_buffer, tmp_path):
    make_model(DT, cheetah_buffer, precision="auto").save(tmp_path / "model")
    assert DT.load(tmp_path / "model").precision == "auto"


def test_training_says_what_auto_took(cheetah_buffer, capsys):
    make_model(DT, cheetah_buffer, precision="auto", verbose=1).learn(1, log_interval=None)
    assert "Matrix products are in " in capsys.readouterr().out
