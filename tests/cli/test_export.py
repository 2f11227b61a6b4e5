"""`sb3-dtfm export`, and the example that acts with what it writes."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO

from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from tests.algorithms.small import make_model
from tests.conftest import make_env

ort = pytest.importorskip("onnxruntime")
DEPLOY = Path(__file__).parents[2] / "examples" / "deploy.py"


@pytest.fixture(scope="module")
def exported(cheetah_buffer, tmp_path_factory):
    """A model as it acts, and its file, by way of the folder of a run."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "HalfCheetah-v5").mkdir()
    (folder / "HalfCheetah-v5" / "config.yml").touch()
    model = make_model(DTFM, cheetah_buffer, policy_kwargs={"chunk_size": 4, "n_action_steps": 1}).learn(5)
    model.save(folder / "HalfCheetah-v5.zip")
    ways = {"flow_steps": 2, "n_action_steps": 3}
    task = ["--env", "HalfCheetah-v5", "--target-return", "5"]
    acting = ["--acting", *(f"{key}:{value}" for key, value in ways.items())]
    assert main(["export", str(folder), *task, *acting, "--output", str(folder / "policy.onnx")]) == 0
    model.policy.set_acting(**ways)
    return model, folder / "policy.onnx"


def test_the_file_has_the_ways_of_acting_that_were_asked_for(exported):
    metadata = ort.InferenceSession(str(exported[1])).get_modelmeta().custom_metadata_map["sb3_dtfm"]
    settings = json.loads(metadata)
    wanted = {"env_id": "HalfCheetah-v5", "target_return": 5.0, "flow_steps": 2, "n_action_steps": 3}
    assert wanted.items() <= settings.items()


def test_the_example_acts_as_predict_does(exported):
    model, path = exported
    spec = importlib.util.spec_from_file_location("deploy", DEPLOY)
    deploy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(deploy)
    policy, env = deploy.Policy(str(path)), make_env()
    for episode in range(2):
        observation, _ = env.reset(seed=episode)
        truncated = False
        while not truncated:
            expected, _ = model.predict(observation, deterministic=True)
            found = policy.act(*(observation[key].squeeze() for key in ("observation", "return_to_go", "timestep")))
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
            observation, _, _, truncated, _ = env.step(expected)


def test_the_example_acts_without_torch_and_this_package(exported):
    script = f"""
import sys
sys.path.insert(0, {str(DEPLOY.parent)!r})
import numpy, deploy
policy = deploy.Policy({str(exported[1])!r})
for timestep in range(5):
    print(policy.act(numpy.zeros(17), 5.0, timestep))
assert not {{"torch", "sb3_dtfm"}} & set(sys.modules)
"""
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr


def test_the_example_plays_the_files_task(exported):
    command = [sys.executable, str(DEPLOY), str(exported[1]), "--episodes", "1"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.stdout.startswith("episode 0: 1000 steps, return "), process.stderr


def test_mistakes_end_in_a_line(exported, tmp_path, capsys):
    model = exported[1].parent
    PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(tmp_path / "ppo.zip")
    for arguments, message in [
        ([str(tmp_path / "none.zip")], "none.zip: No such file"),
        ([str(tmp_path)], "no folder of a run"),
        ([str(tmp_path / "ppo.zip")], "saved by another algorithm, one of stable_baselines3"),
        ([str(model), "--acting", "flow_solver:'warp'"], "flow_solver must be one of"),
        ([str(model), "-o", str(tmp_path / "ppo.zip" / "policy.onnx")], "policy.onnx: File exists"),
    ]:
        assert main(["export", *arguments]) == 2
        assert message in capsys.readouterr().err
