"""Rows as `sb3-dtfm benchmark` writes them."""

from typing import Any

import pytest

from sb3_dtfm.benchmark.rows import Row


def make_row(**changes: Any) -> Row:
    """A row of a final evaluation of four episodes."""
    row: Row = {
        "task": "robosuite/Lift-v0",
        "data_share": 1.0,
        "algo": "dtfm",
        "seed": 0,
        "profile": "small",
        "label": "",
        "step": 10,
        "final": True,
        "returns": [1.0, 1.0, 0.0, 1.0],
        "lengths": [40, 41, 400, 44],
        "successes": [True, True, False, True],
        "flow_solver": "euler",
        "flow_steps": 10,
        "wall_s": 120.0,
        "steps_per_s": 12.5,
        "commit": "0123456789abcdef",
        "versions": {"torch": "2.13.0"},
        "hardware": {"cpu": "a CPU", "cores": 2, "threads": 1, "gpu": None},
        "settings": {},
        "data": {
            "dataset": "lift.hdf5",
            "recorded_from": "a script",
            "n_episodes": 200,
            "n_steps": 9000,
            "mean_return": 1.0,
        },
    }
    return {**row, **changes}


@pytest.fixture
def row() -> Row:
    """One row."""
    return make_row()
