"""Files: how one is replaced, what a saved model is made of, and an exported one."""

from sb3_dtfm.files.model import (
    ModelFile,
    ModelFileError,
    file_name,
    holds_pickles,
    read_configuration,
    read_model,
    write_model,
)
from sb3_dtfm.files.onnx import write_onnx
from sb3_dtfm.files.replacing import find_leftovers, hidden_name, replacing

__all__ = [
    "ModelFile",
    "ModelFileError",
    "file_name",
    "find_leftovers",
    "hidden_name",
    "holds_pickles",
    "read_configuration",
    "read_model",
    "replacing",
    "write_model",
    "write_onnx",
]
