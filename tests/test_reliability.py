"""The counts of docs/reliability.md are those of its tests."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.data import test_cache, test_corpus, test_robomimic
from tests.files import test_kills, test_model
from tests.policies import test_long_runs, test_threads
from tests.zoo import test_mistakes, test_planted_code, test_resuming

PAGE = (Path(__file__).parents[1] / "docs" / "reliability.md").read_text()
# Kinds of the corpus of a row.
READERS = {
    "Minari": ("hdf5", "arrow", "parquet"),
    "robomimic": ("robomimic",),
    "`.npz`": ("npz",),
    "D4RL": ("flat",),
    "LeRobot": ("lerobot",),
    "zarr": ("zarr",),
    "CSV": ("csv",),
    "Parquet": ("table",),
}


def n_cases(*tests: Callable[..., None]) -> int:
    """How often tests run, by their `parametrize`."""
    return sum(
        math.prod(len(mark.args[1]) for mark in getattr(test, "pytestmark", []) if mark.name == "parametrize")
        for test in tests
    )


PLANTED = sum(len(test_planted_code.yaml_for(command)) for command in test_planted_code.COMMANDS) + n_cases(
    test_planted_code.test_what_started_a_run_runs_nothing_when_it_goes_on,
    test_planted_code.test_pickled_statistics_beside_a_model_of_ours_are_not_loaded,
)
HIDDEN = n_cases(test_model.test_a_pickle_hidden_in_a_file_of_ours_is_not_opened)
N_CONFIGURATIONS = len(test_model.BAD_CONFIGURATIONS) + len(test_model.BAD_TENSORS) + len(test_model.BAD_STATES)
N_MISTAKES = n_cases(
    test_mistakes.test_a_mistake_of_train_is_one_line,
    test_mistakes.test_a_mistake_of_params_is_one_line,
    test_mistakes.test_a_mistake_of_a_conf_file_is_one_line,
    test_mistakes.test_a_mistake_of_enjoy_is_one_line,
)
N_MASKS = n_cases(test_robomimic.test_a_bad_mask_is_refused_as_a_bad_array_is)
KILLED_REBUILD = test_cache.test_a_build_that_is_killed_anywhere_leaves_nothing_that_disturbs_the_next_one
CALLS = {way: f"{n_calls:,}" for way, (_, n_calls) in test_long_runs.WAYS.items()}


@pytest.mark.parametrize(
    "count",
    [
        f"| none of {len(test_model.PICKLED) + HIDDEN} places runs; pickles are refused by name |",
        f"| none of {len(test_corpus.MISSING_SPACES)} runs | `tests/data/test_corpus.py`",
        f"| none of {PLANTED} runs | `tests/zoo/test_planted_code.py`",
        f"| {test_cache.N_FLIPPED} of {test_cache.N_FLIPPED} refused or rebuilt | `tests/data/test_cache.py` |",
        f"| {N_CONFIGURATIONS} of {N_CONFIGURATIONS} refused within a second |",
        f"| {len(test_resuming.DAMAGES)} of {len(test_resuming.DAMAGES)} refused | `tests/zoo/test_resuming.py` |",
        f"| {test_kills.N_KILLS} of {test_kills.N_KILLS} leave files that load",
        f"| 0 of {test_kills.N_KILLS} leave a partial dataset |",
        f"| built again, also at {n_cases(KILLED_REBUILD)} points of a rebuild |",
        f"| {N_MASKS} of {N_MASKS} refused | `tests/data/test_robomimic.py` |",
        f"| {N_MISTAKES} of {N_MISTAKES} are one line | `tests/zoo/test_mistakes.py` |",
        f"| {test_threads.N_THREADS} threads, each with own state |",
        f"| a million calls of `predict`, {CALLS['chunks']} with chunks, {CALLS['kept keys']} with `kv_cache` |",
    ],
)
def test_a_count_of_the_page_is_the_tests(count: str):
    assert count in PAGE


def test_the_page_counts_the_corpus():
    """A row for each kind: how many are refused, and how many are read."""
    read_of = {
        title: [isinstance(case.expected, str) for case in test_corpus.CASES if case.good in kinds]
        for title, kinds in READERS.items()
    }
    assert sum(map(len, read_of.values())) == len(test_corpus.CASES)
    rows = [f"| {title} | {len(read) - sum(read)} | {sum(read)} |" for title, read in read_of.items()]
    assert "\n".join(["| dataset | refused | read |", "| --- | --- | --- |", *rows]) in PAGE, rows
