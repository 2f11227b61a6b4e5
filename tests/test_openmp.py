"""How torch's threads wait, which the command line decides before torch is imported, and an import leaves alone."""

import os
import subprocess
import sys

import pytest

SHOW = "print(os.environ.get('GOMP_SPINCOUNT'))"
COMMAND = "import os; from sb3_dtfm.cli.main import main; main(['inspect', 'no/such.npz']); "


def shown(program: str, told: dict[str, str]) -> str:
    """The last word that a new process prints."""
    environment = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    command = [sys.executable, "-c", program + SHOW]
    return subprocess.run(
        command, env={**environment, **told}, check=True, stdout=subprocess.PIPE, text=True
    ).stdout.split()[-1]


@pytest.mark.parametrize(
    ("told", "expected"), [({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "None")]
)
def test_threads_of_a_command_spin_for_a_moment_unless_the_user_says_how_they_wait(told, expected):
    assert shown(COMMAND, told) == expected


def test_an_import_changes_no_setting_of_the_process():
    assert shown("import os, sb3_dtfm; ", {}) == "None"
