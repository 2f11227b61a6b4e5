"""How a teacher tracks on models of the Go1: on ours, and on a file with meshes that are not there."""

import numpy as np
import pytest
from go1.tracking import make_env, playground_model, tracked

from sb3_dtfm.envs.go1.model import build_spec
from sb3_dtfm.recording.onnx_agent import OnnxAgent
from tests.envs.go1.test_second import without_floor
from tests.recording.test_onnx_agent import write_linear


def write_playground(path):
    """Our model as a file of another's: with a mesh, more damping, few iterations, and no floor."""
    spec = build_spec()
    spec.option.iterations = 1
    spec.compile()
    text = without_floor(spec.to_xml())
    text = text.replace('<body name="trunk"', '<geom type="mesh" mesh="trunk"/><body name="trunk"')
    text = text.replace("<worldbody>", '<asset><mesh name="trunk" file="no_such.stl"/></asset><worldbody>')
    path.write_text(text.replace('damping="0.5"', 'damping="2"'))
    return path


def test_a_file_is_simulated_without_its_meshes_as_playground_does(tmp_path):
    path = str(write_playground(tmp_path / "go1.xml"))
    model = playground_model(path)
    assert model.nmesh == 0
    assert model.body_subtreemass[0] == pytest.approx(12.743448, abs=1e-6)
    np.testing.assert_array_equal(model.dof_damping[6:], 0.5)
    assert model.geom("floor").friction[0] == 1.0
    assert model.opt.iterations == 1
    assert playground_model(path, (100, 50)).opt.iterations == 100


def test_a_teacher_that_stands_tracks_nothing_and_does_not_fall(tmp_path):
    pytest.importorskip("onnx")
    agent = OnnxAgent(write_linear(tmp_path / "stand.onnx", np.zeros((48, 12), np.float32)))
    for model in (None, playground_model(str(write_playground(tmp_path / "go1.xml")))):
        velocity, n_falls = tracked(make_env(model=model), agent, (1.0, 0.0, 0.0), 1)
        np.testing.assert_allclose(velocity, 0.0, atol=0.05)
        assert n_falls == 0
