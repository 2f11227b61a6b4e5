"""The study of contexts on the Go1: errors and falls of states set by hand, and rows that are not made twice."""

import gymnasium as gym
import numpy as np
from go1.contexts import Tracking, append, judge, missing, simulations

from sb3_dtfm.envs.go1 import ENV_ID, EPISODE_STEPS
from sb3_dtfm.envs.go1.env import TeacherObservation
from sb3_dtfm.recording.onnx_agent import OnnxAgent
from tests.recording.test_onnx_agent import write_linear


def test_errors_are_distances_from_the_command_that_held():
    env = Tracking(gym.make(ENV_ID, randomize=False, max_episode_steps=20))
    env.reset(seed=0, options={"command": (0.3, -0.4, 0.5)})
    velocities, truncated = [], False
    while not truncated:
        *_, truncated, info = env.step(np.zeros(12, np.float32))
        env.unwrapped.command = np.array([0.3, -0.4, 0.5])
        velocities.append(info["velocity"])
    off = np.array(velocities) - (0.3, -0.4, 0.5)
    expected = [np.hypot(off[:, 0], off[:, 1]).mean(), np.abs(off[:, 2]).mean()]
    np.testing.assert_allclose(env.errors, [expected])
    env.reset(seed=1)
    assert len(env.errors) == 1


def test_a_teacher_that_stands_does_not_fall_and_one_that_kicks_does(tmp_path):
    """It is far from its commands, too."""
    standing = OnnxAgent(write_linear(tmp_path / "stand.onnx", np.zeros((48, 12), np.float32)))
    row = judge(standing, {"randomize": False}, [TeacherObservation], 2)
    assert (row["episodes"], row["falls"]) == (2, 0)
    assert row["error"] > 0.1
    kicking = OnnxAgent(write_linear(tmp_path / "kick.onnx", np.full((48, 12), 5.0, np.float32)))
    row = judge(kicking, {}, [TeacherObservation], 2)
    assert row["falls"] == 2
    assert EPISODE_STEPS == 1000


def test_a_simulation_with_rows_of_enough_episodes_is_not_missing(tmp_path):
    cell, named = {"algo": "dt", "label": "", "context_length": 5, "seed": 0}, simulations("go1.xml")
    counts = dict.fromkeys(named, 10)
    path = tmp_path / "rows.jsonl"
    assert missing(path, cell, named, counts) == named
    append(path, {**cell, "simulation": "ours", "episodes": 10})
    append(path, {**cell, "simulation": "second", "episodes": 9})
    append(path, {**cell, "seed": 1, "simulation": "second randomised", "episodes": 10})
    assert list(missing(path, cell, named, counts)) == ["second", "second randomised"]
