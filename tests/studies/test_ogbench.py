"""OGBench's data sets recorded anew: a kill loses a part at most, and ours learn from the transitions that others have."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch as th
from grasps import Counts, count
from play import is_visible, join, load, record
from relabel import flat

from sb3_dtfm.data import load_dataset

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".venv-ogbench" / "bin" / "python"


def play(masks: list[float], rewards: list[float]) -> dict[str, np.ndarray]:
    """Two `play` episodes of four steps, whose observations and actions are the number of the step."""
    steps = np.arange(8.0)[:, None]
    return {
        "observations": np.repeat(steps, 3, axis=1), "actions": np.repeat(steps / 10, 2, axis=1),
        "terminals": np.arange(8) % 4 == 3, "masks": np.array(masks), "rewards": np.array(rewards),
    }  # fmt: skip


def test_solved_steps_are_terminal_and_the_last_step_gives_no_transition(tmp_path):
    arrays = play([1, 0, 0, 1, 1, 1, 1, 0], [-1, 0, 0, -2, -1, -1, -1, 0])
    np.savez(tmp_path / "task1.npz", **flat(arrays, "cube-single-singletask-task1-v0"))
    buffer = load_dataset(tmp_path / "task1.npz")
    assert buffer.env_id == "cube-single-singletask-task1-v0"
    np.testing.assert_array_equal(buffer.episode_lengths, [2, 1, 1, 4])
    np.testing.assert_array_equal(buffer.episodes.terminated, [True, True, False, True])
    np.testing.assert_array_equal(buffer.episodes.truncated, [False, False, True, False])
    np.testing.assert_array_equal(buffer.successes, [1, 1, 0, 1])
    np.testing.assert_array_equal(buffer.rewards, arrays["rewards"])
    # Observation, reward and mask of OGBench's transitions, and of a play episode's last step if it solves the task.
    found = buffer.transitions(th.arange(8), 1, 0.5)
    told = [
        (each[0].item(), reward.item(), discount.item() / 0.5)
        for each, reward, discount, mask in zip(found.observations, found.rewards, found.discounts, found.mask, strict=True)
        if mask
    ]
    assert told == [(0, -1, 1), (1, 0, 0), (2, 0, 0), (4, -1, 1), (5, -1, 1), (6, -1, 1), (7, 0, 0)]


def test_grasps_are_counted_when_they_begin():
    # Up, down at the cube for two steps, lifting it, and down elsewhere twice.
    grippers = np.array([[0, 0, 0.2], [0, 0, 0.02], [0, 0, 0.02], [0, 0, 0.1], [0.2, 0, 0.03], [0, 0, 0.2], [0.1, 0, 0.02]])
    cubes = np.array([[0, 0, 0.02]] * 3 + [[0, 0, 0.1]] + [[0, 0, 0.02]] * 3)
    assert count(grippers[:, None], cubes[:, None]) == Counts(at_cube=1, elsewhere=2, lifts=1)
    grippers, cubes = (np.stack([each, each[::-1]], axis=1) for each in (grippers, cubes))
    # Backwards, the second episode begins down elsewhere, which is no beginning.
    assert count(grippers, cubes) == Counts(at_cube=2, elsewhere=3, lifts=2)


@pytest.mark.parametrize(
    ("y", "z", "seen"), [(0.28, 0.02, True), (0.29, 0.02, False), (-0.31, 0.07, True), (-0.31, 0.02, False)]
)
def test_a_cube_out_of_sight_is_noticed_but_not_in_the_drawer(y, z, seen):
    qpos = np.zeros((5, 25))
    qpos[3, 15:17] = y, z
    assert is_visible(qpos) == seen


def test_a_recording_that_is_stopped_goes_on_with_the_part_that_it_lost(tmp_path):
    recorded, stopped_at = [], [5]

    def episode(number: int) -> dict[str, np.ndarray]:
        if number in stopped_at:
            raise KeyboardInterrupt
        recorded.append(number)
        return {"actions": np.full((2, 1), number), "n_targets": np.array(number)}

    with pytest.raises(KeyboardInterrupt):
        record(episode, 7, 3, tmp_path)
    stopped_at.clear()
    paths = record(episode, 7, 3, tmp_path)
    assert recorded == [0, 1, 2, 3, 4, 3, 4, 5, 6]
    found = join([load(path) for path in paths])
    np.testing.assert_array_equal(found["actions"][:, 0], np.repeat(np.arange(7), 2))
    assert found["n_targets"] == sum(range(7))


def in_its_environment(code: str, folder: Path) -> None:
    environment = {**os.environ, "MUJOCO_GL": "disabled", "PYTHONPATH": str(ROOT / "studies" / "ogbench")}
    subprocess.run([str(PYTHON), "-c", code], check=True, env=environment, cwd=folder)


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="make ogbench installs it")
def test_episodes_have_the_published_sizes_and_depend_on_their_numbers_alone(tmp_path):
    code = """
from pathlib import Path
import numpy as np
from play import Recorder, save
for task in ("cube-single", "scene", "puzzle-3x3", "cube-double"):
    recorder = Recorder(task, 0)
    for number in (1, 0):
        save(Path(f"{task}-{number}.npz"), recorder.episode(number))
    again = recorder.episode(1)
    assert all(np.array_equal(again[name], array) for name, array in np.load(f"{task}-1.npz").items()), task
"""
    in_its_environment(code, tmp_path)
    for task, size in {"cube-single": 28, "scene": 40, "puzzle-3x3": 55, "cube-double": 37}.items():
        first, second = (load(tmp_path / f"{task}-{number}.npz") for number in (0, 1))
        assert first["observations"].shape == (1001, size)
        assert first["actions"].shape == (1001, 5)
        assert np.abs(first["actions"]).max() <= 1
        np.testing.assert_array_equal(np.flatnonzero(first["terminals"]), [1000])
        assert first["n_reached"] >= 5
        assert not np.array_equal(first["qpos"], second["qpos"])


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="make ogbench installs it")
def test_transitions_are_those_of_ogbench_s_own_reader(tmp_path):
    """The cube of an episode stays at the goal of task 1 for a while."""
    code = """
import sys
import gymnasium as gym
import numpy as np
from ogbench.relabel_utils import relabel_dataset
from ogbench.utils import load_dataset
import play, relabel
sys.argv = ["play.py", "cube-single", "play.npz", "--episodes", "2"]
play.main()
arrays = play.load(play.Path("play.npz"))
arrays["qpos"][500:600, 14:17] = 0.425, -0.1, 0.02
play.save(play.Path("play.npz"), arrays)
sys.argv = ["relabel.py", "cube-single", "play.npz", "--tasks", "1"]
relabel.main()
theirs = load_dataset("play.npz", add_info=True)
env_id = "cube-single-singletask-task1-v0"
relabel_dataset(env_id, gym.make(env_id), theirs)
np.savez("theirs.npz", **theirs)
"""
    in_its_environment(code, tmp_path)
    theirs = load(tmp_path / "theirs.npz")
    buffer = load_dataset(tmp_path / "cube-single-play-task1-v0.npz")
    rows = th.from_numpy(np.setdiff1d(np.arange(2002), (1000, 2001)))  # theirs leave out the last steps
    ours = buffer.transitions(rows, 1, 0.5)
    assert ours.mask.all()
    for found, name in ((ours.observations, "observations"), (ours.actions, "actions"), (ours.rewards, "rewards")):
        np.testing.assert_array_equal(found, theirs[name])
    np.testing.assert_array_equal(ours.discounts, 0.5 * theirs["masks"])
    counts = theirs["masks"] == 1
    assert counts.sum() <= 1900
    np.testing.assert_array_equal(ours.next_observations[counts], theirs["next_observations"][counts])
