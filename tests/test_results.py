"""What results/ and docs/ say of the rows is what the rows say, and a reader who follows the links finds all of them."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
STUDIES = sorted(folder.name for folder in (ROOT / "results").iterdir() if folder.is_dir())
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "results").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")


def linked(page: Path) -> list[Path]:
    """The files and folders that a page links, but for web addresses."""
    return [(page.parent / link).resolve() for link in LINK.findall(page.read_text()) if "://" not in link]


def test_rows_lie_in_the_folder_of_a_study():
    assert not list((ROOT / "results").glob("*.jsonl"))
    assert all(list((ROOT / "results" / study).glob("*.jsonl")) for study in STUDIES)


def test_rows_name_no_folder_of_the_machine_that_made_them():
    rows = [*(ROOT / "results").rglob("*.jsonl"), *(ROOT / "results").rglob("*.json")]
    assert rows
    assert [str(path) for path in rows if '"/' in path.read_text()] == []


@pytest.mark.parametrize("study", STUDIES)
def test_a_study_shows_its_rows_and_the_commits_that_made_them(study):
    folder = ROOT / "results" / study
    table = runpy.run_path(str(ROOT / "studies" / "summary.py"))["table"](folder)
    assert "| commits |" in table
    assert table in (folder / "README.md").read_text()


def test_every_study_is_linked_from_the_ablations():
    found = set(linked(ROOT / "docs" / "ablations.md"))
    assert {ROOT / "results" / study for study in STUDIES} <= found
    assert set((ROOT / "docs" / "studies").glob("*.md")) <= found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    assert [str(target) for target in linked(page) if not target.exists()] == []
