"""Files: how one is replaced, what a saved model is made of, and an exported one; what a run tells of its environment."""

from sb3_dtfm.files.evaluations import read_evaluations
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
from sb3_dtfm.files.printing import printable, warn
from sb3_dtfm.files.replacing import find_leftovers, hidden_name, replacing
from sb3_dtfm.files.run import CLASSES, EVALUATED, check_settings, literal, read_run, settings_loader

__all__ = [
    "CLASSES",
    "EVALUATED",
    "ModelFile",
    "ModelFileError",
    "check_settings",
    "file_name",
    "find_leftovers",
    "hidden_name",
    "holds_pickles",
    "literal",
    "printable",
    "read_configuration",
    "read_evaluations",
    "read_model",
    "read_run",
    "replacing",
    "settings_loader",
    "warn",
    "write_model",
    "write_onnx",
]
