"""Rows: there and back, and refused with file and line."""

import json

import pytest

from sb3_dtfm.benchmark.rows import KEYS, RowError, RunKey, read_rows, write_row
from tests.benchmark.conftest import make_row


def test_a_row_comes_back_as_it_was_written(tmp_path, row):
    other = make_row(seed=1, successes=None, flow_solver=None, flow_steps=None, commit=None)
    timed = make_row(seed=2, action_ms=1.5, task="lift-10", env_id="robosuite/Lift-v0")
    for each in (row, other, timed):
        write_row(tmp_path / "a.jsonl", each)
    assert read_rows(tmp_path / "a.jsonl") == [row, other, timed]


def test_what_a_kill_has_left_of_a_last_line_is_left_out_where_that_is_known(tmp_path, row):
    for _ in range(2):
        write_row(tmp_path / "a.jsonl", row)
    whole = (tmp_path / "a.jsonl").read_text()
    (tmp_path / "a.jsonl").write_text(whole[:-20])
    assert read_rows(tmp_path / "a.jsonl", torn_end=True) == [row]
    with pytest.raises(RowError, match="line 2: is not JSON"):
        read_rows(tmp_path / "a.jsonl")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": "10"}, "step is '10', expected int"),
        ({"step": True}, "step is True, expected int"),
        ({"final": 1}, "final is 1, expected bool"),
        ({"data_share": 1.5}, "data_share is 1.5, expected a number in"),
        ({"lengths": [1]}, "4 returns, 1 lengths, 4 successes"),
        ({"returns": [], "lengths": [], "successes": []}, "0 returns"),
        ({"returns": [1.0, "x", 1.0, 1.0]}, "returns holds 'x'"),
        ({"successes": [1, 1, 1, 1]}, "successes holds 1, expected bool"),
        ({"action_ms": "fast"}, "action_ms is 'fast', expected float or int"),
        ({"speed": 3}, "unknown speed"),
    ],
)
def test_a_malformed_row_is_named_by_file_and_line(tmp_path, changes, message, row):
    path = tmp_path / "a.jsonl"
    path.write_text(f"{json.dumps(row)}\n\n{json.dumps({**row, **changes})}\n")
    with pytest.raises(RowError, match=r"a\.jsonl, line 3: ") as error:
        read_rows(path)
    assert message in str(error.value)


@pytest.mark.parametrize("key", KEYS)
def test_every_key_is_needed(tmp_path, key, row):
    del row[key]
    (tmp_path / "a.jsonl").write_text(json.dumps(row))
    with pytest.raises(RowError, match=f"line 1: lacks {key}; expected are task,.*Rename the keys .* or move the file away"):
        read_rows(tmp_path / "a.jsonl")


@pytest.mark.parametrize("text", ['{"task": ', "[1]"])
def test_what_is_no_object_is_refused(tmp_path, text):
    (tmp_path / "a.jsonl").write_text(text)
    with pytest.raises(RowError, match=r"a\.jsonl, line 1: "):
        read_rows(tmp_path / "a.jsonl")


def test_what_json_cannot_hold_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_row(tmp_path / "a.jsonl", make_row(returns=[float("nan")] * 4))


def test_a_runs_file_name_has_no_separators():
    key = RunKey("robosuite/Lift-v0", 0.5, "dt", 2, "small", "no ema")
    assert key.file_name == "robosuite-Lift-v0_0.5_dt_seed2_small_no-ema"
    assert str(key) == "robosuite/Lift-v0, 50% of the data, dt, seed 2, small, no ema"


def test_nan_in_a_file_is_refused(tmp_path, row):
    (tmp_path / "a.jsonl").write_text(json.dumps({**row, "wall_s": float("nan")}))
    with pytest.raises(RowError, match=r"line 1: holds NaN"):
        read_rows(tmp_path / "a.jsonl")
