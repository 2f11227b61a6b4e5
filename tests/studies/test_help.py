"""Each script of the studies and docs tells how it is used, and does nothing else then."""

import os
import runpy
import sys
from pathlib import Path
from unittest import mock

import pytest

ROOT = Path(__file__).parents[2]
# Run by other scripts, in environments of their own.
WORKERS = {"worker.py", "d3rlpy_worker.py", "worker_d3rlpy.py", "worker_robomimic.py", "process.py", "protocol.py"}
SCRIPTS = [
    path.relative_to(ROOT)
    for folder in ("docs", "examples", "studies")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if '__name__ == "__main__"' in path.read_text() and path.name not in WORKERS
]


@pytest.mark.parametrize("script", [*map(str, SCRIPTS), "studies/baselines/__main__.py"])
def test_help_says_what_a_script_is_for(script, monkeypatch, capsys):
    path = ROOT / script
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    monkeypatch.setattr(sys, "path", [str(path.parent), *sys.path])
    with mock.patch.dict(os.environ), pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    assert not ended.value.code
    shown = capsys.readouterr().out
    assert "usage:" in shown
    assert len(shown.splitlines()) > 5
