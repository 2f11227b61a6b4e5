"""Provenance of rows: commit, versions, hardware and data."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm.benchmark import provenance
from sb3_dtfm.data import DatasetError, load_dataset
from sb3_dtfm.envs import register_gymnasium_robotics
from tests.recorded import DATASET_ID


def write_demonstrations(path: Path, env_args: str | None) -> None:
    """Two demonstrations of three steps that succeed at the end."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if env_args is not None:
            data.attrs["env_args"] = env_args
        for i in range(2):
            demo = data.create_group(f"demo_{i}")
            demo["actions"] = np.zeros((3, 7))
            demo["rewards"] = np.array([0.0, 0.0, 1.0])
            demo["dones"] = np.array([0, 0, 1])
            for key, width in (("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2), ("object", 10)):
                demo[f"obs/{key}"] = np.random.default_rng(i).normal(size=(3, width))


def test_the_commit_is_that_of_the_sources_or_none():
    commit = provenance.commit()
    assert commit is None or re.fullmatch(r"[0-9a-f]{40}(-dirty)?", commit)


def test_sources_outside_of_git_have_no_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance.sb3_dtfm, "__file__", str(tmp_path / "__init__.py"))
    assert provenance.commit() is None
    monkeypatch.setenv("PATH", "")
    assert provenance.commit() is None, "without git"


def test_versions_and_hardware_fit_into_json():
    text = json.dumps([provenance.versions(), provenance.hardware(th.device("cpu"))])
    versions, hardware = json.loads(text)
    assert {"python", "torch", "stable-baselines3", "sb3-dtfm"} <= set(versions)
    assert hardware["gpu"] is None
    assert hardware["cores"] >= 1


def test_a_minari_dataset_names_its_agent(workplace):
    buffer = provenance.read_data("HalfCheetah-v5", {"dataset": DATASET_ID})
    data = provenance.describe_data(buffer, DATASET_ID)
    assert (data["dataset"], data["n_episodes"]) == (DATASET_ID, 3)
    assert data["recorded_from"].startswith("PPO: re-recorded from agent.zip: 3 episodes")
    assert data["n_steps"] == 3000
    assert provenance.describe_data(buffer, DATASET_ID, "an agent")["recorded_from"] == "an agent"


@pytest.mark.parametrize(
    ("env_args", "source"),
    [
        (json.dumps({"env_name": "Lift", "env_version": "1.5.2"}), "demonstrations of Lift, robosuite 1.5.2"),
        (json.dumps({"env_name": "Lift"}), "demonstrations of Lift"),
        (None, "demonstrations of a task not named"),
    ],
)
def test_a_robomimic_file_names_its_task_and_not_its_folder(env_args, source, tmp_path):
    write_demonstrations(tmp_path / "lift.hdf5", env_args)
    path = str(tmp_path / "lift.hdf5")
    assert provenance.describe_data(load_dataset(path), path) == {
        "dataset": "lift.hdf5", "recorded_from": source, "n_episodes": 2, "n_steps": 6, "mean_return": 1.0,
        "best_return": 1.0, "success_rate": 1.0, "best_success": 1.0,
    }  # fmt: skip


def test_choices_are_read_as_the_environment_has_them(tmp_path):
    """Flat arrays tell neither how many actions there are nor how many observations."""
    states, ends = np.array([36, 24, 25, 26]), np.array([4])
    np.savez(tmp_path / "cliff.npz", observations=states, actions=states % 4, rewards=-np.ones(4), episode_ends=ends)
    buffer = provenance.read_data("CliffWalking-v1", {"dataset": str(tmp_path / "cliff.npz")})
    assert buffer.action_space == spaces.Discrete(4)
    np.testing.assert_array_equal(buffer.observations.argmax(axis=1), states)
    assert buffer.observation_space.shape == (48,)


def test_a_wrapper_of_the_run_says_what_was_recorded(tmp_path):
    register_gymnasium_robotics()
    with h5py.File(tmp_path / "maze.hdf5", "w") as file:
        file["observations/observation"], file["episode_ends"] = np.ones((4, 4)), [4]
        file["actions"], file["rewards"] = np.zeros((4, 2)), np.zeros(4)
    settings = {"dataset": str(tmp_path / "maze.hdf5")}
    with pytest.raises(DatasetError, match="has no achieved_goal, desired_goal, which the environment observes"):
        provenance.read_data("PointMaze_UMaze-v3", settings)
    settings["env_wrapper"] = [{"gymnasium.wrappers.FilterObservation": {"filter_keys": ["observation"]}}]
    assert provenance.read_data("PointMaze_UMaze-v3", settings).observation_space.shape == (4,)


def test_a_dataset_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"nothing\.hdf5"):
        provenance.read_data("Pendulum-v1", {"dataset": str(tmp_path / "nothing.hdf5")})
