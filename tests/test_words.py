"""One word an idea: those that an earlier version had are gone from names, messages and pages."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Each as a whole word, whatever its case.
GONE = (
    # options and columns
    "calm_units", "return_weight", "return_steps", "timestep_exponent", "n_candidates", "candidate_noise", "n_solver_steps",
    "guided_share", "n_valued",
    # classes and functions
    "CorrectionVecEnv", "SteeredDTFM", "act_from_noise", "carry_out", "own_noise", "hand_out", "take_up", "threads_that_pay",
    "n_products", "from_first", "first_of_each_machine_first", "_memory_errors_named", "naming_the_file", "naming",
    "asking_for", "asked_for", "keep_pace", "finished_cells",
    # prose
    "guided", "steer", "steers", "steered", "steering", "gait", "gaits", "lucky", "luckiest", "peer", "peers", "in sight",
    "what is asked for", "what is seen", "likewise", "goes on online", "going on online", "small profile", "drowns",
    "return to ask for", "target's pace", "ladder",
)  # fmt: skip
WORD = re.compile(rf"(?<!\w)({'|'.join(GONE)})(?!\w)", re.IGNORECASE)


def files() -> list[Path]:
    """Code, settings and pages; results keep the names of the commits that made them."""
    command = ["git", "-C", str(ROOT), "ls-files", "*.py", "*.yml", "*.md", "*.toml", "Makefile"]
    listed = subprocess.run(command, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("Not a git checkout.")
    return [
        ROOT / name for name in listed.stdout.split() if not name.startswith("results/") and name != "tests/test_words.py"
    ]


def test_words_of_earlier_versions_are_gone():
    found = []
    for path in files():
        for number, line in enumerate(path.read_text().splitlines(), start=1):
            found += [f"{path.relative_to(ROOT)}:{number}: {word}" for word in WORD.findall(line)]
    assert found == []
    names = [str(path.relative_to(ROOT)) for path in files()]
    assert names
    assert [name for name in names if WORD.search(re.sub(r"[_/-]", " ", name))] == []


def test_a_word_is_found():
    assert WORD.findall("Peers steer n_candidates, not return_weighting or a pioneer.") == ["Peers", "steer", "n_candidates"]
