"""
A study's table as a picture: a line for each row, dots for the numbers of a column, bars for their intervals.

    python studies/dots.py docs/studies/adroit.md recorded DT DTFM --label "episodes solved, of 100"
    python studies/dots.py docs/studies/expected-returns.md recorded expected 0.95 --label "mean return"
    python studies/dots.py docs/studies/ogbench.md mean published --label "success on average of five tasks, %"
    python studies/dots.py docs/studies/pusht.md solved --label "episodes solved, %"

Columns are named by how their titles begin. The picture is written beside the page, under its name. Its comment
holds the cells that it shows, which a test compares with the page.
"""

import argparse
import json
import re
from pathlib import Path
from typing import NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

NUMBER = r"(?<![\d.,])-?\d[\d,]*(?:\.\d+)?"
# Digits that are no value.
REMARKS = re.compile(r"\(.*?\)|\bseeds? \d+(?:, \d+)*(?: and \d+)?")


class Cell(NamedTuple):
    """
    :param values: numbers of a cell
    :param interval: lowest and highest of the first one's, where there is an interval
    """

    values: list[float]
    interval: tuple[float, float] | None


def read_cell(text: str) -> Cell:
    """Numbers of a cell, such as `4, 5, 6`, `39 to 47` or `51 [30, 72]`."""
    outside, _, inside = REMARKS.sub("", text).partition("[")
    numbers = [[float(each.replace(",", "")) for each in re.findall(rf"{NUMBER}(?=\D|$)", part)] for part in
               (re.sub(r"(\d), (?=-?\d)", r"\1; ", part) for part in (outside, inside))]  # fmt: skip
    return Cell(numbers[0], (numbers[1][0], numbers[1][1]) if inside else None)


def read_table(page: Path) -> list[list[str]]:
    """Cells of a page's first table, without markup; its titles are the first row."""
    lines = next(part for part in page.read_text().split("\n\n") if part.startswith("| ")).splitlines()
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)|[`*]", r"\1", line) for line in lines if not line.startswith("| ---"))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in plain]


def shown(page: Path, columns: list[str]) -> list[list[str]]:
    """
    Cells of the first and of the chosen columns, without the lines that have no number there.

    :param page: of the table
    :param columns: how their titles begin
    :return: the titles, then the lines
    """
    titles, *rows = read_table(page)
    places = [[i for i, title in enumerate(titles) if title.startswith(name)] for name in columns]
    chosen = [min(found, key=lambda i: len(titles[i])) for found in places]
    rows = [cells for cells in rows if any(read_cell(cells[column]).values for column in chosen)]
    return [[cells[column] for column in (0, *chosen)] for cells in (titles, *rows)]


def draw(page: Path, columns: list[str], label: str) -> Path:
    """
    :param page: of the table
    :param columns: how their titles begin
    :param label: of the axis
    :return: the PNG
    """
    titles, *rows = cells = shown(page, columns)
    figure = Figure(figsize=(8.0, 0.32 * len(rows) + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for number, title in enumerate(titles[1:]):
        axes.plot([], [], "o", color=f"C{number}", label=title)
        for row, (_, *texts) in enumerate(rows):
            y = row + 0.5 * ((number + 0.5) / len(texts) - 0.5)
            values, interval = read_cell(texts[number])
            axes.plot(values, [y] * len(values), "o", color=f"C{number}", markersize=4.5, fillstyle="none")
            if interval:
                axes.plot(interval, [y, y], color=f"C{number}", linewidth=1.2)
    axes.set_yticks(range(len(rows)), [name.removeprefix("... ") for name, *_ in rows])
    axes.set(xlabel=label, xlim=(min(0.0, axes.get_xlim()[0]), None), ylim=(len(rows) - 0.5, -0.5))
    axes.grid(axis="y", alpha=0.3)
    if len(columns) > 1:
        figure.legend(loc="outside upper center", ncols=len(columns), frameon=False)
    output = page.with_suffix(".png")
    figure.savefig(output, dpi=100, metadata={"Comment": json.dumps(cells)})
    return output


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("columns", nargs="+")
    parser.add_argument("--label", required=True, help="of the axis")
    options = parser.parse_args()
    print(draw(options.page, options.columns, options.label))


if __name__ == "__main__":
    main()
