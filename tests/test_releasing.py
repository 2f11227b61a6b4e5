"""Pages for PyPI: README's links and pictures lead to the repository, which the project's metadata name."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_dtfm import __version__

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "docs" / "addresses.py"
ADDRESS = "https://github.com/somebody/sb3_dtfm"
TARGET = re.compile(r"(!?)\[[^\]]*\]\(([^)]+)\)")


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("build") / "release"
    runpy.run_path(str(SCRIPT))["copy_with_address"](ADDRESS + "/", folder)
    return folder


def test_every_link_of_readme_leads_to_a_file_of_the_repository(released):
    here = TARGET.findall((ROOT / "README.md").read_text())
    there = TARGET.findall((released / "README.md").read_text())
    assert len(here) == len(there) > 30
    for (image, target), (_, absolute) in zip(here, there, strict=True):
        if "://" in target:
            assert absolute == target
        else:
            assert absolute == f"{ADDRESS}/{'raw' if image else 'blob'}/v{__version__}/{target}"


def test_metadata_have_the_projects_urls(released):
    tomllib = pytest.importorskip("tomllib", reason="Python 3.11 reads TOML")
    project = tomllib.loads((released / "pyproject.toml").read_text())["project"]
    assert project["urls"]["Source"] == ADDRESS
    assert set(project["urls"]) == {"Source", "Documentation", "Changelog", "Issues"}
    assert f'repository-code: "{ADDRESS}"' in (released / "CITATION.cff").read_text().splitlines()
    assert (released / "sb3_dtfm" / "py.typed").is_file()


def test_metadata_name_the_pythons_of_the_pages():
    tomllib = pytest.importorskip("tomllib", reason="Python 3.11 reads TOML")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == ">=3.10", "no cap that no dependency needs"
    minors = re.findall(r"Python :: 3\.(\d+)", "\n".join(project["classifiers"]))
    assert list(map(int, minors)) == list(range(10, int(minors[-1]) + 1))
    for page in ("README.md", "docs/howto/install.md", "CHANGELOG.md"):
        assert f"Python 3.10 to 3.{minors[-1]}" in (ROOT / page).read_text(), page
    extras = project["optional-dependencies"]
    assert "gymnasium[classic-control]" in extras["classic-control"][0], "which brings pygame"
    assert set(re.findall(r"[\w-]+", extras["all"][0].split("[")[1])) == set(extras) - {"all", "dev"}


@pytest.mark.parametrize("address", ["OWNER/sb3_dtfm", "http://github.com/OWNER/sb3_dtfm", "https://github.com"])
def test_another_address_is_refused_before_anything_is_written(tmp_path, address):
    command = [sys.executable, str(SCRIPT), address, str(tmp_path / "release")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"The address is {address!r}; accepted is" in done.stderr
    assert not (tmp_path / "release").exists()
