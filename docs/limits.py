"""
Sizes that this project keeps, printed by `make lint`, which fails where one is above its limit.

A word is what has a letter or a digit between two spaces, in tables and code, too.
"""

import argparse
import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
# Files that turn recorded steps into a loss; tests/test_training_path.py watches that none is missing. Reading data and
# deciding settings come before, the optimiser and logging after.
TRAINING_PATH = (
    "algorithms/offline.py",
    "data/drawing.py",
    "windows.py",
    "policies/normalization.py",
    "policies/network.py",
    "networks/trunk.py",
    "networks/layers.py",
    "heads/base.py",
    "heads/flow.py",
    "heads/regression.py",
)
# Parts of a study.
STUDY = (r"^\*\*Question\.", r"^\*\*Setup\.", r"^\| ---", r"^!\[", "^## Finding", "^## Limits", r"\*\*Commands?\.")
# The commit after which subjects follow CONTRIBUTING.
SUBJECTS_SINCE = "3a8e903826f089cfad7d3867de6233aee4cf4262"
# Words that begin no imperative.
IMPERATIVE = "Bring|Embed|Exceed|Feed|Need|Proceed|Seed|Shed|Speed|Succeed"
NO_IMPERATIVE = re.compile(rf"(?!({IMPERATIVE})\b)(A|An|The|Of|What|Who|Where|It|Its|This|That|There|\w+ing|\w+ed)\b")


class Size(NamedTuple):
    """
    :param name: what is measured
    :param found: its size
    :param limit: the largest that is accepted
    """

    name: str
    found: float
    limit: float


def words(text: str) -> int:
    """Number of words."""
    return sum(any(letter.isalnum() for letter in word) for word in text.split())


def n_lines(path: str) -> int:
    """Lines of a file."""
    return len((ROOT / path).read_text().splitlines())


def readme_sizes(text: str) -> Iterator[Size]:
    """Lines and rows of README's sections."""
    sections = dict(part.split("\n", 1) for part in text.split("\n## ")[1:])
    code = re.compile(r"^```.*?\n(.*?)^```", re.DOTALL | re.MULTILINE)
    for name, limit in (("Install", 2), ("Quick start", 12)):
        found = code.search(sections[name])
        yield Size(
            f"lines of code in README's {name}", len([line for line in found[1].split("\n") if line]) if found else 0, limit
        )
    for name, limit in (("Which algorithm?", 5), ("Results", 8)):
        yield Size(f"rows in README's {name}", len(re.findall(r"^\|", sections[name], re.MULTILINE)) - 2, limit)
    yield Size("points of protocol and limits in README", len(re.findall(r"^- ", sections["Results"], re.MULTILINE)), 3)


def n_arguments(path: str, name: str) -> int:
    """Arguments that a class's constructor shows to its users."""
    found = (node for node in ast.walk(ast.parse((ROOT / path).read_text())) if isinstance(node, ast.ClassDef))
    (own,) = (each for node in found if node.name == name for each in node.body if getattr(each, "name", "") == "__init__")
    assert isinstance(own, ast.FunctionDef)
    return sum(not each.arg.startswith("_") and each.arg != "self" for each in own.args.args)


def subjects() -> list[str]:
    """Subjects of the commits since the rule began; none in a copy without a history."""
    command = ["git", "-C", str(ROOT), "log", "--no-merges", "--format=%s", f"{SUBJECTS_SINCE}..HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.splitlines()


def sizes() -> Iterator[Size]:
    """Everything that has a limit."""
    pages = [page for page in sorted((ROOT / "docs").rglob("*.md")) if page.name != "report.md"]  # which is built
    results = [path for path in (ROOT / "results").rglob("*") if path.is_file()]
    yield Size("lines of README", n_lines("README.md"), 120)
    yield from readme_sizes((ROOT / "README.md").read_text())
    yield Size("lines of CHANGELOG, until the first release", n_lines("CHANGELOG.md"), 60)
    yield Size("words of docs", sum(words(page.read_text()) for page in pages), 25_000)
    for page in pages:
        if page.parent.name == "studies":
            text = page.read_text()
            yield Size(f"words of studies/{page.name}", words(text), 700)
            yield Size(f"tables of studies/{page.name}", len(re.findall(r"^\| ---", text, re.MULTILINE)), 1)
            missing = [part for part in STUDY if not re.search(part, text, re.MULTILINE)]
            yield Size(f"parts that studies/{page.name} lacks {missing or ''}".rstrip(), len(missing), 0)
    yield Size("lines from recorded steps to the loss", sum(n_lines(f"sb3_dtfm/{path}") for path in TRAINING_PATH), 2000)
    yield Size("files from recorded steps to the loss", len(TRAINING_PATH), 10)
    constructor = n_arguments("sb3_dtfm/algorithms/offline.py", "OfflineAlgorithm")
    yield Size("arguments of an algorithm's constructor", constructor, 20)
    yield Size("files in results", len(results), 60)
    yield Size("MB of results", sum(path.stat().st_size for path in results) / 1e6, 3.0)
    if found := subjects():
        yield Size("characters of the longest commit subject", max(map(len, found)), 72)
        wrong = [subject for subject in found if NO_IMPERATIVE.match(subject) or subject.endswith(".")]
        yield Size(f"commit subjects that are no imperative {wrong or ''}".rstrip(), len(wrong), 0)


def main() -> None:
    """
    :raises SystemExit: with code 1 if one is above its limit
    """
    too_large = False
    for name, found, limit in sizes():
        too_large |= found > limit
        mark = "  <- too large" if found > limit else ""
        print(f"{found:8,.6g} of {limit:<8,g} {name}{mark}")
    sys.exit(too_large)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
