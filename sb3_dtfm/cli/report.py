"""`sb3-dtfm report`: tables and figures from results, and results as a CSV table."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.benchmark.report.changes import split_changes
from sb3_dtfm.benchmark.report.figures import check_baselines, plot_group, plot_scores, plot_solved, read_baseline
from sb3_dtfm.benchmark.report.runs import Group, Study, read_studies
from sb3_dtfm.benchmark.report.tables import make_report
from sb3_dtfm.benchmark.results import read_results, write_results
from sb3_dtfm.benchmark.rows import plain_name

# From so many on a grid with a row of learning curves for each is too long to be drawn.
MANY_TASKS = 20


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm report`.

    :param argv: its arguments
    :raises ValueError: a malformed argument or row, or no finished run
    :raises FileNotFoundError: no such folder or file
    """
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm report",
        description="Write report.md and figures from rows of `sb3-dtfm benchmark`, or from CSV tables of them.",
        epilog="Tables in the folders that are named, and folders below these, are studies: each has its own part of the "
        "report. Results of folders and files that are named themselves are put together. Settings that a label changed are "
        "compared with runs without it, of the same study if it has some.",
    )
    parser.add_argument("results", nargs="+", help="CSV tables, files of rows, or folders of either")
    argument = parser.add_argument
    argument("-o", "--output", default="docs", metavar="DIR", help="folder of report.md and its pictures, docs by default")
    argument(
        "--env", "--tasks", dest="tasks", nargs="+", default=[], metavar="TASK", help="show these first, even if not run"
    )
    baseline = "curve of an SB3 run: its evaluations.npz"
    argument("--baseline", action="append", default=[], metavar="[TASK:]NAME=FILE", help=baseline)
    argument("--no-agent-line", action="store_true", help="do not draw what the recorded episodes reached")
    argument("--csv", metavar="FILE", help="write one table of all evaluations, a line for each, and no report")
    options = parser.parse_args(argv)
    if options.csv:
        write_csv(options.results, Path(options.csv))
        return
    studies = read_studies(options.results, options.tasks)
    if not any(study.groups for study in studies):
        raise ValueError(f"{', '.join(options.results)}: no finished run; `sb3-dtfm benchmark` writes some.")
    baselines = [read_baseline(text) for text in options.baseline]
    check_baselines(
        baselines, list(dict.fromkeys(task for study in studies for group in study.groups for task in group.tasks))
    )
    output = Path(options.output)
    agent_line = not options.no_agent_line
    figures: dict[tuple[str, str], dict[str, str]] = {}
    taken: set[str] = set()
    for study in studies:
        for group in split_changes(study, studies)[0]:
            files = {kind: output / figure_name(kind, study, group) for kind in ("scores", "curves", "minutes", "solved")}
            if files["curves"].name in taken:
                what = f"{files['curves'].name} would show two groups of {study.name}"
                raise ValueError(f"{what}: a label has its folder's name.")
            taken.add(files["curves"].name)
            drawn = {"scores": plot_scores(group, files["scores"])} if group.has_baselines else {}
            if len(group.tasks) < MANY_TASKS:
                drawn["curves"] = plot_group(group, files["curves"], "steps", baselines, agent_line)
                drawn["minutes"] = plot_group(group, files["minutes"], "minutes", agent_line=agent_line)
                drawn["solved"] = plot_solved(group, files["solved"])
            shown = {kind: file for kind, file in drawn.items() if file is not None}
            figures[study.name, group.title] = {kind: file.name for kind, file in shown.items()}
            print(*shown.values(), sep="\n")
    report = output / "report.md"
    report.write_text(make_report(studies, figures))
    print(report)


def write_csv(paths: Sequence[str], output: Path) -> None:
    """
    Write the results of one study as a table.

    :raises ValueError: there are several, or none
    """
    studies = read_results(paths)
    if len(studies) != 1:
        found = f"the studies {', '.join(sorted(studies))}" if studies else "no rows"
        raise ValueError(f"--csv {output}: {', '.join(paths)} holds {found}; name the folder of one.")
    write_results(output, *studies.values())
    print(output)


def figure_name(kind: str, study: Study, group: Group) -> str:
    """
    File name of a group's figure: "scores" beside behaviour cloning, "curves" of learning, these by "minutes", or what was
    "solved" by environment step.
    """
    return (
        plain_name("-".join(part for part in dict.fromkeys((kind, group.profile, group.label, study.name)) if part)) + ".png"
    )
