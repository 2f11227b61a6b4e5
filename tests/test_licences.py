"""Pinned versions, and their licences in docs/licences.csv."""

import csv
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


def pins(file: str, python: str) -> dict[str, str]:
    """Versions that a file of constraints pins for this Python."""
    lines = [line for line in (ROOT / file).read_text().splitlines() if not line.startswith("#")]
    requirements = [Requirement(line) for line in lines]
    valid = [one for one in requirements if one.marker is None or one.marker.evaluate({"python_version": python})]
    found = {canonicalize_name(one.name): str(one.specifier).removeprefix("==") for one in valid}
    assert len(found) == len(valid) > 100, f"{file}: a package is pinned twice"
    return found


def test_every_pinned_version_has_its_licence_listed():
    """The list is that of Python 3.11."""
    with (ROOT / "docs/licences.csv").open(newline="") as file:
        found = {canonicalize_name(row["Name"]): row["Version"].split("+")[0] for row in csv.DictReader(file)}
    assert found == pins("constraints.txt", "3.11"), "`make licences`"


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12", "3.13"])
def test_both_sets_differ_only_for_numpy(python):
    usual, numpy2 = pins("constraints.txt", python), pins("constraints-numpy2.txt", python)
    differing = {name for name in usual | numpy2 if usual.get(name) != numpy2.get(name)}
    assert differing <= {"minari", "numpy", "pandas", "pyarrow", "scipy"}
    assert [usual["numpy"][0], numpy2["numpy"][0]] == ["2" if python == "3.13" else "1", "2"]
    assert differing or python == "3.13"
