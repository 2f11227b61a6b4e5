"""Graphs in ONNX files: what is in them, and what is refused."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_dtfm.files import write_onnx

ort = pytest.importorskip("onnxruntime")
INPUTS = {"x": th.ones(2, 3)}


class Double(nn.Module):
    def forward(self, x):
        return (2 * x,)


class LooksAtNumbers(nn.Module):
    def forward(self, x):
        return (x,) if x.sum() > 0 else (-x,)


def write(path, module):
    write_onnx(path, module, INPUTS, ["y"], {"answer": [1, None]})


def test_a_file_holds_a_function_for_any_number_of_rows_and_its_settings(tmp_path, capfd):
    path = tmp_path / "new" / "double.onnx"
    write(path, Double())
    assert capfd.readouterr() == ("", "")
    session = ort.InferenceSession(str(path))
    assert json.loads(session.get_modelmeta().custom_metadata_map["sb3_dtfm"]) == {"answer": [1, None]}
    assert session.get_inputs()[0].shape == ["batch", 3]
    for n_rows in (1, 5):
        x = np.arange(n_rows * 3, dtype=np.float32).reshape(n_rows, 3)
        assert np.array_equal(session.run(["y"], {"x": x})[0], 2 * x)
    assert os.listdir(path.parent) == ["double.onnx"]


def test_what_depends_on_numbers_is_no_graph_and_leaves_the_file_that_was_there(tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_text("as it was")
    with pytest.raises(ValueError, match=r"policy\.onnx: LooksAtNumbers cannot be written as a graph"):
        write(path, LooksAtNumbers())
    assert path.read_text() == "as it was"
    assert os.listdir(tmp_path) == ["policy.onnx"]


def test_a_path_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file/policy\.onnx"):
        write(tmp_path / "file" / "policy.onnx", Double())


@pytest.mark.parametrize("missing", ["onnxruntime", "onnxscript"])
def test_a_missing_package_is_named_with_its_extra(missing, tmp_path):
    """In a Python that has it not; the rest of this package works there."""
    script = f"""
import sys
sys.modules[{missing!r}] = None
import torch
from sb3_dtfm.files import write_onnx
try:
    write_onnx("policy.onnx", torch.nn.Identity(), {{}}, [], {{}})
except ImportError as error:
    print(error)
"""
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert 'pip install "sb3-dtfm[export]"' in process.stdout, process.stderr
    assert missing in process.stdout
    assert not os.listdir(tmp_path)
