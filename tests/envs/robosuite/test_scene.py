"""robosuite itself: how it is imported, and what an episode changes in a compiled scene."""

import sys

import mujoco
import numpy as np
import pytest

from sb3_dtfm.envs.robosuite import RobosuiteEnv
from sb3_dtfm.envs.robosuite.scene import set_cube_size
from tests.envs.robosuite.conftest import rollout, run_python


def test_resized_cube_equals_a_compiled_one(lift):
    size = np.array([0.0203, 0.0217, 0.0209])
    set_cube_size(lift._env, size)
    resized = lift._env.sim.model._model
    compiled = mujoco.MjModel.from_xml_string(lift._env.edit_model_xml(lift.model_file))
    for name in ("geom_size", "geom_rbound", "geom_aabb", "bvh_aabb", "body_mass", "body_inertia", "body_subtreemass"):
        np.testing.assert_allclose(getattr(resized, name), getattr(compiled, name), rtol=1e-12, err_msg=name)
    for name in ("body_invweight0", "dof_invweight0", "dof_M0", "dof_length"):
        np.testing.assert_allclose(getattr(resized, name), getattr(compiled, name), rtol=1e-9, err_msg=name)


def test_scene_of_a_recording_comes_with_its_model_file(environment):
    """The size of Lift's cube, the place of the door and of the dirt are no part of a state."""
    for task in ("Lift", "Door", "Wipe"):
        env = environment(task)
        first = rollout(env, seed=41)
        env.reset(seed=41)
        state, model_file = env.state, env.model_file
        env.reset(seed=42)
        assert env.model_file != model_file
        assert not np.array_equal(rollout(env, options={"state": state}), first)
        np.testing.assert_array_equal(rollout(env, options={"state": state, "model_file": model_file}), first)


def test_scene_of_another_task_is_refused(environment, lift):
    door = environment("Door")
    door.reset(seed=0)
    with pytest.raises(ValueError, match="model_file holds no body named 'Door_main'; it is of another task"):
        door.reset(options={"state": door.state, "model_file": lift.model_file})


def test_missing_robosuite_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "robosuite", None)
    with pytest.raises(ImportError, match=r'pip install "sb3-dtfm\[robosuite\]"'):
        RobosuiteEnv("Lift")


def test_a_machine_without_libgl_needs_no_opencv():
    """robosuite imports OpenCV for a viewer of its own; OpenCV cannot be loaded where libGL is missing."""
    program = "import sys; sys.modules['cv2'] = None\nfrom sb3_dtfm.envs.robosuite import RobosuiteEnv; RobosuiteEnv('Lift')"
    result = run_python(program)
    assert result.returncode == 0, result.stderr


def test_our_room_does_not_stand_before_robosuite():
    program = "import sb3_dtfm.envs.robosuite.scene as ours; print(ours.import_robosuite().__version__[:3])"
    assert run_python(program).stdout == "1.5\n"
