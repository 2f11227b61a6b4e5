"""A picture shows the numbers of a page's table."""

import json
import shlex
from pathlib import Path

import dots
import pytest
from matplotlib.axes import Axes
from PIL import Image

PAGE = """# A study

Text.

| data | recorded, % | DTFM, more | DT | [DTFM](x.md) |
| --- | --- | --- | --- | --- |
| `door` | 96 | 1 | 5,100, 99, -2 | 0.5 [0.25, 1] |
| ... nothing | | 2 | - | |
| half | | 3 | 39 to 47 | 4 * |

| another | table |
| --- | --- |
| 1 | 2 |
"""


@pytest.mark.parametrize(
    ("text", "values", "interval"),
    [
        ("4, 5, 6", [4, 5, 6], None),
        ("5,100, 99, -2", [5100, 99, -2], None),
        ("1,322 [1,083, 1,562]", [1322], (1083, 1562)),
        ("0.941 [0.929, 0.953]", [0.941], (0.929, 0.953)),
        ("96; 95; 79", [96, 95, 79], None),
        ("70 *", [70], None),
        ("4 (1 seed)", [4], None),
        ("70 %, seed 1", [70], None),
        ("3-5", [3, 5], None),
        ("", [], None),
        ("-", [], None),
    ],
)
def test_numbers_of_a_cell(text, values, interval):
    assert dots.read_cell(text) == (values, interval)


def test_a_picture_has_a_dot_for_each_number_of_the_columns_and_no_line_without_any(tmp_path, monkeypatch):
    drawn, ticks = [], []
    plot, set_yticks = Axes.plot, Axes.set_yticks
    monkeypatch.setattr(Axes, "plot", lambda self, x, y, *a, **k: drawn.append(list(x)) or plot(self, x, y, *a, **k))
    monkeypatch.setattr(Axes, "set_yticks", lambda self, at, names: ticks.extend(names) or set_yticks(self, at, names))
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    assert dots.draw(page, ["DT", "DTFM"], "solved") == tmp_path / "page.png"
    assert (tmp_path / "page.png").stat().st_size > 5_000
    assert ticks == ["door", "half"]
    assert [x for x in drawn if x] == [[5100, 99, -2], [39, 47], [0.5], [0.25, 1], [4]]


@pytest.mark.parametrize("name", ["adroit", "expected-returns", "ogbench", "pusht"])
def test_a_picture_shows_its_pages_table(name):
    """Drawn by the command that stands at the top of the script."""
    page = Path(__file__).parents[2] / "docs" / "studies" / f"{name}.md"
    assert f"({name}.png)" in page.read_text()
    (command,) = (line for line in dots.__doc__.splitlines() if page.name in line)
    columns = shlex.split(command)[3 : -len(["--label", "text"])]
    cells = dots.shown(page, columns)
    assert len(cells) > 5
    with Image.open(page.with_suffix(".png")) as picture:
        assert json.loads(picture.text["Comment"]) == cells, command
