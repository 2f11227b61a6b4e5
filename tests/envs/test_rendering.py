"""A program that draws and does not close its environments ends without a word."""

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


@pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs EGL")
def test_environments_that_are_left_open_end_quietly():
    result = run_python(OPEN, MUJOCO_GL="egl")
    assert (result.returncode, result.stderr) == (0, "")
