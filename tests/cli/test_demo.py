"""The demo, at a size that learns nothing."""

import json

import pytest

from sb3_dtfm.cli.main import main

ARGUMENTS = ["demo", "--output", "out", "--demonstrations", "2", "--steps", "2", "--episodes", "4"]


@pytest.mark.slow
def test_demo_writes_its_results_and_repeats_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(ARGUMENTS) == 0
    assert "95 % Wilson interval" in capsys.readouterr().out
    out = tmp_path / "out"
    run = out / "logs" / "dtfm" / "robosuite-Lift-v0_1"
    assert json.loads((run / "evaluation.json").read_text())["episodes"] == 4
    assert (out / "learning_curve.png").is_file()
    times = {
        path: path.stat().st_mtime for path in (out / "lift.hdf5", run / "robosuite-Lift-v0.zip", run / "evaluation.json")
    }

    assert main(ARGUMENTS) == 0
    assert capsys.readouterr().out.count("is there already") == 3
    assert times == {path: path.stat().st_mtime for path in times}
    assert len(list((out / "logs" / "dtfm").iterdir())) == 1
