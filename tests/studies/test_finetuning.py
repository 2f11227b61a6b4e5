"""Measurements and figures of the fine-tuning study."""

import shutil

import finetuning
import numpy as np
import pytest

from sb3_dtfm.benchmark.report.runs import read_studies
from sb3_dtfm.benchmark.rows import RunKey, read_rows, write_row
from sb3_dtfm.cli.main import main
from tests.benchmark.conftest import make_row
from tests.recorded import DATASET_ID, tiny_training


def test_a_run_is_measured_and_shown(workplace):
    assert main(tiny_training("dtfm", "dataset:" + repr(DATASET_ID))) == 0
    before = workplace / "logs/dtfm/HalfCheetah-v5_1"
    settings = ["-params", "n_episodes:2", "gradient_steps:2", "n_envs:2", "batch_size:4"]
    command = ["finetune", "--algo", "dtfm", "--env", "HalfCheetah-v5", "--model", str(before), "-n", "80", *settings]
    evaluated = ["--eval-freq", "40", "--eval-episodes", "3", "--eval-env-kwargs", "max_episode_steps:22"]
    assert main([*command, *evaluated]) == 0
    key = RunKey("HalfCheetah-v5", 1.0, "dtfm", 0, "tiny")
    like = dict(key._asdict(), settings={"batch_size": 4}, data={"n_episodes": 3}, flow_solver="euler", flow_steps=1)
    (workplace / "rows").mkdir()
    run = workplace / "logs/dtfm/HalfCheetah-v5_2"
    shutil.copy(before / "HalfCheetah-v5.zip", run / "best_model.zip")  # one that is known not to be the last
    finetuning.measure(run, before, like, "own", workplace / "rows")
    (study,) = read_studies([workplace / "rows"])
    runs = {group.label: next(iter(group.runs.values()))[0] for group in study.groups}
    before, after, best = (runs[label] for label in ("before", "own", "own-best"))
    assert [row["step"] for row in after.evaluations] == [0, 40, 80]
    assert [result["n_episodes"] for result in after.evaluations] == [3, 3, 3]
    assert not before.evaluations
    assert not best.evaluations
    assert best.final["mean_return"] == before.final["mean_return"]
    with np.load(run / "evaluations.npz") as evaluations:
        means = evaluations["results"].mean(axis=1)
        assert best.final["step"] == evaluations["timesteps"][means.argmax()]
    assert before.final["mean_length"] == after.final["mean_length"] == 22  # as in evaluations, longer than rollouts
    assert after.final["settings"]["env_kwargs"] == {"max_episode_steps": 20}
    assert before.final["mean_return"] != after.final["mean_return"]
    assert after.final["settings"]["gradient_steps"] == 2
    assert after.final["settings"]["policy_kwargs"]["embed_dim"] == 16  # of the model before
    rows = read_rows(workplace / "rows" / f"{key._replace(label='own').file_name}.jsonl")
    seconds = np.array([row["wall_s"] for row in rows])
    assert seconds[0] == 0.0
    assert (np.diff(seconds) >= 0).all()
    assert seconds[-1] > 0
    finetuning.plot(workplace / "rows", "HalfCheetah-v5", ["own"], workplace / "curves.png")
    assert (workplace / "curves.png").stat().st_size > 5000


def test_a_noise_space_run_is_measured_where_its_decisions_are_steps(workplace):
    for chunk_size, number in ((1, 1), (4, 2)):
        settings = f"policy_kwargs:dict(embed_dim=16,n_layers=1,n_heads=1,flow_hidden_dim=16,chunk_size={chunk_size})"
        assert main(tiny_training("dtfm", "dataset:" + repr(DATASET_ID), settings)) == 0
        before = workplace / f"logs/dtfm/HalfCheetah-v5_{number}"
        quick = [
            "-params",
            "n_envs:1",
            "learning_starts:10",
            "batch_size:8",
            "gradient_steps:1",
            "policy_kwargs:dict(net_arch=[16])",
        ]
        command = ["finetune", "--algo", "sac", "--env", "HalfCheetah-v5", "--model", str(before), "-n", "40", *quick]
        assert main([*command, "--eval-freq", "20", "--eval-episodes", "3"]) == 0
    (workplace / "rows").mkdir()
    key = RunKey("HalfCheetah-v5", 1.0, "dtfm", 0, "tiny")
    like = dict(key._asdict(), settings={"batch_size": 4}, data={"n_episodes": 3}, flow_solver="euler", flow_steps=1)
    finetuned = workplace / "logs/finetuned"
    finetuning.measure(finetuned / "HalfCheetah-v5_1", before, like, "finetuned", workplace / "rows")
    rows = read_rows(workplace / "rows" / f"{key._replace(label='finetuned').file_name}.jsonl")
    assert [row["step"] for row in rows] == [0, 20, 40, 40]
    assert rows[-1]["settings"]["noise_env"]["algorithm"] == "sac"
    with pytest.raises(SystemExit, match="its timesteps are decisions of several actions"):
        finetuning.measure(finetuned / "HalfCheetah-v5_2", before, like, "finetuned", workplace / "rows")


def test_rollouts_are_shown_by_the_steps_they_took(tmp_path, monkeypatch):
    like = make_row()
    lift = {("Lift", 0, "many", 50): 2, ("Lift", 1, "many", 54): 4, ("Lift", 0, "none", 10): 1, ("Lift", 1, "none", 10): 0}
    can = {("Can", 0, "none", 10): 3, ("Can", 1, "none", 10): 1, ("Can", 0, "many", 30): 3, ("Can", 1, "many", 30): 4}
    for (task, seed, label, n_steps), n in {**lift, **can}.items():
        row = {**like, "task": task, "seed": seed, "label": label}
        row.update(data={**like["data"], "n_steps": n_steps}, returns=[0.0] * 4, lengths=[9] * 4)
        row["successes"] = [True] * n + [False] * (4 - n)
        write_row(tmp_path / f"{RunKey.of(row).file_name}.jsonl", row)
    shown = {axes.get_title(): axes for axes in finetuning.plot_rollouts(tmp_path).axes}
    assert [line.get_ydata().tolist() for line in shown["Lift"].lines] == [[25, 50], [0, 100], [12.5, 75]]
    assert [line.get_ydata().tolist() for line in shown["Can"].lines] == [[75, 75], [25, 100], [50, 87.5]]
    assert {tuple(line.get_xdata()) for line in shown["Lift"].lines} == {(0, 42)}, "on average"
    assert {tuple(line.get_xdata()) for line in shown["Can"].lines} == {(0, 20)}
    monkeypatch.setattr("sys.argv", ["finetuning.py", "rollouts", str(tmp_path), "--output", str(tmp_path / "rollouts.png")])
    finetuning.main()
    assert (tmp_path / "rollouts.png").is_file()
    with pytest.raises(SystemExit, match="rows of Square with the same seeds"):
        finetuning.by_rollout_steps(tmp_path, "Square")
