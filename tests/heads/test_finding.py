"""A file among the heads is found, and makes an algorithm."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_dtfm
from sb3_dtfm import envs

NEW_HEAD = """
from sb3_dtfm.heads.{module} import {base}

class NewHead({base}):
    algorithm = "DTX"
"""


@pytest.mark.parametrize(("module", "base"), [("base", "ActionHead"), ("flow", "FlowHead")])
def test_a_new_file_among_the_heads_is_an_algorithm(module, base, tmp_path):
    """In a copy of the package: a head of its own, and one that is made of another head."""
    package = tmp_path / "sb3_dtfm"
    shutil.copytree(Path(sb3_dtfm.__file__).parent, package)
    shutil.copytree(Path(envs.__file__).parent, package / "envs", dirs_exist_ok=True)
    (package / "heads" / "new.py").write_text(NEW_HEAD.format(module=module, base=base))
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from sb3_dtfm.algorithms import ALGORITHMS; print(*ALGORITHMS)"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert process.stdout.split() == ["dt", "dtfm", "dtx"], process.stderr
