"""`sb3-dtfm report`: tables and figures from rows of results."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.benchmark.changes import split_changes
from sb3_dtfm.benchmark.plots import check_baselines, plot_group, plot_solved, read_baseline
from sb3_dtfm.benchmark.rows import merge_rows, result_files
from sb3_dtfm.benchmark.runs import Group, group_runs
from sb3_dtfm.benchmark.tables import make_report
from sb3_dtfm.zoo.arguments import UsageError


def figure_name(kind: str, group: Group) -> str:
    """File name of a group's figure: of its learning "curves", or of what was "solved" by environment step."""
    name = "-".join(part for part in (kind, group.profile, group.label) if part)
    return "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name) + ".png"


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm report`.

    :param argv: its arguments
    """
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm report",
        description="Write report.md and a figure for each profile from rows of `sb3-dtfm benchmark`.",
    )
    parser.add_argument("results", nargs="+", help="folders or files of rows; several are merged")
    parser.add_argument(
        "-o", "--output", default="docs", metavar="DIR", help="where report.md and the PNGs go; docs by default"
    )
    parser.add_argument(
        "--env", "--tasks", dest="tasks", nargs="+", default=[], metavar="TASK", help="show these first, even if not run"
    )
    parser.add_argument(
        "--baseline",
        action="append",
        default=[],
        metavar="[TASK:]NAME=FILE",
        help="curve of an SB3 run: its evaluations.npz",
    )
    parser.add_argument("--no-agent-line", action="store_true", help="do not draw the return of the recorded episodes")
    options = parser.parse_args(argv)
    rows = merge_rows(result_files(options.results))
    groups, unfinished = group_runs(rows, options.tasks)
    if not groups:
        raise UsageError(f"{', '.join(options.results)}: no finished cell; `sb3-dtfm benchmark` writes some.")
    baselines = [read_baseline(text) for text in options.baseline]
    check_baselines(baselines, list(dict.fromkeys(task for group in groups for task in group.tasks)))
    output = Path(options.output)
    figures = {}
    for group in split_changes(groups)[0]:
        drawn = [
            plot_group(group, output / figure_name("curves", group), baselines, not options.no_agent_line),
            plot_solved(group, output / figure_name("solved", group)),
        ]
        figures[group.title] = [file.name for file in drawn if file is not None]
        print(*(file for file in drawn if file is not None), sep="\n")
    report = output / "report.md"
    report.write_text(make_report(groups, figures, unfinished))
    print(report)
