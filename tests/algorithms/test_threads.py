"""How many threads a gradient step takes."""

import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

from sb3_dtfm import DTFM
from sb3_dtfm.optimization import ONE_THREADS_MACS, limit_threads
from sb3_dtfm.zoo_configs import paper_settings


@pytest.mark.parametrize(
    ("n_macs", "environment", "expected"), [(1e9, {}, 1), (1e10, {}, 2), (1e9, {"OMP_NUM_THREADS": "2"}, 2)]
)
def test_little_work_is_done_by_one_thread_unless_the_user_says_how_many(n_macs, environment, expected, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    before = th.get_num_threads()
    th.set_num_threads(2)
    try:
        with limit_threads(n_macs):
            assert th.get_num_threads() == expected
        assert th.get_num_threads() == 2
    finally:
        th.set_num_threads(before)


def test_the_default_is_little_work_and_the_papers_settings_are_not(cheetah_buffer):
    """Multiplications of a gradient step, as torch counts half of its floating-point operations."""
    paper = {**paper_settings("dtfm"), "precision": "float32"}
    for large, settings in ((False, {"policy": "MultiInputPolicy"}), (True, paper)):
        model = DTFM(dataset=cheetah_buffer, **settings)
        assert (model._n_macs() > ONE_THREADS_MACS) == large
        model.batch_size = 8
        with FlopCounterMode(display=False) as counter:
            model.learn(1)
        assert model._n_macs() == pytest.approx(counter.get_total_flops() / 2, rel=0.25)
