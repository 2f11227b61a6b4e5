"""docs/compatibility.md: a row for each thing, and tests that exist for each row."""

import ast
import inspect
import re
from pathlib import Path

import rl_zoo3
from stable_baselines3.common import callbacks, vec_env

ROOT = Path(__file__).parents[1]
ROWS = re.findall(r"^\| (?!---)(?!.* test \|$).*", (ROOT / "docs" / "compatibility.md").read_text(), re.MULTILINE)
# Parts of SB3's vectorised environments.
PARTS = {"VecEnv", "VecEnvWrapper", "CloudpickleWrapper", "StackedObservations", "StackedDictObservations"}
OUTPUTS = {"stdout", "log", "csv", "json", "tensorboard"}


def test_every_row_names_tests_that_exist():
    for row in ROWS:
        named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", row)
        assert named, row
        for file, test in named:
            assert test in [getattr(node, "name", None) for node in ast.parse((ROOT / file).read_text()).body], (
                f"{file}::{test}"
            )


def test_there_is_a_row_for_each_callback_wrapper_output_and_script():
    things = {
        name for name, thing in inspect.getmembers(callbacks, inspect.isclass) if thing.__module__ == callbacks.__name__
    }
    things |= {name for name in vec_env.__all__ if inspect.isclass(getattr(vec_env, name))} - PARTS
    modules = Path(rl_zoo3.__file__).parent.rglob("*.py")
    things |= {path.stem for path in modules if "__main__" in path.read_text()} - {"cli"} | OUTPUTS
    assert {"EvalCallback", "VecNormalize", "record_video"} <= things
    shown = set(re.findall(r"\w+", " ".join(text for row in ROWS for text in re.findall(r"`([^`]+)`", row))))
    assert things - shown == set()
