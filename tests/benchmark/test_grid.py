"""The grid: its runs, and a tiny real one that is killed and goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import pytest
import yaml
from filelock import FileLock

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark import runner
from sb3_dtfm.benchmark.grid import plan, read_tasks
from sb3_dtfm.benchmark.rows import read_rows, write_row
from sb3_dtfm.benchmark.settings import Task, task_settings
from sb3_dtfm.cli.benchmark import parse_arguments
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import load_dataset
from sb3_dtfm.data.inspection import suggested_target_return
from sb3_dtfm.heads import FlowHead
from sb3_dtfm.zoo.arguments import UsageError, find_target_return, with_target_return
from tests.recorded import DATASET_ID

TASK = "HalfCheetah-v5"
POLICY = dict(embed_dim=16, n_layers=1, n_heads=1, flow_hidden_dim=16, flow_n_layers=1, flow_steps=2)
SETTINGS = dict(policy="MultiInputPolicy", n_timesteps=6, batch_size=4, context_length=3, policy_kwargs=POLICY)
STEPS = [(0, False), (2, False), (4, False), (6, False), (6, True)]
PATIENCE = 120  # seconds to wait for a run


@pytest.fixture
def grid(workplace) -> list[str]:
    """Arguments of a grid of 2 data_shares and 2 algorithms, episodes of 10 steps."""
    (workplace / "tiny.yml").write_text(yaml.safe_dump({"default": SETTINGS}))
    arguments = ["benchmark", "--profile", "tiny.yml", "--dataset", f"{TASK}={DATASET_ID}", "--target-return", "50"]
    arguments += ["--eval-freq", "2", "--eval-episodes", "2", "--final-episodes", "3", "--n-eval-envs", "2"]
    return [*arguments, "--env-kwargs", "max_episode_steps:10"]


def start(arguments: list[str]) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-m", "sb3_dtfm", *arguments], env=environment, stdout=subprocess.DEVNULL)


def runs_of(grid: int) -> list[int]:
    """Processes that a grid's threads have started."""
    return [int(pid) for file in Path(f"/proc/{grid}/task").glob("*/children") for pid in file.read_text().split()]


def is_running(pid: int) -> bool:
    """Neither gone nor a zombie."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_a_killed_grid_takes_its_run_along_goes_on_and_repeats_nothing(grid, workplace, capfd, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    grid += ["--fractions", "0.5"]
    process = start(grid)
    results, logs = workplace / "results", workplace / "logs" / "benchmark" / f"{TASK}_0.5_dtfm_seed0_tiny"
    wait_until(
        lambda: process.poll() is not None or (any(results.glob("*.jsonl")) and logs.exists() and runs_of(process.pid))
    )
    (orphan,) = runs_of(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: not is_running(orphan))
    assert not list(logs.glob("*/rows.jsonl"))
    (first,) = results.glob("*.jsonl")
    content, written = first.read_bytes(), first.stat().st_mtime_ns
    # Rows as a run that was killed halfway leaves them behind
    broken = logs / "attempt-old"
    broken.mkdir()
    (broken / "rows.jsonl").write_text(content.decode().splitlines()[0] + "\n")

    assert main(grid) == 0
    output = capfd.readouterr().out
    assert "1 runs to start, 1 finished already in results" in output
    assert "[1/1]" in output
    assert (first.read_bytes(), first.stat().st_mtime_ns) == (content, written)
    assert not broken.exists()
    rows = {each[0]["algo"]: each for each in map(read_rows, results.glob("*.jsonl"))}
    assert set(rows) == {"dt", "dtfm"}
    for each in rows.values():
        assert [(row["step"], row["final"]) for row in each] == STEPS
        assert [len(row["returns"]) for row in each] == [2, 2, 2, 2, 3]
        assert {length for row in each for length in row["lengths"]} == {10}
        assert all(row["successes"] is None for row in each)
        assert {row["data"]["dataset"] for row in each} == {DATASET_ID}
        assert {row["data"]["n_episodes"] for row in each} == {3}
        assert each[0]["data"]["recorded_from"].startswith("PPO: ")
        assert each[0]["settings"]["env_kwargs"] == {"max_episode_steps": 10}
        assert (each[0]["data_share"], each[0]["hardware"]["threads"]) == (0.5, 1)
    assert [(each[0]["flow_solver"], each[0]["flow_steps"]) for each in (rows["dt"], rows["dtfm"])] == [
        (None, None),
        ("euler", 2),
    ]
    (model,) = logs.glob("attempt-*/logs/dtfm/*/HalfCheetah-v5.zip")
    assert DTFM.load(model).num_timesteps == 6

    assert main(grid) == 0
    assert "0 runs to start, 2 finished already" in capfd.readouterr().out
    assert main(["report", "results", "-o", "docs"]) == 0
    assert f"| {TASK} | 50% | *not run*" not in (workplace / "docs" / "report.md").read_text()
    assert main([*grid, "-n", "8"]) == 2
    assert "results has it with n_timesteps 6 instead of 8" in capfd.readouterr().err
    assert main([*grid, "--final-episodes", "2", "--target-return", "7"]) == 2
    assert "has it with --final-episodes 3 instead of 2, env_wrapper " in capfd.readouterr().err


STUB = """
import json, pathlib, sys, time, yaml
(settings,) = yaml.safe_load(pathlib.Path(sys.argv[sys.argv.index("--conf-file") + 1]).read_text()).values()
(arguments,) = settings["callback"][-1].values()
print("step 3 of 6: training", flush=True)
if arguments["row"]["algo"] == "dtfm":
    {instead}
evaluation = dict(step=6, final=True, returns=[1.0] * 3, lengths=[2] * 3, successes=None, flow_solver=None, flow_steps=None)
rest = dict(wall_s=1.0, steps_per_s=6.0, commit=None, versions={{}}, hardware={{}})
pathlib.Path(arguments["rows"]).write_text(json.dumps({{**arguments["row"], **evaluation, **rest}}) + chr(10))
"""


@pytest.fixture
def stub(workplace, monkeypatch):
    """Runs that do nothing; `dtfm` runs the given function."""

    def use(instead: str) -> None:
        (workplace / "stub.py").write_text(STUB.format(instead=instead))

    monkeypatch.setattr(runner, "TRAIN", [sys.executable, "stub.py"])
    return use


@pytest.mark.parametrize(
    ("instead", "says"),
    [("raise ValueError('in the midst')", "ValueError: in the midst"), ("sys.exit()", "nothing was written")],
)
def test_a_run_that_fails_leaves_a_log_and_the_grid_goes_on(instead, says, grid, stub, workplace, capfd):
    stub(instead)
    grid += ["--jobs", "2", "--algo", "dtfm", "dt", "--fractions", "1"]
    with pytest.raises(SystemExit) as exit_:
        main(grid)
    assert exit_.value.code == 1
    (log,) = (workplace / "logs" / "benchmark" / f"{TASK}_1_dtfm_seed0_tiny").glob("*/output.log")
    output = capfd.readouterr().out
    assert "1 of 2 runs failed" in output
    assert f"{log.relative_to(workplace)}: {says}" in output
    assert [path.name for path in (workplace / "results").glob("*.jsonl")] == [f"{TASK}_1_dt_seed0_tiny.jsonl"]

    # A run that was moved into a study's folder meanwhile is finished, too
    (workplace / "results" / "study").mkdir()
    finished = workplace / "results" / f"{TASK}_1_dt_seed0_tiny.jsonl"
    finished.rename(workplace / "results" / "study" / "rows.jsonl")
    stub("pass")
    assert main(grid) == 0
    assert "1 runs to start, 1 finished already" in capfd.readouterr().out
    assert not finished.exists()


CHECKPOINT = "pathlib.Path(sys.argv[sys.argv.index('--conf-file') + 1]).parent / 'logs/checkpoint.zip'"


def test_an_interrupted_run_with_other_settings_is_kept(grid, stub, workplace, capfd):
    grid += ["--algo", "dtfm", "--fractions", "1"]
    stub(
        f"file = {CHECKPOINT}; file.parent.mkdir(); file.write_text(str(settings['n_timesteps'])); "
        "pathlib.Path(arguments['rows']).touch(); sys.exit(1)"
    )
    for n_steps in ("6", "8"):
        with pytest.raises(SystemExit):
            main([*grid, "-n", n_steps])
    assert "holds an interrupted run with other settings, which is kept" in capfd.readouterr().out
    folder = workplace / "logs" / "benchmark" / f"{TASK}_1_dtfm_seed0_tiny"
    (folder / "attempt-killed/logs").mkdir(parents=True)  # while it copied, before its settings were written
    (folder / "attempt-killed/logs/checkpoint.zip").touch()
    stub(f"pathlib.Path('found').write_text(({CHECKPOINT}).read_text())")
    assert main([*grid, "-n", "6"]) == 0
    assert (workplace / "found").read_text() == "6"
    assert sorted(path.read_text() for path in folder.glob("attempt-*/logs/checkpoint.zip")) == ["6", "8"]


def test_results_and_logs_may_share_a_folder(grid, stub, workplace):
    stub("pass")
    assert main([*grid, "--algo", "dt", "--fractions", "1", "-o", "mine", "-f", "mine"]) == 0
    assert (workplace / "mine" / f"{TASK}_1_dt_seed0_tiny.jsonl").is_file()


def test_an_interrupted_grid_ends_its_runs_and_says_so(grid, stub, workplace, monkeypatch, capfd):
    stub("pathlib.Path('asleep').touch(); time.sleep(600)")
    started = []
    popen = subprocess.Popen
    monkeypatch.setattr(
        runner.subprocess, "Popen", lambda *args, **kwargs: started.append(popen(*args, **kwargs)) or started[-1]
    )

    def interrupt() -> None:
        wait_until((workplace / "asleep").exists)
        os.kill(os.getpid(), signal.SIGTERM)

    Thread(target=interrupt).start()
    with pytest.raises(SystemExit) as exit_:
        main([*grid, "--fractions", "1"])
    assert exit_.value.code == 130
    output = capfd.readouterr().out
    assert "Interrupted after 1 of 2 runs" in output
    assert "FAILED" not in output
    assert [process.returncode for process in started] == [0, -signal.SIGTERM]
    assert len(list((workplace / "results").glob("*.jsonl"))) == 1


def test_a_run_that_another_process_runs_is_left_to_it(grid, stub, workplace, capfd):
    stub("pass")
    locks = workplace / "results" / ".locks"
    locks.mkdir(parents=True)
    with FileLock(locks / f"{TASK}_1_dt_seed0_tiny.lock"), pytest.raises(SystemExit) as exit_:
        main([*grid, "--fractions", "1"])
    assert exit_.value.code == 1
    output = capfd.readouterr().out
    assert f"{TASK}, 100% of the data, dt, seed 0, tiny: another process is running it" in output
    assert "0 of 2 runs failed, 1 are left to other processes" in output
    assert [path.name for path in (workplace / "results").glob("*.jsonl")] == [f"{TASK}_1_dtfm_seed0_tiny.jsonl"]


@pytest.mark.parametrize("profile", ["default", "paper"])
@pytest.mark.parametrize("env_id", [TASK, "Ant-v5", "robosuite/Lift-v0"])
def test_the_packaged_profiles_differ_in_the_head_only(profile, env_id):
    dt, dtfm = (task_settings(profile, algo, Task(env_id), 0.5, None, {}) for algo in ("dt", "dtfm"))
    own = set(FlowHead.options_class.defaults()) if profile == "paper" else set()
    assert set(dtfm["policy_kwargs"]) - set(dt["policy_kwargs"]) == own
    dtfm["policy_kwargs"] = {key: value for key, value in dtfm["policy_kwargs"].items() if key not in own}
    assert dt == dtfm
    assert dt["dataset_kwargs"] == {"fraction": 0.5, "fraction_seed": 0}


@pytest.mark.parametrize("nested", [True, False])
def test_policy_kwargs_of_params_are_merged_and_heads_left_to_their_algorithm(nested):
    """Also where they stand beside the others, by their own names."""
    kwargs = {"flow_steps": 3, "dropout": 0.0, "regression_coef": 0.1}
    changes = {**({"policy_kwargs": kwargs} if nested else kwargs), "ema_decay": 0.9}
    dt, dtfm = (task_settings("paper", algo, Task(TASK), 1.0, 7, changes) for algo in ("dt", "dtfm"))
    assert (dtfm["policy_kwargs"]["flow_steps"], dtfm["policy_kwargs"]["regression_coef"]) == (3, 0.1)
    assert dtfm["policy_kwargs"]["embed_dim"] == 256
    assert (dt["policy_kwargs"]["dropout"], dt["ema_decay"], dt["n_timesteps"]) == (0.0, 0.9, 7)
    assert not {"flow_steps", "regression_coef"} & set(dt["policy_kwargs"])


def test_tasks_come_from_a_file_or_from_pairs(tmp_path):
    file = tmp_path / "data.yml"
    entry = {"dataset": "local/ant/expert-v0", "target_return": 5000, "recorded_from": "PPO"}
    file.write_text(yaml.safe_dump({"robosuite/Lift-v0": "lift.hdf5", "Ant-v5": entry}, sort_keys=False))
    more = ["--dataset", "robosuite/Lift-v0=other.hdf5", "--target-return", "Ant-v5=6000"]
    tasks = read_tasks(parse_arguments(["--datasets", str(file), *more]))
    assert tasks == [Task("robosuite/Lift-v0", "other.hdf5"), Task("Ant-v5", "local/ant/expert-v0", 6000.0, "PPO")]
    assert read_tasks(parse_arguments(["--env", TASK, "--target-return", "9"])) == [Task(TASK, None, 9.0)]


ENTRIES = {
    "whole": {"dataset": DATASET_ID, "task": TASK, "env_kwargs": {"max_episode_steps": 10}, "chosen_with": True},
    "some": {
        "dataset": DATASET_ID,
        "task": TASK,
        "env_kwargs": {"max_episode_steps": 20, "ctrl_cost_weight": 0.2},
        "dataset_kwargs": {"on_invalid": "drop"},
        "fraction": 0.67,
        "algorithms": ["bc", "dt"],
        "gym_packages": ["gymnasium"],
    },
}


@pytest.fixture
def suite(workplace) -> list[str]:
    """Arguments of a grid of two data sets of the same task."""
    (workplace / "suite.yml").write_text(yaml.safe_dump(ENTRIES, sort_keys=False))
    (workplace / "tiny.yml").write_text(yaml.safe_dump({"default": SETTINGS}))
    arguments = ["--datasets", "suite.yml", "--profile", "tiny.yml", "--algo", "bc", "bc-best", "dt", "dtfm"]
    return [*arguments, "--eval-freq", "6", "--eval-episodes", "2", "--final-episodes", "3", "--n-eval-envs", "2"]


def test_several_data_sets_of_a_task_are_told_apart_by_their_names(suite):
    jobs, _ = plan(parse_arguments(suite))
    found = [(job.key.task, job.key.data_share, job.key.algo) for job in jobs]
    whole = [("whole", data_share, algo) for data_share in (1.0, 0.5) for algo in ("bc", "bc-best", "dt", "dtfm")]
    assert found == [*whole, *(("some", data_share, algo) for data_share in (1.0, 0.5) for algo in ("bc", "dt"))]
    assert {job.row["env_id"] for job in jobs} == {TASK}
    assert [job.data.get("chosen_with", False) for job in jobs] == [True] * 8 + [False] * 4
    some = [job for job in jobs if job.key.task == "some"]
    assert [job.settings["dataset_kwargs"]["fraction"] for job in some] == [0.67, 0.67, 0.335, 0.335]
    assert {job.data["n_episodes"] for job in some} == {2}, "of three, whatever share of the two is learned from"
    assert {job.data["n_steps"] for job in some} == {40}, "up to the time limit"
    assert {job.settings["env_kwargs"]["ctrl_cost_weight"] for job in some} == {0.2}
    assert {job.settings["dataset_kwargs"]["on_invalid"] for job in some} == {"drop"}


def test_what_the_command_says_of_data_and_environment_goes_before_the_entry_key_by_key(suite):
    more = ["--env", "some", "--env-kwargs", "ctrl_cost_weight:0.3", "--dataset-cache", "cache", "--target-return", "9"]
    (job, *_), _ = plan(parse_arguments([*suite, *more]))
    assert job.settings["env_kwargs"] == {"max_episode_steps": 20, "ctrl_cost_weight": 0.3}
    assert job.settings["dataset_kwargs"] == {
        "on_invalid": "drop",
        "cache_dir": "cache",
        "fraction": 0.67,
        "fraction_seed": 0,
    }
    assert find_target_return(job.settings["env_wrapper"]) == 9.0


def test_the_data_suggest_a_return_to_ask_for_where_nobody_names_one(suite, workplace):
    """Nor the profile's is taken, which belongs to its own dataset."""
    (workplace / "tiny.yml").write_text(
        yaml.safe_dump({"default": {**SETTINGS, "dataset": "their/own-v0", "env_wrapper": with_target_return(7.0, [])}})
    )
    jobs, _ = plan(parse_arguments([*suite, "--env", "whole", "--fractions", "1", "0.4"]))
    buffer = load_dataset(DATASET_ID, max_episode_steps=10)
    targets = {job.key.data_share: find_target_return(job.settings["env_wrapper"]) for job in jobs}
    shares = {data_share: suggested_target_return(buffer.random_fraction(data_share, 0)) for data_share in (1.0, 0.4)}
    assert targets == shares
    assert jobs[0].data["best_return"] == pytest.approx(buffer.episode_returns.max(), abs=1e-3)


def test_a_suite_with_behaviour_cloning_runs_is_not_run_again_and_makes_a_report(suite, workplace, monkeypatch, capfd):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    command = ["benchmark", *suite, "--env", "some", "--fractions", "1", "-n", "6"]
    assert main(command) == 0
    rows = {each[0]["algo"]: each for each in map(read_rows, Path("results").glob("some_1_*.jsonl"))}
    assert set(rows) == {"bc", "dt"}
    for each in rows.values():
        assert [row["step"] for row in each] == [0, 6, 6]
        assert {(row["task"], row["env_id"]) for row in each} == {("some", TASK)}
        assert {length for row in each for length in row["lengths"]} == {20}
    finals = [each[-1] for each in rows.values()]
    assert len({row["data"]["random_return"] for row in finals}) == 1, "the same random actions for all"
    assert main(command) == 0
    assert "0 runs to start, 2 finished already" in capfd.readouterr().out
    assert main(["report", "results", "-o", "docs"]) == 0
    report = (workplace / "docs" / "report.md").read_text()
    assert "| data set | recorded; best tenth | BC | DT | DTFM |" in report
    assert (workplace / "docs" / "scores-tiny.png").exists()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"datset": "a"}, "mine: expected a dataset, or a mapping of task, dataset, target_return,"),
        ({"fraction": 2}, "mine, fraction: expected a number in (0, 1], got 2."),
        ({"algorithms": ["td3"]}, "mine, algorithms: expected a list of dt, dtfm, bc, bc-best, got ['td3']."),
        ({"env_kwargs": 3}, "mine, env_kwargs: expected a mapping, got 3."),
        ({"target_return": "much"}, "mine, target_return: expected a number, got 'much'."),
        ({"chosen_with": "yes"}, "mine, chosen_with: expected true or false, got 'yes'."),
        ({"gym_packages": ["no_such_module"]}, "mine, gym_packages: no_such_module: No module named"),
        ({"task": "HalfCheeta-v5"}, "mine, task: Environment `HalfCheeta` doesn't exist. Did you mean: `HalfCheetah`?"),
        ({"task": TASK, "env_kwargs": {"colour": 1}}, f"mine, a task of {TASK}: "),
    ],
)
def test_a_mistake_in_an_entry_is_told_with_its_file_its_name_and_its_key(entry, message, workplace, capsys):
    (workplace / "suite.yml").write_text(yaml.safe_dump({"mine": {"dataset": DATASET_ID, **entry}}))
    (workplace / "tiny.yml").write_text(yaml.safe_dump({"default": SETTINGS}))
    assert main(["benchmark", "--datasets", "suite.yml", "--profile", "tiny.yml"]) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert message in error


def test_the_first_seed_of_everything_comes_first(grid, monkeypatch):
    options = parse_arguments([*grid[1:], "--seeds", "0", "1"])
    jobs, done = plan(options)
    assert [(job.key.seed, job.key.data_share, job.key.algo) for job in jobs] == [
        (seed, data_share, algo) for seed in (0, 1) for data_share in (1.0, 0.5) for algo in ("dt", "dtfm")
    ]
    assert {json.dumps(job.data) for job in jobs} == {json.dumps(jobs[0].data)}
    assert done == []


def test_a_file_of_other_rows_is_not_taken_for_the_run(grid, workplace, row):
    """Two labels can become the same file name."""
    (workplace / "results").mkdir()
    other = {**row, "task": TASK, "algo": "dt", "profile": "tiny", "label": "a b"}
    write_row(workplace / "results" / f"{TASK}_1_dt_seed0_tiny_a-b.jsonl", other)
    with pytest.raises(UsageError, match=r"dt, seed 0, tiny, a-b: .*a-b.jsonl is there, without a final evaluation"):
        plan(parse_arguments([*grid[1:], "--label", "a-b"]))


def test_algorithms_with_different_transformers_are_refused(grid, workplace):
    folder = workplace / "profile"
    folder.mkdir()
    for algo, width in (("dt", 16), ("dtfm", 32)):
        (folder / f"{algo}.yml").write_text(
            yaml.safe_dump({"default": {**SETTINGS, "policy_kwargs": {**POLICY, "embed_dim": width}}})
        )
    with pytest.raises(UsageError, match="embed_dim of HalfCheetah-v5 is 16 for dt and 32 for dtfm"):
        plan(parse_arguments([*grid[1:], "--profile", "profile"]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "HalfCheeta-v5"], "Environment `HalfCheeta` doesn't exist. Did you mean: `HalfCheetah`?"),
        ([], "no task: name some with --env"),
        (["--dataset", TASK], f"--dataset {TASK}: expected TASK=DATASET"),
        (["--dataset", f"{TASK}=nowhere.hdf5"], "nowhere.hdf5 does not exist"),
        (
            ["--dataset", f"Walker2d-v5={DATASET_ID}"],
            f"was recorded in {TASK}, and the environment is Walker2d-v5. If the data are meant for it, say so with",
        ),
        (["--env", "Hopper-v5"], "--dataset: needed for Hopper-v5"),
        (["--env", TASK, "--profile", "nowhere.yml"], "--profile nowhere.yml: nowhere.yml does not exist"),
        (["--env", TASK, "--fractions", "2"], "--fractions: must lie in (0, 1], got 2.0"),
        (["--env", TASK, "--jobs", "0"], "--jobs: must be at least 1, got 0"),
        (["--env", TASK, "-params", "ema_decay:0.9"], "-params: needs --label"),
        (["--env", TASK, "--label", "a", "-params", "dataset_kwargs:dict(fraction=0.5)"], "fraction: the grid sets it"),
        (["--env", TASK, "--label", "a", "-params", "ema:1"], "ema: no setting of dt"),
        (["--env", TASK, "--label", "a", "-params", "ema_decay"], "-params ema_decay: expected key:value"),
        (["--env", TASK, "--label", "a", "-params", "precision:object()"], "a setting that YAML cannot hold"),
        (["--env", TASK, "--target-return", "much"], "--target-return much: expected a number, got 'much'"),
    ],
)
def test_a_mistake_ends_in_one_clear_line_before_anything_runs(arguments, message, workplace, capsys):
    assert main(["benchmark", *arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert message in error[0]
    assert not Path("results").exists()
    assert not Path("logs").exists()


@pytest.mark.slow
def test_an_interrupted_run_goes_on_from_its_checkpoint_to_the_same_rows(grid, workplace, monkeypatch):
    """A run loses nothing that a checkpoint holds."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    grid += ["--fractions", "0.5", "--algo", "dtfm"]
    ends = {"tests.zoo.test_resuming.SignalAt": {"step": 3, "number": int(signal.SIGTERM)}}
    (workplace / "ending.yml").write_text(yaml.safe_dump({"default": {**SETTINGS, "callback": ends}}))
    disturbed = [{"tiny.yml": "ending.yml"}.get(argument, argument) for argument in grid]
    assert main(grid) == 0
    with pytest.raises(SystemExit):
        main(disturbed)
    logs = workplace / "logs" / "benchmark" / f"{TASK}_0.5_dtfm_seed0_ending"
    assert [row["step"] for file in logs.glob("*/rows.jsonl") for row in read_rows(file)] == [0, 2, 4]
    assert main(disturbed) == 0
    straight, resumed = (read_rows(workplace / "results" / f"{TASK}_0.5_dtfm_seed0_{p}.jsonl") for p in ("tiny", "ending"))
    assert [(row["step"], row["final"]) for row in resumed] == STEPS
    assert [row["returns"] for row in resumed] == [row["returns"] for row in straight]
    assert "Loading pretrained agent" in next(logs.glob("*/output.log")).read_text()
