"""How torch's threads wait, which `import sb3_dtfm` decides before torch is imported."""

import os
import subprocess
import sys

import pytest

SHOW = "import sb3_dtfm, os; print(os.environ.get('GOMP_SPINCOUNT'))"


@pytest.mark.parametrize(
    ("told", "expected"), [({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "None")]
)
def test_threads_spin_for_a_moment_unless_the_user_says_how_they_wait(told, expected):
    environment = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    output = subprocess.run(
        [sys.executable, "-c", SHOW], env={**environment, **told}, check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    assert output.split()[-1] == expected
