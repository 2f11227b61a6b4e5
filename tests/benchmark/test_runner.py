"""The progress bar of a grid."""

import io

import pytest

from sb3_dtfm.benchmark import runner


def test_a_bar_shows_an_evaluation_whose_gradient_steps_stand_still(monkeypatch: pytest.MonkeyPatch):
    screen = io.StringIO()
    monkeypatch.setattr("sys.stderr", screen)
    screen.isatty = lambda: True
    with runner._bar("run", 100) as bar:
        bar.update(100)
        for number in range(3):
            bar.last_print_t -= 1.0  # a second goes by
            bar.set_postfix_str(f"final evaluation {number}/3", refresh=False)
            bar.update(0)
    assert all(f"final evaluation {number}/3" in screen.getvalue() for number in range(3))
