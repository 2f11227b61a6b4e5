"""Recording an agent that is an ONNX file."""

from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
import pytest

from sb3_dtfm.cli.main import main
from sb3_dtfm.recording.loading import find_wrapper
from sb3_dtfm.recording.onnx_agent import OnnxAgent

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
WEIGHTS = np.array([[0.5], [-1.0], [0.25]], np.float32)


def write_linear(path: Path, weights: np.ndarray = WEIGHTS, rows: int | str = "rows", n_inputs: int = 1) -> Path:
    """Observations times weights, and what further inputs add."""
    helper, n = onnx.helper, weights.shape
    names = [f"x{number}" for number in range(n_inputs)]
    inputs = [helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [rows, n[0]]) for name in names]
    output = helper.make_tensor_value_info("actions", onnx.TensorProto.FLOAT, [rows, n[1]])
    nodes = [helper.make_node("Sum", names, ["sum"]), helper.make_node("MatMul", ["sum", "weights"], ["actions"])]
    graph = helper.make_graph(nodes, "linear", inputs, [output], [onnx.numpy_helper.from_array(weights, "weights")])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return path


@pytest.fixture(autouse=True)
def datasets_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def record(model: Path, *arguments: str, env: str = "Pendulum-v1") -> int:
    options = ["--env", env, "--episodes", "3", "--n-envs", "2", "--dataset-id", "test/onnx-v0", *arguments]
    return main(["record", "--algo", "onnx", "--model", str(model), *options])


@pytest.mark.parametrize("rows", ["rows", 1])
def test_actions_are_those_of_the_file_for_any_number_of_rows(tmp_path, rows):
    agent = OnnxAgent(write_linear(tmp_path / "agent.onnx", rows=rows))
    observations = np.random.default_rng(0).normal(size=(5, 3))
    actions, state = agent.predict(observations)
    np.testing.assert_allclose(actions, observations @ WEIGHTS, rtol=1e-5, atol=1e-6)
    assert state is None


def test_a_file_is_recorded_with_actions_inside_their_space(tmp_path):
    assert record(write_linear(tmp_path / "agent.onnx", 4 * WEIGHTS), "--env-kwargs", "max_episode_steps:20") == 0
    dataset = minari.load_dataset("test/onnx-v0")
    for episode in dataset:
        expected = np.clip(episode.observations[:-1] @ (4 * WEIGHTS), -2.0, 2.0)
        np.testing.assert_allclose(episode.actions, expected, rtol=1e-4, atol=1e-5)
    assert dataset.total_steps == 60


def test_a_teacher_sees_more_than_what_is_recorded(tmp_path):
    """And the recorded seed and actions replay the episode to the bit."""
    pytest.importorskip("mujoco")
    weights = np.random.default_rng(0).normal(0.0, 0.05, (48, 12)).astype(np.float32)
    path = write_linear(tmp_path / "teacher.onnx", weights)
    wrapper = ["--env-wrapper", "sb3_dtfm.envs.go1.env.TeacherObservation", "--env-kwargs", "max_episode_steps:30"]
    assert record(path, *wrapper, env="Go1Velocity-v0") == 0
    dataset = minari.load_dataset("test/onnx-v0")
    env = gym.make("Go1Velocity-v0")
    for episode in dataset:
        assert episode.observations.shape[1] == 45
        (metadata,) = dataset.storage.get_episode_metadata([episode.id])
        observation, info = env.reset(seed=metadata["seed"])
        for step, action in enumerate(episode.actions):
            np.testing.assert_array_equal(observation, episode.observations[step])
            seen = np.concatenate((info["measured_velocity"], observation))
            np.testing.assert_allclose(action, np.clip(seen @ weights, -1.0, 1.0), atol=1e-5)
            observation, reward, *_, info = env.step(action)
            assert reward == episode.rewards[step]


def test_an_agent_of_another_observation_is_refused(tmp_path, capsys):
    path = write_linear(tmp_path / "agent.onnx", np.zeros((48, 12), np.float32))
    assert record(path, env="Go1Velocity-v0") == 2
    assert "agent.onnx was trained with observation_space Box(-inf, inf, (48,), float32), but" in capsys.readouterr().err


def test_a_file_that_is_no_policy_is_refused(tmp_path, capsys):
    assert record(write_linear(tmp_path / "two.onnx", n_inputs=2)) == 2
    assert "two.onnx must have one input (N, O) and an output (N, A), got x0 ['rows', 3], x1" in capsys.readouterr().err
    graph = onnx.load(write_linear(tmp_path / "ours.onnx"))
    graph.metadata_props.add(key="sb3_dtfm", value="{}")
    onnx.save(graph, tmp_path / "ours.onnx")
    assert record(tmp_path / "ours.onnx") == 2
    assert "ours.onnx was exported by sb3-dtfm: name the run of the model that was exported" in capsys.readouterr().err
    (tmp_path / "text.onnx").write_text("no graph")
    assert record(tmp_path / "text.onnx") == 2
    assert "text.onnx is no ONNX file that can be run" in capsys.readouterr().err
    assert record(write_linear(tmp_path / "agent.onnx"), "--stochastic") == 2
    assert "cannot be sampled (--stochastic)" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["Scaled", "no_module.Scaled", "gymnasium.wrappers.NoWrapper"])
def test_a_wrapper_that_is_not_there_is_named(name):
    with pytest.raises(ValueError, match=f"env_wrapper must be a class with its module.*got {name!r}"):
        find_wrapper(name)
