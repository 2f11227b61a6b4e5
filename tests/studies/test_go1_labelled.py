"""Recordings of the Go1 whose actions are the teacher's, whoever acts."""

import minari
import numpy as np
import pytest
from go1 import labelled

from sb3_dtfm import DTFM
from tests.recording.test_onnx_agent import write_linear


@pytest.mark.parametrize("student", [False, True])
def test_actions_are_what_the_teacher_would_do_and_the_robot_feels_those_carried_out(tmp_path, monkeypatch, student):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    weights = np.zeros((48, 12), np.float32)
    weights[45:] = 0.3  # it heeds the command alone
    teacher = write_linear(tmp_path / "teacher.onnx", weights)
    arguments = ["go1/labelled-v0", "--onnx", str(teacher), "--episodes", "3"]
    if student:
        rng = np.random.default_rng(0)
        episode = {"observations": rng.normal(size=(9, 45)), "actions": rng.uniform(-1, 1, (9, 12)), "rewards": np.ones(9)}
        DTFM("MultiInputPolicy", dataset=[episode] * 2, context_length=3, batch_size=4, seed=0).save(
            tmp_path / "student.zip"
        )
        arguments += ["--student", str(tmp_path / "student.zip"), "--drag"]
    monkeypatch.setattr(labelled, "N_ENVS", 2)
    monkeypatch.setattr("sys.argv", ["labelled", *arguments, "--noise", "0.5"])
    labelled.main()
    dataset = minari.load_dataset("go1/labelled-v0")
    assert dataset.total_episodes == 3
    for episode in dataset:
        observations, carried_out = episode.observations[:-1], episode.observations[1:, 30:42]
        told = np.clip(0.3 * observations[:, -3:].sum(axis=1, keepdims=True), -1.0, 1.0) * np.ones(12)
        np.testing.assert_allclose(episode.actions, told, rtol=1e-4, atol=1e-5)
        assert np.abs(carried_out - episode.actions).mean() > 0.1
