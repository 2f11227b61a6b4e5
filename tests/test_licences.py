"""What is pinned, and what docs/licences.md says of it."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def versions(pattern: str, file: str) -> set[tuple[str, str]]:
    found = re.findall(pattern, (ROOT / file).read_text(), re.MULTILINE)
    return {(re.sub(r"[-_.]+", "-", name).lower(), version) for name, version in found}


def test_every_pinned_version_has_its_licence_listed():
    """Of Python 3.11 and newer."""
    pinned = versions(r'^([\w.-]+)==([^;\s]+)(?!.*< "3.11")', "constraints.txt")
    listed = versions(r"^\| ([\w.-]+) +\| (\d[^ |+]*)", "docs/licences.md")
    assert pinned
    assert pinned == listed, "`make licences` writes the table"
