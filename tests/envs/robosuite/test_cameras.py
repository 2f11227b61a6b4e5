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
"""


def test_recorded_images_are_the_observed_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = run_python(SEEN, MUJOCO_GL=BACKEND)
    keys = ["agentview_image", "robot0_eef_pos", "robot0_eef_quat", "robot0_eye_in_hand_image", "robot0_gripper_qpos"]
    below = "1 the cube lies below the arm"
    unknown = "cameras: there is no nowhere; accepted are frontview, birdvi"
    seen = ["agentview_image", "robot0_eye_in_hand_image"]
    told = "--env-kwargs cameras:['agentview', 'robot0_eye_in_hand'] camera_size:48"
    assert result.stdout.splitlines()[-5:] == [str(keys), told, " ".join(seen), below, unknown], result.stderr
