"""Published files: their contents, and that the wheel works by itself, away from the sources."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

from sb3_dtfm import __version__
from tests.recorded import DATASET_ID, tiny_training

ROOT = Path(__file__).parents[2]
CONFIGS = {f"sb3_dtfm/zoo_configs/{name}" for name in ("dtfm.yml", "dt.yml", "paper/dtfm.yml", "paper/dt.yml")}


def run(*command: str, **kwargs) -> str:
    result = subprocess.run(command, capture_output=True, text=True, check=False, **kwargs)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Source distribution, and the wheel built from it; from a copy, where no earlier build can add files."""
    source, output = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("sb3_dtfm", "envs", "zoo_configs", "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in filter(Path.is_file, ROOT.iterdir()):
        shutil.copy(path, source)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(output), str(source))
    return output


@pytest.fixture(scope="module")
def wheel(built) -> Path:
    return next(built.glob("*.whl"))


def test_the_source_distribution_holds_what_a_wheel_needs_and_no_tests(built):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert names >= {"pyproject.toml", "README.md", "LICENSE", "CITATION.cff", "envs/__init__.py", "zoo_configs/dt.yml"}
    assert not [name for name in names if name.startswith(("tests", "results", "docs"))]


def test_the_version_is_the_one_of_the_package(built):
    assert {path.name.split("-")[1].removesuffix(".tar.gz") for path in built.iterdir()} == {__version__}
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__


def test_the_wheel_holds_the_package_and_its_settings_only(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.split("/")[0].split("-")[0] for name in names} == {"sb3_dtfm"}
    assert names >= CONFIGS | {"sb3_dtfm/py.typed", "sb3_dtfm/__main__.py"}
    sources = {path.relative_to(ROOT / "sb3_dtfm") for path in (ROOT / "sb3_dtfm").rglob("*.py")}
    sources |= {Path("envs") / path.relative_to(ROOT / "envs") for path in (ROOT / "envs").rglob("*.py")}
    assert {f"sb3_dtfm/{path.as_posix()}" for path in sources} <= names


def test_train_and_enjoy_from_the_wheel_outside_of_the_sources(wheel, workplace):
    site = workplace / "site"
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(site), str(wheel))
    environment = {**os.environ, "PYTHONPATH": str(site)}
    location = "import sb3_dtfm.envs, sb3_dtfm.zoo_configs as c; print(sb3_dtfm.envs.__file__, c.__file__)"
    found = run(sys.executable, "-c", location, cwd=workplace, env=environment).split()
    assert all(path.startswith(str(site)) for path in found), found

    command = [sys.executable, str(site / "bin" / "sb3-dtfm")]
    training = tiny_training("dtfm", "--dataset", DATASET_ID, "--eval-freq", "-1")
    assert "Saving to logs/dtfm" in run(*command, *training, cwd=workplace, env=environment)
    enjoy = ["enjoy", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--no-render", "-n", "40"]
    assert "2 Episodes" in run(sys.executable, "-m", "sb3_dtfm", *enjoy, cwd=workplace, env=environment)
