"""Reads Parquet and Arrow files, when there are any: pyarrow is as large as all else here but PyTorch."""

from types import ModuleType
from typing import Any

import numpy as np

from sb3_dtfm.data.trajectories import DatasetError, check_real


def import_pyarrow(source: str) -> ModuleType:
    """
    The package, with `compute`, `dataset`, `parquet` and `types`.

    :param source: name of the file or dataset to read, for the message
    :raises ImportError: not installed; says which extra installs it
    """
    try:
        import pyarrow.compute
        import pyarrow.dataset
        import pyarrow.parquet
        import pyarrow.types
    except ImportError as error:
        raise ImportError(f'{source}: to read Parquet and Arrow files: pip install "sb3-dtfm[minari]" ({error})') from error
    return pyarrow


def as_numbers(values: Any, where: str) -> np.ndarray:
    """
    A column of a table.

    :param values: a pyarrow Array whose entries are numbers, or lists of as many, which may hold further lists
    :param where: the file and the column, for messages
    :return: (N, ...), an axis for each level of lists
    :raises DatasetError: no rows, lists of several lengths, or no numbers
    """
    n_rows = len(values)
    if not n_rows:
        raise DatasetError(f"{where} has no rows; a row for each step is expected.")
    pyarrow = import_pyarrow(where)
    kind = values.type
    if isinstance(values, pyarrow.ExtensionArray):
        values = values.storage
    axes = []
    while hasattr(values, "flatten") and hasattr(values.type, "value_type"):  # a list of any kind
        sizes = np.unique(pyarrow.compute.list_value_length(values).fill_null(0))
        if len(sizes) > 1:
            raise DatasetError(f"{where} holds lists of {sizes[0]} to {sizes[-1]} entries; one length is expected.")
        axes.append(int(sizes[0]) if len(sizes) else 0)
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False)
    check_real(array.dtype, where)
    if not isinstance(kind, pyarrow.FixedShapeTensorType):
        return array.reshape(n_rows, *axes)
    order = kind.permutation or range(len(kind.shape))
    return array.reshape(n_rows, *kind.shape).transpose(0, *(1 + axis for axis in order))
