"""MuJoCo's renderers: a program that leaves them open ends without a word, one that cannot draw says how it could."""

import ctypes.util

import pytest

from tests.envs.robosuite.conftest import run_python

OPEN = """
import weakref
import gymnasium, sb3_dtfm.envs
weakref.finalize(gymnasium, print)  # those of others come first, or last
envs = [gymnasium.make("robosuite/Lift-v0", cameras=["agentview"], render_mode="rgb_array"),
        gymnasium.make("Go1Velocity-v0", render_mode="rgb_array")]
for env in envs:
    env.reset(seed=0)
    assert env.render().any()
"""

NO_DRIVER = """
import gymnasium, sb3_dtfm.envs
env = gymnasium.make("Go1Velocity-v0", render_mode="rgb_array")
env.reset(seed=0)
try:
    env.render()
except RuntimeError as error:
    print(error)
"""

pytestmark = pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs EGL")


def test_environments_that_are_left_open_end_quietly():
    result = run_python(OPEN, MUJOCO_GL="egl")
    assert (result.returncode, result.stderr) == (0, "")


def test_a_machine_that_cannot_draw_is_told_how_it_could():
    result = run_python(NO_DRIVER, MUJOCO_GL="egl", __EGL_VENDOR_LIBRARY_FILENAMES="/no/driver.json")
    assert result.stdout.startswith("MuJoCo cannot draw here (Cannot initialize a EGL device display.")
    assert "set MUJOCO_GL to egl or osmesa, and install its library (libegl1 or libosmesa6)." in result.stdout
