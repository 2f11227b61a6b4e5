"""Recorded images are the observed ones, pixel by pixel, upright, and beside the arm's own numbers."""

import ctypes.util

import pytest

from tests.envs.robosuite.conftest import run_python

BACKEND = next((name for library, name in (("EGL", "egl"), ("OSMesa", "osmesa")) if ctypes.util.find_library(library)), None)
pytestmark = pytest.mark.skipif(BACKEND is None, reason="needs EGL or OSMesa")

SEEN = """
import shlex
import gymnasium, h5py, mujoco, numpy as np, sb3_dtfm.envs
from sb3_dtfm.cli.inspect import command, load
from sb3_dtfm.data import load_dataset
from sb3_dtfm.data.inspection import inspect_buffer
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.cli.main import main
cameras = ["agentview", "robot0_eye_in_hand"]
assert not main(["record", "--demonstrator", "lift", "--camera", *cameras, "--camera-size", "48", "--episodes", "2",
                 "--output", "lift.hdf5"])
env = gymnasium.make("robosuite/Lift-v0", cameras=cameras, camera_size=48)
flags = env.unwrapped._cameras._renderer.scene.flags
assert not any(flags[flag] for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION))
keys = ["agentview_image", "robot0_eye_in_hand_image", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
print(list(env.observation_space))
buffer = load_dataset("lift.hdf5", observation_keys=keys)
print(*shlex.split(command(["lift.hdf5"], [], [], buffer, inspect_buffer(buffer)))[-3:])
shown = {"cameras": cameras, "camera_size": 48}
print(*load("lift.hdf5", {"observation_keys": keys}, "robosuite/Lift-v0", shown).image_spaces)
wrapped = ReturnToGoWrapper(env, 1.0)
with h5py.File("lift.hdf5") as file:
    demo = file["data/demo_0"]
    for step in (0, 20):
        options = {"state": demo["states"][step], "model_file": demo.attrs["model_file"]}
        seen, _ = wrapped.reset(options=options)
        for key in keys[:2]:
            assert np.array_equal(seen[key], buffer.own(key)[step].numpy()), (key, step)
        np.testing.assert_allclose(seen["observation"], buffer.observations[step].numpy(), atol=1e-6)
first = buffer.own(keys[0])[0].float().numpy()
red = first[..., 0] - first[..., 1:].mean(axis=2)
print(int(np.argmax(red.max(axis=1)) > 16), "the cube lies below the arm")
try:
    gymnasium.make("robosuite/Lift-v0", cameras=["nowhere"])
except ValueError as error:
    print(str(error)[:60])
wrapped.close()

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark import evaluation
from sb3_dtfm.envs.cameras import ImagesOnDemand
from sb3_dtfm.envs.robosuite.cameras import Cameras
settings = {"env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}],
            "env_kwargs": {"cameras": cameras, "camera_size": 48, "horizon": 10}}
envs = evaluation.make_seeded_envs("robosuite/Lift-v0", settings, 2)
policy_kwargs = {"chunk_size": 8, "n_action_steps": 4}
model = DTFM("MultiInputPolicy", envs, "lift.hdf5", dataset_kwargs={"observation_keys": keys}, policy_kwargs=policy_kwargs)
predict, draw, choose = model.predict, Cameras.__call__, ImagesOnDemand.draw
for images in ("all", "needed"):
    acted, drawn = [], []
    def predict_and_tell(*args, **kwargs):
        actions, state = predict(*args, **kwargs)
        acted.append(actions)
        return actions, state
    def draw_and_tell(self, data):
        drawn.append(1)
        return draw(self, data)
    model.predict, Cameras.__call__ = predict_and_tell, draw_and_tell
    ImagesOnDemand.draw = choose if images == "needed" else lambda self, wanted: None
    episodes = evaluation.evaluate(model, envs, [3, 4, 5])
    print(images, len(drawn), episodes.lengths, hash(np.stack(acted).tobytes()))
envs.close()
"""


def test_recorded_images_are_the_observed_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run_python(SEEN, MUJOCO_GL=BACKEND)
    keys = ["agentview_image", "robot0_eef_pos", "robot0_eef_quat", "robot0_eye_in_hand_image", "robot0_gripper_qpos"]
    below = "1 the cube lies below the arm"
    unknown = "cameras: there is no nowhere; accepted are frontview, birdvi"
    seen = ["agentview_image", "robot0_eye_in_hand_image"]
    told = "--env-kwargs cameras:['agentview', 'robot0_eye_in_hand'] camera_size:48"
    lines = result.stdout.splitlines()
    assert lines[-7:-2] == [str(keys), told, " ".join(seen), below, unknown], result.stderr
    every, needed = (line.split(" ", 2) for line in lines[-2:])
    assert every[2] == needed[2]
    # Of three episodes their starts, and ten steps each or the two that new chunks begin with; two look for seeds.
    assert (int(every[1]), int(needed[1])) == (3 + 3 * 10 + 2, 3 + 3 * 2)
