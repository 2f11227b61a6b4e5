"""An ONNX file of a function of tensors, which runs without this package and PyTorch."""

import contextlib
import json
import logging
import warnings
from collections.abc import Iterator
from os import PathLike
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_dtfm.files.replacing import replacing

# Version of ONNX's operators that runtimes of the last years know.
OPSET = 18
# The key of the settings among the file's metadata.
METADATA = "sb3_dtfm"
# Largest difference between the file's outputs and PyTorch's, relative to the largest output; another order of summation
# stays far below.
TOLERANCE = 1e-3


def write_onnx(
    path: str | PathLike[str], module: nn.Module, inputs: dict[str, Any], outputs: list[str], settings: dict[str, Any]
) -> None:
    """
    Write a module as a graph, once it has been seen to give the module's numbers.

    :param path: file to write
    :param module: module in evaluation mode, on the CPU
    :param inputs: example inputs of its `forward` by name, each (B, ...), or a dictionary of such; the file takes any B
    :param outputs: names of its outputs
    :param settings: values that JSON can hold, for the file's metadata
    :raises ImportError: names the extra that is missing
    :raises OSError: names the path, where what was there before still is
    :raises ValueError: the module does what no graph holds, or the file does not give its numbers
    """
    try:
        import onnxruntime
        import onnxscript  # noqa: F401  (torch's exporter needs it)
    except ImportError as error:
        raise ImportError(f'{path}: to write ONNX files: pip install "sb3-dtfm[export]" ({error})') from error
    with replacing(path) as beside:
        with _quiet():
            try:
                graph = _graph(module, inputs, outputs)
            except RuntimeError as error:  # of the exporter's several kinds
                raise ValueError(f"{path}: {type(module).__name__} cannot be written as a graph: {error}") from error
            graph.model.metadata_props[METADATA] = json.dumps(settings)
            graph.save(str(beside), external_data=False)
        session = onnxruntime.InferenceSession(str(beside), providers=["CPUExecutionProvider"])
        found = session.run(outputs, {name: each.numpy() for name, each in _flat(inputs).items()})
        for name, ours, theirs in zip(outputs, module(**inputs), found, strict=True):
            expected = ours.numpy()
            if not np.allclose(theirs, expected, rtol=0.0, atol=TOLERANCE * np.abs(expected).max()):
                raise ValueError(f"{path}: {name} of the file differs from PyTorch's; please report it.")


def _flat(inputs: dict[str, Any]) -> dict[str, th.Tensor]:
    """Inputs by name, those of a dictionary by their own."""
    flat: dict[str, th.Tensor] = {}
    for name, each in inputs.items():
        flat |= each if isinstance(each, dict) else {name: each}
    return flat


def _graph(module: nn.Module, inputs: dict[str, Any], outputs: list[str]) -> Any:
    """:return: ONNXProgram of torch"""
    batch = {0: th.export.Dim("batch")}
    rows = {name: dict.fromkeys(each, batch) if isinstance(each, dict) else batch for name, each in inputs.items()}
    # Captured here, by the one way whose graph is for all inputs: left alone, the exporter tries others if that one fails.
    program = th.export.export(module, (), kwargs=inputs, dynamic_shapes=rows, strict=False)
    names: dict[str, Any] = {"input_names": list(_flat(inputs)), "output_names": outputs, "dynamic_shapes": rows}
    return th.onnx.export(program, opset_version=OPSET, dynamo=True, verbose=False, **names)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence what the exporter says of packages that are not installed, and of its own ways."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
