"""What docs/ and README say of the committed rows is what the report makes of them."""

from pathlib import Path

import pytest

from sb3_dtfm.benchmark import grid
from sb3_dtfm.benchmark.grid import read_tasks
from sb3_dtfm.cli.benchmark import parse_arguments
from sb3_dtfm.cli.main import main

ROOT = Path(__file__).parents[2]
# Where a report lies, and of what it is; results/README.md has the commands.
STUDIES = ("time-steps", "windows/*_uniform-windows.jsonl", "paused", "mixed", "few", "noisy", "two-ways", "styles")
REPORTS = {"docs": ("suite",), "docs/studies": STUDIES}

# README's name of a data set of the suite, and the report's.
IN_README = {
    "Hopper, one agent *": "hopper*",
    "HalfCheetah, five agents *": "halfcheetah-ladder*",
    "Walker2d, five agents": "walker2d-ladder",
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


@pytest.mark.parametrize("docs", REPORTS)
def test_a_report_shows_the_committed_rows(docs, tmp_path):
    results = [str(path) for pattern in REPORTS[docs] for path in sorted((ROOT / "results").glob(pattern))]
    assert main(["report", *results, "-o", str(tmp_path)]) == 0
    assert (ROOT / docs / "report.md").read_text() == (tmp_path / "report.md").read_text()
    for figure in tmp_path.glob("*.png"):
        assert (ROOT / docs / figure.name).is_file()


def test_readme_says_what_the_report_says():
    report, readme = (ROOT / "docs" / "report.md").read_text(), (ROOT / "README.md").read_text().splitlines()
    for name, data_set in IN_README.items():
        (line,) = (each for each in readme if each.startswith(f"| {name} |"))
        assert f"\n{line.replace(name, data_set).removesuffix(' |')} | " in report, name
