"""README quotes the committed results as the report computes them."""

from collections import defaultdict
from pathlib import Path

from sb3_dtfm.benchmark import grid
from sb3_dtfm.benchmark.grid import read_tasks
from sb3_dtfm.benchmark.report.runs import read_studies
from sb3_dtfm.benchmark.report.tables import make_report
from sb3_dtfm.cli.benchmark import parse_arguments

ROOT = Path(__file__).parents[2]
# README's name of a data set of the suite, and the report's.
IN_README = {
    "Hopper, one agent *": "hopper*",
    "HalfCheetah, five agents *": "halfcheetah-mixed-quality*",
    "Walker2d, five agents": "walker2d-mixed-quality",
    "Walker2d, three noisy agents *": "walker2d-mediocre-noisy*",
    "Swimmer, one agent": "swimmer",
    "Robosuite Stack, 50 scripted demonstrations": "stack-50",
    "Robosuite Can, half of 100 dropped *": "can-dropped*",
    "Adroit door, people *": "door-human*",
}


def test_the_suite_of_data_sets_is_what_the_benchmark_reads(monkeypatch):
    monkeypatch.setattr(grid, "import_packages", lambda *_: None)  # which not everybody has
    monkeypatch.setattr(grid.gym, "spec", lambda _: None)
    tasks = read_tasks(parse_arguments(["--datasets", str(ROOT / "studies" / "suite.yml")]))
    assert len(tasks) > 30
    assert all(task.task and task.dataset for task in tasks)
    assert 0 < sum(task.chosen_with for task in tasks) < len(tasks) / 2


def test_readme_says_what_the_report_says():
    studies = read_studies([ROOT / "results" / "suite.csv"])
    report, readme = make_report(studies, defaultdict(dict)), (ROOT / "README.md").read_text().splitlines()
    for name, data_set in IN_README.items():
        (line,) = (each for each in readme if each.startswith(f"| {name} |"))
        assert f"\n{line.replace(name, data_set).removesuffix(' |')} | " in report, name
