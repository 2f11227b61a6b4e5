"""The study of contexts on the Go1: errors and falls of states set by hand, and rows that are not made twice."""

import gymnasium as gym
import numpy as np
from go1.contexts import Tracking, append, hide_actions, judge, missing, simulations
from go1.report import Cell, draw, read_cells, write_table

from sb3_dtfm import DTFM
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
    along = np.sum(np.array(velocities)[:, :2] @ (0.3, -0.4))
    np.testing.assert_allclose(env.walked, [[along, len(velocities) * 0.25]], atol=1e-12)
    env.reset(seed=1)
    assert len(env.errors) == 1


def test_a_teacher_that_stands_does_not_fall_and_one_that_kicks_does(tmp_path):
    """It is far from its commands, too."""
    standing = OnnxAgent(write_linear(tmp_path / "stand.onnx", np.zeros((48, 12), np.float32)))
    row = judge(standing, {"randomize": False}, [TeacherObservation], 2)
    assert (row["episodes"], row["falls"]) == (2, 0)
    assert row["error"] > 0.1
    assert abs(row["speed_share"]) < 0.05, "it stands"
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


def test_a_model_with_hidden_actions_does_not_depend_on_them(tmp_path):
    rng = np.random.default_rng(0)
    episodes = [
        {"observations": rng.normal(size=(9, 45)), "actions": rng.uniform(-1, 1, (9, 12)), "rewards": np.ones(9)}
        for _ in range(3)
    ]
    model = DTFM("MultiInputPolicy", dataset=episodes, context_length=3, batch_size=4, seed=0, device="cpu")
    hide_actions(model, everywhere=True)
    model.learn(3)

    def act(actions):
        state = None
        for step, action in enumerate(actions):
            shown = np.linspace(-1, 1, 45, dtype=np.float32) + step
            shown[30:42] = action
            observation = {"observation": shown[None], "return_to_go": [[5.0]], "timestep": [[step]]}
            observation = {key: np.asarray(value, np.float32) for key, value in observation.items()}
            observation["timestep"] = observation["timestep"].astype(np.int64)
            acted, state = model.predict(observation, state, np.array([step == 0]), deterministic=True)
            if step < 2:
                state = state._replace(actions=np.full_like(state.actions, action))
        return acted

    np.testing.assert_allclose(act([0.1, 0.2, 0.3]), act([-0.5, 0.9, 0.0]), atol=1e-6)
    plain = DTFM("MultiInputPolicy", dataset=episodes, context_length=3, batch_size=4, seed=0, device="cpu")
    plain.learn(3)
    model = plain
    assert not np.allclose(act([0.1, 0.2, 0.3]), act([-0.5, 0.9, 0.0]), atol=1e-6)


def test_seeds_are_pooled_and_the_row_with_more_episodes_counts(tmp_path):
    row = {"algo": "dtfm", "label": "", "context_length": 20, "simulation": "ours", "turn_error": 0.1, "settings": {"a": 1}}
    rows = [
        {**row, "seed": 0, "episodes": 10, "falls": 9, "error": 0.9},
        {**row, "seed": 0, "episodes": 20, "falls": 1, "error": 0.2},
        {**row, "seed": 1, "episodes": 20, "falls": 2, "error": 0.4},
    ]
    write_table(tmp_path / "go1.csv", rows)
    cells = read_cells(tmp_path / "go1.csv")
    assert cells == {("", "dtfm", 20): {"ours": Cell(40, 3, (0.2, 0.4), (0.1, 0.1))}}
    draw(cells, "", tmp_path / "go1.png")
    assert (tmp_path / "go1.png").stat().st_size > 1000
