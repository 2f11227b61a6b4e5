"""What docs/ and README say of the committed rows is what the report makes of them."""

from pathlib import Path

from sb3_dtfm.cli.main import main

ROOT = Path(__file__).parents[2]


def tables(text: str) -> list[str]:
    return [block for block in text.split("\n\n") if block.startswith("| ")]


def test_the_report_and_the_readme_show_the_committed_rows(tmp_path):
    assert main(["report", str(ROOT / "results" / "small"), "-o", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert (ROOT / "docs" / "report.md").read_text() == text
    assert tables(text)[0] in tables((ROOT / "README.md").read_text())
    for figure in tmp_path.glob("*.png"):
        assert (ROOT / "docs" / figure.name).is_file()
