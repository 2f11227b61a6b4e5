"""Results: summed up, as a table and back, merged, and refused with file and line."""

import csv
import math
from pathlib import Path

import pytest

from sb3_dtfm.benchmark.results import COLUMNS, read_results, read_table, result_files, summarize, write_results
from sb3_dtfm.benchmark.rows import RowError, RunKey, finished_runs, write_row
from sb3_dtfm.cli.main import main
from tests.benchmark.conftest import make_row

ROWS = Path(__file__).parent / "rows"


def test_a_result_has_means_and_counts_of_its_episodes():
    result = summarize(make_row(lengths=[40, 41, 1000, 999]))
    assert (result["n_episodes"], result["successes"], result["mean_return"]) == (4, 3, 0.75)
    assert result["std_return"] == pytest.approx(0.5)
    assert (result["mean_length"], result["max_length"]) == (520.0, 1000)
    assert (result["n_under_1000"], result["n_under_100"]) == (3, 2)
    assert result["steps_to_success"] == [40, 41, 999]
    assert result["settings"] == {}
    during = summarize(make_row(final=False, successes=None, returns=[1.0], lengths=[3]))
    assert (during["successes"], during["std_return"], during["steps_to_success"]) == (None, None, [])
    assert during["settings"] is during["commit"] is None, "said once for a run"


def test_a_table_holds_what_was_written(tmp_path):
    rows = [
        make_row(),
        make_row(final=False, wall_s=123456.789),
        make_row(seed=1, successes=[False] * 4, action_ms=1.5, task="lift-10", env_id="robosuite/Lift-v0", commit=None),
        make_row(algo="dt", successes=None, flow_solver=None, flow_steps=None, returns=[1 / 3] * 4, label='a "b", c\nd'),
        make_row(
            seed=2, data_share=0.05, settings={"policy_kwargs": {"dropout": 0.1}}, versions={"its torch": "2.13.0+cpu"}
        ),
    ]
    results = [summarize(row) for row in rows]
    write_results(tmp_path / "a.csv", reversed(results))
    found = read_table(tmp_path / "a.csv")
    assert len(found) == 5
    assert all(result in found for result in results)
    text = (tmp_path / "a.csv").read_text()
    assert text.startswith("task,algorithm,seed,")
    write_results(tmp_path / "a.csv", found)
    assert (tmp_path / "a.csv").read_text() == text


def test_a_table_gives_the_report_of_its_rows(tmp_path, capsys):
    assert main(["report", str(ROWS), "--csv", str(tmp_path / "all.csv")]) == 0
    assert "all.csv" in capsys.readouterr().out
    for name, source in (("rows", ROWS), ("table", tmp_path / "all.csv")):
        assert main(["report", str(source), "-o", str(tmp_path / name)]) == 0
    assert (tmp_path / "table" / "report.md").read_text() == (tmp_path / "rows" / "report.md").read_text()
    for figure in (tmp_path / "rows").glob("*.png"):
        assert (tmp_path / "table" / figure.name).read_bytes() == figure.read_bytes()


def test_files_of_several_machines_are_put_together(tmp_path):
    rows = [make_row(seed=seed) for seed in range(3)]
    write_row(tmp_path / "a.jsonl", rows[0])
    write_row(tmp_path / "b.jsonl", rows[1])
    write_row(tmp_path / "b.jsonl", rows[2])
    expected = [summarize(row) for row in rows]
    (tmp_path / "all.jsonl").write_text("".join((tmp_path / name).read_text() for name in ("a.jsonl", "b.jsonl")))
    assert read_results([tmp_path / "a.jsonl", tmp_path / "b.jsonl"]) == {"": expected}
    assert read_results([tmp_path]) == {"": expected}, "a row that is there twice counts once"
    write_results(tmp_path / "all.csv", expected)
    assert read_results([tmp_path / "a.jsonl", tmp_path / "all.csv"]) == {"": expected}, "in whatever form"
    assert finished_runs(rows) == {RunKey.of(row): 10 for row in rows}


def test_a_folder_below_the_one_that_is_named_and_a_table_in_it_are_studies(tmp_path):
    for name in ("a.jsonl", "small/b.jsonl", "few/c.jsonl", "few/d.jsonl", "few/notes.txt", "grid.csv", "few/other.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = {study: [file.name for file in files] for study, files in result_files([tmp_path]).items()}
    assert names == {"": ["a.jsonl"], "few": ["c.jsonl", "d.jsonl"], "small": ["b.jsonl"], "grid": ["grid.csv"]}
    both = result_files([tmp_path / "small", tmp_path / "few" / "c.jsonl", tmp_path / "grid.csv"])
    assert {study: [file.name for file in files] for study, files in both.items()} == {
        "": ["b.jsonl", "c.jsonl", "grid.csv"]
    }
    with pytest.raises(FileNotFoundError, match="nowhere does not exist; expected a folder or a file"):
        result_files([tmp_path / "nowhere"])


def test_two_results_of_one_evaluation_are_refused(tmp_path):
    write_row(tmp_path / "a.jsonl", make_row())
    write_row(tmp_path / "b.jsonl", make_row(returns=[0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(RowError, match=r"a\.jsonl and .*b\.jsonl: different results of robosuite/Lift-v0"):
        read_results([tmp_path])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("seed", "x", "seed is 'x', expected a whole number"),
        ("seed", "", "seed is '', expected a whole number"),
        ("final", "yes", "final is 'yes', expected true or false"),
        ("mean_return", "nan", "mean_return is 'nan', expected a number"),
        ("data_share", "1.5", "data_share is 1.5, expected a number in (0, 1]"),
        ("successes", "5", "holds 5 successes of 4 episodes"),
        ("episodes", "0", "holds 3 successes of 0 episodes"),
        ("steps_to_success", "4 x", "steps_to_success is '4 x', expected whole numbers with spaces between"),
        ("settings", "", "settings is '', expected an object of JSON"),
        ("settings", "[1]", "settings is '[1]', expected an object of JSON"),
        ("data", '{"a": NaN}', "data is '{\"a\": NaN}', expected an object of JSON"),
        ("versions", "numpy", "versions is 'numpy', expected names and versions"),
    ],
)
def test_a_malformed_line_is_named_by_file_and_line(tmp_path, name, text, message):
    path = tmp_path / "a.csv"
    write_results(path, map(summarize, (make_row(), make_row(seed=1))))
    with path.open(newline="") as file:
        lines = list(csv.reader(file))
    lines[2][list(COLUMNS).index(name)] = text
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    with pytest.raises(RowError) as error:
        read_table(path)
    assert f"a.csv, line 3: {message}" in str(error.value)


def test_another_table_and_a_cut_one_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("r,l,t\n1,2,3\n")
    with pytest.raises(RowError, match=r"a\.csv, line 1: lacks task, .*`sb3-dtfm report FOLDER --csv FILE` writes"):
        read_table(tmp_path / "a.csv")
    write_results(tmp_path / "b.csv", [summarize(make_row())])
    (tmp_path / "b.csv").write_text((tmp_path / "b.csv").read_text().rpartition(",")[0] + "\n")
    with pytest.raises(RowError, match=r"b\.csv, line 2: holds \d+ values, expected 28"):
        read_table(tmp_path / "b.csv")


def test_a_table_is_of_one_study(tmp_path, capsys):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_row(tmp_path / name / "rows.jsonl", make_row())
    assert main(["report", str(tmp_path), "--csv", str(tmp_path / "all.csv")]) == 2
    assert "holds the studies a, b; name the folder of one" in capsys.readouterr().err
    assert not (tmp_path / "all.csv").exists()


def test_digits_are_enough_for_what_reports_show():
    assert summarize(make_row(returns=[12345.6789] * 4))["mean_return"] == 12345.679
    assert math.isclose(summarize(make_row(wall_s=1234567.891))["wall_s"], 1234567.9)
