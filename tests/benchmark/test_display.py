"""What a grid shows while it runs."""

import pytest

from sb3_dtfm.benchmark import display
from sb3_dtfm.benchmark.display import Clock, PlainDisplay, RichDisplay, duration, make_display
from sb3_dtfm.benchmark.rows import Cell

CELL = Cell("robosuite/Lift-v0", 0.5, "dtfm", 1, "small", "ema")


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59, "59 s"), (61, "1 min"), (3600, "1 h 0 min"), (7500, "2 h 5 min")]
)
def test_durations_are_readable(seconds, text):
    assert duration(seconds) == text


def test_time_to_go_follows_from_the_pace_so_far(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: now[0])
    clock = Clock(400)
    assert clock.remaining(0) == "time to go not known yet"
    now[0] += 600.0
    assert clock.remaining(100) == "about 30 min to go"
    assert clock.remaining(400) == "finishing"


def test_plain_lines_come_once_a_minute(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: now[0])
    with make_display(3) as shown:
        assert isinstance(shown, PlainDisplay)
        for now[0] in range(0, 150, 10):
            shown.update(1, "about 5 min to go", {CELL: (1200, 1500, "training")})
    line = f"{CELL}: step 1,200 of 1,500, training; 1 of 3 cells, about 5 min to go\n"
    assert capsys.readouterr().out == 2 * line


def test_bars_name_the_cell_and_how_far_it_is(capsys):
    with RichDisplay(3) as shown:
        shown.update(1, "about 5 min to go", {CELL: (1200, 1500, "training")})
        shown.say("a line that stays")
    text = capsys.readouterr().out
    for part in ("a line that stays", "robosuite/Lift-v0 50% dtfm seed 1 ema", "1200/1500", "1/3", "about 5 min to go"):
        assert part in text
    with RichDisplay(1) as shown:
        shown.update(0, "", {CELL: (1, 2, "training")})
        shown.update(1, "", {})
    assert "seed 1" not in capsys.readouterr().out
