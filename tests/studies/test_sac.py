"""SAC beside fine-tuning."""

import sys

import numpy as np
import pytest
import sac
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_dtfm.benchmark.rows import RunKey, read_rows, write_row
from sb3_dtfm.data import Trajectory, TrajectoryBuffer


def test_recorded_steps_lie_in_the_replay_buffer():
    """An episode of four steps ends, one of three is truncated, so that its last step has no next observation."""
    envs = make_vec_env("MountainCarContinuous-v0", 2)
    agent = SAC("MlpPolicy", envs, buffer_size=100)
    observations = np.arange(14, dtype=np.float32).reshape(7, 2)
    rewards = np.arange(7.0)
    actions = np.linspace(-1, 1, 7)[:, None]
    recorded = TrajectoryBuffer.from_trajectories(
        [
            Trajectory(observations[:4], actions[:4], rewards[:4], terminated=True),
            Trajectory(observations[4:], actions[4:], rewards[4:], truncated=True),
        ],
        spaces.Box(-1.0, 1.0, (1,)),
    )
    assert sac.fill(agent.replay_buffer, recorded, agent) == 6
    replay = agent.replay_buffer
    np.testing.assert_array_equal(replay.rewards[:3].ravel(), rewards[:6])
    np.testing.assert_array_equal(replay.dones[:3].ravel(), [0, 0, 0, 1, 0, 0])
    np.testing.assert_allclose(replay.actions[:3].ravel(), actions[:6, 0], rtol=1e-6)
    after = replay.next_observations[:3].reshape(6, 2)[[0, 1, 2, 4, 5]]
    np.testing.assert_array_equal(after, observations[[1, 2, 3, 5, 6]])


@pytest.mark.slow
def test_a_run_is_evaluated(tmp_path, monkeypatch):
    key = RunKey("Pendulum-v1", 1.0, "dtfm", 3, "tiny")
    about = dict(
        settings={"dataset": "none"}, data={}, flow_solver="euler", flow_steps=1, commit=None, versions={}, hardware={}
    )
    episodes = dict(returns=[0.0], lengths=[200], successes=None, step=0, final=True, wall_s=0.0, steps_per_s=0.0)
    write_row(tmp_path / "like.jsonl", {**key._asdict(), **about, **episodes})
    monkeypatch.setattr(sac, "N_FINAL_EPISODES", 4)
    arguments = ["--like", str(tmp_path / "like.jsonl"), "-n", "40", "--eval-freq", "20", "--eval-episodes", "2"]
    monkeypatch.setattr(sys, "argv", ["sac.py", *arguments, "--output", str(tmp_path / "rows")])
    sac.main()
    (file,) = (tmp_path / "rows").glob("*_sac.jsonl")
    rows = read_rows(file)
    assert [(row["step"], row["final"], len(row["returns"])) for row in rows] == [
        (0, False, 2),
        (20, False, 2),
        (40, False, 2),
        (40, True, 4),
    ]
    assert {(row["algo"], row["seed"], row["label"]) for row in rows} == {("sac", 3, "sac")}
    monkeypatch.setattr(sys, "argv", ["sac.py", *arguments, "--output", str(tmp_path / "rows"), "-n", "45"])
    with pytest.raises(SystemExit):
        sac.main()
    assert len(read_rows(file)) == 4
