"""Baselines learn from what ours learn from, act where ours act, and their rows are rows."""

import importlib
import io
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from baselines import command, entries, figure, table
from baselines.process import BaselineError, BaselineProcess
from baselines.protocol import read_dataset, receive, send
from gymnasium import spaces
from matplotlib.axes import Axes

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.benchmark.results import read_results
from sb3_dtfm.benchmark.rows import read_rows, write_row
from sb3_dtfm.data import Trajectory, TrajectoryBuffer, load_dataset
from sb3_dtfm.envs import register_gymnasium_robotics
from sb3_dtfm.zoo.arguments import UsageError

ROOT = Path(__file__).parents[2]
TINY = "tests.studies.tiny_worker"
OTHERS = entries.read_entries(entries.HERE / "settings.yml", entries.Baseline)
# Each baseline with all the settings that it has, and a kind of task for each.
SETTINGS = [(name, kind) for name, baseline in OTHERS.items() for kind in dict.fromkeys((baseline.only[0], *baseline.kinds))]
PYTHONS = {worker: ROOT / folder / "bin" / "python" for worker, folder in command.FOLDERS.items()}


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    """As `make baselines` is called; the tiny worker is found from here."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.fixture
def buffer() -> TrajectoryBuffer:
    """Episodes of Pendulum with every kind of end, whose actions are a linear map of the observation."""
    rng = np.random.default_rng(0)
    matrix = np.array([[0.5], [-0.3], [0.1]])
    episodes = []
    for i, length in enumerate((7, 12, 5, 9, 20)):
        observations = rng.uniform(-1, 1, (length, 3)).astype(np.float32)
        ends = dict(terminated=i % 3 == 0, truncated=i % 3 == 1)
        rewards = np.full(length, float(i))
        episodes.append(Trajectory(observations, (2 * observations @ matrix).astype(np.float32), rewards, **ends))
    return TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-2, 2, (1,)))


@pytest.fixture
def datasets(tmp_path, buffer) -> Path:
    """A file like studies/baselines.yml, of one dataset."""
    buffer.save(tmp_path / "pendulum.npz")
    (tmp_path / "baselines.yml").write_text(
        f"pendulum: {{task: Pendulum-v1, kind: manipulation, dataset: {tmp_path / 'pendulum.npz'}, "
        "target_return: 0, minutes: 1}\n"
    )
    return tmp_path / "baselines.yml"


def tiny_process(tmp_path: Path) -> BaselineProcess:
    return BaselineProcess(Path(sys.executable), TINY, tmp_path / "log")


def test_a_message_arrives_as_it_was_sent():
    stream = io.BytesIO()
    arrays = {"a": np.arange(6.0).reshape(2, 3)[:, ::2], "none": np.zeros((0, 4), np.float32), "flag": np.array(True)}
    send(stream, "act", arrays, number=0.1, text="für\n")
    send(stream, "next")
    stream.seek(0)
    message = receive(stream)
    assert (message.what, message.values) == ("act", {"number": 0.1, "text": "für\n"})
    for name, array in arrays.items():
        assert message.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(message.arrays[name], array)
    assert receive(stream).what == "next"
    with pytest.raises(EOFError):
        receive(stream)


@pytest.mark.filterwarnings("ignore:.*max_episode_steps")
@pytest.mark.parametrize(("fraction", "best_share", "limit"), [(1.0, None, None), (0.6, None, 8), (1.0, 0.4, 9)])
def test_a_baseline_is_given_the_steps_that_ours_learn_from(datasets, buffer, tmp_path, fraction, best_share, limit):
    data = entries.read_entries(datasets, entries.Data)["pendulum"]._replace(fraction=fraction)
    entries.export(
        data,
        entries.Baseline("any", "d3rlpy", 1, {}, best_share=best_share),
        tmp_path / "out.npz",
        {"max_episode_steps": limit},
    )
    expected = load_dataset(buffer, max_episode_steps=limit).random_fraction(fraction, seed=0)
    expected = expected if best_share is None else expected.best(best_share=best_share)
    given = read_dataset(tmp_path / "out.npz")
    assert [len(episode.actions) for episode in given.episodes] == expected.episode_lengths.tolist()
    assert [episode.terminated for episode in given.episodes] == expected.terminated.tolist()
    for name in ("observations", "rewards"):
        steps = np.concatenate([getattr(episode, name) for episode in given.episodes])
        np.testing.assert_array_equal(steps, getattr(expected, name).numpy())
    scaled = np.concatenate([episode.actions for episode in given.episodes])
    assert np.abs(scaled).max() <= 1.0
    np.testing.assert_allclose(given.to_environment(scaled), expected.actions.numpy(), atol=1e-6)


def test_a_baseline_learns_and_acts_in_the_range_of_the_environment(tmp_path, buffer):
    buffer.save(tmp_path / "episodes.npz")
    observations = np.random.default_rng(1).uniform(-1, 1, (3, 3)).astype(np.float32)
    with tiny_process(tmp_path) as process:
        training = process.train(tmp_path / "episodes.npz", {"learning_rate": 0.5}, 0, 50, None)
        asked = {"observation": observations, "return_to_go": np.zeros((3, 1), np.float32)}
        actions, state = process.predict(asked, None, np.array([True, True, True]))
        again, _ = process.predict(asked, None, np.array([False, True, False]))
        assert process.action_ms() > 0.0
    assert (training.n_steps, process.versions.keys()) == (50, {"numpy"})
    assert state is None
    # The range is from -2 to 2; the action tells how long each environment's own episode has been.
    np.testing.assert_allclose(actions, [[0.002]] * 3, atol=1e-6)
    np.testing.assert_allclose(again, [[0.004], [0.002], [0.004]], atol=1e-6)
    assert "does no harm" in (tmp_path / "log").read_text()


def test_the_minutes_end_a_training_before_the_steps_do(tmp_path, buffer):
    buffer.save(tmp_path / "episodes.npz")
    with tiny_process(tmp_path) as process:
        training = process.train(tmp_path / "episodes.npz", {"learning_rate": 0.5}, 0, 10**9, 0.1 / 60)
    assert 1 <= training.n_steps < 10**6
    assert training.processor_seconds < 2.0


def test_an_ended_baseline_names_its_log_and_why(tmp_path, buffer):
    buffer.save(tmp_path / "episodes.npz")
    with (
        pytest.raises(BaselineError, match=r"tiny_worker has ended with code 1, see .*log: ValueError: no such layer"),
        tiny_process(tmp_path) as process,
    ):
        process.train(tmp_path / "episodes.npz", {"fail": "no such layer"}, 0, 50, None)


ENDLESS = """
import sys
from pathlib import Path
sys.path.append("studies")
from baselines.process import BaselineProcess
folder = Path(sys.argv[1])
with BaselineProcess(Path(sys.executable), "tests.studies.tiny_worker", folder / "log") as process:
    on_progress = lambda done, n_steps: print(done, flush=True)
    process.train(folder / "episodes.npz", {"learning_rate": 0.1}, 0, 10**9, None, on_progress)
"""


def test_a_killed_command_takes_its_baseline_along(tmp_path, buffer):
    buffer.save(tmp_path / "episodes.npz")
    with subprocess.Popen([sys.executable, "-c", ENDLESS, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert int(process.stdout.readline()) > 0, "it is training"
        process.kill()
    end = time.monotonic() + 20.0
    while "BrokenPipeError" not in (tmp_path / "log").read_text():
        assert time.monotonic() < end, "it goes on without anybody to tell"
        time.sleep(0.1)


def command_line(tmp_path: Path, datasets: Path, *more: str) -> list[str]:
    settings = tmp_path / "settings.yml"
    if not settings.exists():
        settings.write_text("linear: {worker: d3rlpy, n_timesteps: 20, settings: {learning_rate: 0.5}}\n")
    folders = ["-o", str(tmp_path / "rows"), "-f", str(tmp_path / "logs"), "--d3rlpy-python", sys.executable]
    line = ["--datasets", str(datasets), "--settings", str(settings), "--algo", "linear", "--seeds", "3"]
    return [*line, *folders, "--final-episodes", "3", "--n-eval-envs", "2", *more]


def test_a_finished_run_is_a_row_and_is_not_run_again(tmp_path, datasets, buffer, monkeypatch, capsys):
    monkeypatch.setitem(entries.WORKERS, "d3rlpy", TINY)
    command.main(command_line(tmp_path, datasets))
    (file,) = (tmp_path / "rows").glob("*.jsonl")
    (row,) = read_rows(file)
    assert file.name == "Pendulum-v1_1_linear_seed3_authors_pendulum.jsonl"
    assert (row["step"], row["final"], row["settings"]["d3rlpy"]) == (20, True, {"learning_rate": 0.5})
    assert (row["settings"]["n_timesteps"], row["settings"]["minutes"]) == (20, 1.0)
    assert row["data"]["n_steps"] == len(buffer)
    assert row["action_ms"] > 0.0
    assert "baseline's numpy" in row["versions"]

    # The same initial states as ours: an episode by hand, with the same actions.
    vec_env = make_seeded_envs("Pendulum-v1", entries.read_entries(datasets, entries.Data)["pendulum"].settings(), 1)
    assert evaluate(Counting(), vec_env, range(FINAL_STATES, FINAL_STATES + 3)).returns == pytest.approx(row["returns"])

    before = file.read_text()
    command.main(command_line(tmp_path, datasets))
    assert "finished already" in capsys.readouterr().out
    assert file.read_text() == before
    with pytest.raises(UsageError, match=r"is there with another minutes"):
        command.main(command_line(tmp_path, datasets, "--minutes", "2"))


def test_the_table_has_a_line_for_each_dataset_and_algorithm_and_tells_the_best(tmp_path, datasets, monkeypatch):
    monkeypatch.setitem(entries.WORKERS, "d3rlpy", TINY)
    command.main(command_line(tmp_path, datasets))
    (row,) = read_rows(next((tmp_path / "rows").glob("*.jsonl")))
    (tmp_path / "made").mkdir()
    made = [("door-mixed", "bc", 0, 10.0), ("door-mixed", "bc", 1, 30.0), ("door-mixed-longer", "bc", 0, 2000.0)]
    made += [("walker2d-mediocre-noisy", "bc", 0, 5.0), ("walker2d-mediocre-noisy", "dtfm", 0, 4.0)]
    for number, (label, algo, seed, each) in enumerate(made):
        changed = {"label": label, "algo": algo, "seed": seed, "returns": [each] * 3, "action_ms": 0.5}
        changed["task"] = "AdroitHandDoorPublished-v1" if label.startswith("door-mixed") else "Walker2d-v5"
        write_row(tmp_path / "made" / f"{number}.jsonl", {**row, **changed})
    header, *lines = table.long_table(tmp_path / "made")
    assert header[:5] == ("data", "algorithm", "seeds", "final", "each seed")
    assert [line[:5] for line in lines] == [
        ("walker2d-mediocre-noisy", "dtfm", "0", "4 (1 seed)", "4"),
        ("walker2d-mediocre-noisy", "bc", "0", "5 (1 seed)", "5"),
        # 20 and Student's t: 12.706 * 14.142 / sqrt(2).
        ("door-mixed", "bc", "0, 1", "20 [-107, 147]", "10; 30"),
        ("door-mixed", "bc, longer", "0", "2,000 (1 seed)", "2,000"),
    ]
    (tmp_path / "suite").mkdir()
    for seed, each in enumerate((40.0, 60.0)):
        ours = {"task": "door-mixed", "algo": "dtfm", "label": "", "profile": "default", "seed": seed, "returns": [each] * 3}
        write_row(tmp_path / "suite" / f"{seed}.jsonl", {**row, **ours})
    assert list(table.suite_table(tmp_path / "made", tmp_path / "suite")) == [
        ("data", "DT", "DTFM", "bc", "bc, longer"),
        ("door-mixed", "-", "50 [-77, 177]", "20", "2,000 (1 seed)"),  # the best of the others has its interval
    ]


def test_a_search_changes_settings_and_names_its_rows(tmp_path, datasets, monkeypatch):
    monkeypatch.setitem(entries.WORKERS, "d3rlpy", TINY)
    command.main(command_line(tmp_path, datasets, "--label", "slow", "-params", "learning_rate:0.1", "best_share:0.4"))
    (file,) = (tmp_path / "rows").glob("*.jsonl")
    (row,) = read_rows(file)
    assert (file.stem, row["label"]) == ("Pendulum-v1_1_linear_seed3_authors_pendulum-slow", "pendulum-slow")
    assert row["settings"]["d3rlpy"] == {"learning_rate": 0.1}
    assert row["settings"]["best_share"] == 0.4
    assert OTHERS["bc"].changed({"hidden": [8]}).settings["hidden"] == [512] * 3, "the other rows' settings stay"


@pytest.mark.slow
def test_ours_take_the_steps_that_are_asked_for(tmp_path, datasets):
    command.main(command_line(tmp_path, datasets, "--algo", "dt", "--steps", "3"))
    (file,) = (tmp_path / "rows").glob("*.jsonl")
    assert [(row["algo"], row["step"]) for row in read_rows(file) if row.get("final")] == [("dt", 3)]


class Counting:
    """Acts as the tiny worker does in a space of one action: by how long the episode has been."""

    def __init__(self) -> None:
        self.seen = 0

    def predict(self, observations: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
        self.seen = 1 if episode_start[0] else self.seen + 1
        return np.array([[2 * self.seen / 1000]], np.float32), None


def test_a_failing_run_leaves_no_row_and_does_not_stop_the_others(tmp_path, datasets, monkeypatch, capsys):
    monkeypatch.setitem(entries.WORKERS, "d3rlpy", TINY)
    linear = "{worker: d3rlpy, n_timesteps: 5, settings: {learning_rate: 0.5}}"
    broken = "{worker: d3rlpy, n_timesteps: 5, settings: {fail: on purpose}}"
    (tmp_path / "settings.yml").write_text(f"broken: {broken}\nlinear: {linear}\n")
    with pytest.raises(SystemExit) as end:
        command.main(command_line(tmp_path, datasets, "--algo", "broken", "linear"))
    assert end.value.code == 1
    assert [row.name.split("_")[2] for row in (tmp_path / "rows").glob("*.jsonl")] == ["linear"]
    assert "FAILED" in (said := capsys.readouterr().out)
    assert "on purpose" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "moon"), r"--data: unknown moon; known are pendulum"),
        (("--algo", "moon"), r"--algo: unknown moon; known are dt, dtfm, linear"),
        (("--steps", "0"), r"--steps: must be more than 0, got 0"),
        (("-params", "learning_rate:0.1"), r"-params: needs --label"),
        (("--label", "a", "-params", "rate:0.1"), r"-params: linear has no rate; it has best_share, learning_rate"),
        (("--d3rlpy-python", "nowhere/python"), r"nowhere/python does not exist; `make baselines` installs it"),
    ],
)
def test_a_mistake_is_named_before_anything_runs(tmp_path, datasets, arguments, message):
    with pytest.raises(UsageError, match=message):
        command.main(command_line(tmp_path, datasets, *arguments))
    assert not (tmp_path / "rows").exists()


def test_a_dataset_that_is_missing_is_named_with_where_its_recipe_is(tmp_path, datasets):
    (tmp_path / "pendulum.npz").unlink()
    with pytest.raises(UsageError, match=r"pendulum: .*pendulum.npz.* studies/baselines.yml says how to record it"):
        command.main(command_line(tmp_path, datasets))


def test_every_dataset_of_the_comparison_is_a_task_with_settings_for_us_and_for_its_baselines():
    register_gymnasium_robotics()
    for name, data in entries.read_entries(ROOT / "studies" / "baselines.yml", entries.Data).items():
        assert data.kind in entries.KINDS, name
        assert data.baselines.keys() <= OTHERS.keys(), name
        assert data.settings()["env_wrapper"], name
        if data.task != "PushT-v0":
            for package in data.gym_packages:
                importlib.import_module(package)
            gym.spec(data.task)
    for baseline in OTHERS.values():
        assert baseline.worker in entries.WORKERS
        assert {*baseline.only, *baseline.kinds} <= set(entries.KINDS)
    assert not set(OTHERS) & set(ALGORITHMS)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), SETTINGS)
def test_a_baseline_trains_and_acts(tmp_path, datasets, name, kind):
    worker = OTHERS[name].worker
    if not (python := PYTHONS[worker]).exists():
        pytest.skip(f"{python} does not exist; `make baselines` installs it")
    datasets.write_text(datasets.read_text().replace("kind: manipulation", f"kind: {kind}"))
    line = ["--datasets", str(datasets), "--algo", name, "--seeds", "0", "--steps", "12", "--n-eval-envs", "2"]
    line += ["--final-episodes", "3", "-o", str(tmp_path / "rows"), "-f", str(tmp_path), f"--{worker}-python", str(python)]
    command.main(line)
    (file,) = (tmp_path / "rows").glob("*.jsonl")
    (row,) = read_rows(file)
    assert (row["algo"], row["step"], row["lengths"]) == (name, 12, [200] * 3)
    assert f"baseline's {worker}" in row["versions"]


@pytest.mark.slow
def test_d3rlpy_and_ours_read_the_same_of_a_file(tmp_path, buffer):
    """BC learns the map by heart that the episodes were made with, through scaling and standardising and back."""
    if not PYTHONS["d3rlpy"].exists():
        pytest.skip("`make baselines` installs d3rlpy")
    buffer.save(tmp_path / "episodes.npz")
    settings = OTHERS["bc"].settings | {"hidden": [64, 64]}
    steps = load_dataset(tmp_path / "episodes.npz")
    observations, actions = (getattr(steps, name).numpy() for name in ("observations", "actions"))
    with BaselineProcess(PYTHONS["d3rlpy"], entries.WORKERS["d3rlpy"], tmp_path / "log") as process:
        process.train(tmp_path / "episodes.npz", settings, 0, 500, None)
        n = len(observations)
        found, _ = process.predict({"observation": observations, "return_to_go": np.zeros((n, 1))}, None, np.ones(n, bool))
    assert np.abs(found - actions).mean() < 0.1


IN_BOTH = table.compared(ROOT / "results" / "baselines.csv", ROOT / "results" / "suite.csv")[1]


def test_the_picture_shows_all_rows(tmp_path, monkeypatch):
    drawn = []
    plot = Axes.plot
    monkeypatch.setattr(Axes, "plot", lambda self, x, y, *a, **k: drawn.extend(x) or plot(self, x, y, *a, **k))
    results = ROOT / "results" / "baselines.csv", ROOT / "results" / "suite.csv"
    figure.plot(*results, tmp_path / "baselines.png")
    assert (tmp_path / "baselines.png").stat().st_size > 10_000
    _, *lines = table.suite_table(*results)
    assert len(drawn) == sum(cell != table.NONE for _, *cells in lines for cell in cells)
    assert min(drawn) >= 0
    assert max(drawn) == 1


def test_the_page_shows_the_defaults_beside_the_other_libraries():
    header, *lines = table.suite_table(ROOT / "results" / "baselines.csv", ROOT / "results" / "suite.csv")
    page = (ROOT / "docs" / "studies" / "baselines.md").read_text()
    assert len(lines) >= 8
    for line in (header, *lines):
        assert f"\n| {' | '.join(line)} |" in page


# Rows of the others count the steps of the whole file: of can-10 200 demonstrations, of door-human beyond the time limit.
# A seed of can-dropped has another recording, which is 12 steps longer.
@pytest.mark.parametrize("name", [name for name in IN_BOTH if name not in ("can-10", "can-dropped", "door-human")])
def test_what_is_compared_has_learned_from_one_recording(name):
    grouped, _, algorithms = table.compared(ROOT / "results" / "baselines.csv", ROOT / "results" / "suite.csv")
    data = [run.final["data"] for algo in algorithms for run in grouped.get((name, algo), ())]
    assert len(data) >= 6
    assert len({(each["n_episodes"], each["n_steps"], round(each["mean_return"], 1)) for each in data}) == 1


@pytest.mark.parametrize("name", ["baselines", "baselines-search", "context", "door"])
def test_a_mixed_door_has_one_reward(name):
    """Data of people have their authors' reward; the agent's beside them and the environment have it, too."""
    (rows,) = read_results([ROOT / "results" / f"{name}.csv"]).values()
    mixed = [row for row in rows if row["label"].startswith("door-mixed") or row["task"] == "door-mixed"]
    assert {row.get("env_id") or row["task"] for row in mixed} <= {"AdroitHandDoorPublished-v1"}
    assert mixed or name in ("context", "door")
