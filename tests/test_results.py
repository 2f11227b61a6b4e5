"""results/ holds one small table a study, and its README says what they are; links lead somewhere."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
TABLES = sorted(RESULTS.glob("*.csv"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted(RESULTS.rglob("*.md"))]
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
BUILT = {ROOT / "docs" / "report.md"}  # by `make docs`


def linked(page: Path) -> list[Path]:
    """The files and folders that a page links, but for web addresses."""
    return [(page.parent / link).resolve() for link in LINK.findall(page.read_text()) if "://" not in link]


def test_results_are_few_files_that_are_small():
    files = [path for path in RESULTS.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".csv", ".md"}
    assert len(files) < 60
    assert sum(path.stat().st_size for path in files) < 3_000_000


def test_results_name_no_folder_of_the_machine_that_made_them():
    assert TABLES
    assert [str(path) for path in RESULTS.rglob("*.csv") if re.search(r'["\s,]/\w', path.read_text())] == []


def test_every_table_is_linked_with_what_it_holds():
    about = runpy.run_path(str(ROOT / "studies" / "summary.py"))["about"]
    readme = (RESULTS / "README.md").read_text()
    assert len(re.findall(r"\S*\w\S*", readme)) <= 900
    assert {path for path in linked(RESULTS / "README.md") if path.suffix == ".csv"} == set(RESULTS.rglob("*.csv"))
    for path in TABLES:
        study, *rest = about(path).values()
        (line,) = (each for each in readme.splitlines() if each.startswith(f"| {study} | "))
        assert f" | {' | '.join(rest)} | " in line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    assert [str(target) for target in linked(page) if not target.exists() and target not in BUILT] == []
