"""Reads Parquet and Arrow files, when there are any: pyarrow is as large as all else here but PyTorch."""

from types import ModuleType
from typing import Any

import numpy as np

from sb3_dtfm.data.trajectories import DatasetError, check_real


def import_pyarrow(source: str) -> ModuleType:
    """
    The package, with `dataset`, `parquet` and `types`.

    :param source: what is to be read, for the message
    :raises ImportError: not installed; says which extra installs it
    """
    try:
        import pyarrow.dataset
        import pyarrow.parquet
        import pyarrow.types
    except ImportError as error:
        raise ImportError(f'{source}: to read Parquet and Arrow files: pip install "sb3-dtfm[minari]" ({error})') from error
    return pyarrow


def as_numbers(values: Any, where: str) -> np.ndarray:
    """
    A column of a table.

    :param values: a pyarrow Array whose entries are numbers, or lists of as many
    :param where: the file and the column, for messages
    :return: (N, .)
    :raises DatasetError: no rows, lists of several lengths, or no numbers
    """
    n_rows = len(values)
    if not n_rows:
        raise DatasetError(f"{where} has no rows; a row for each step is expected.")
    pyarrow = import_pyarrow(where)
    if pyarrow.types.is_list(values.type) or pyarrow.types.is_fixed_size_list(values.type):
        sizes = np.unique(np.diff(values.offsets.to_numpy())) if pyarrow.types.is_list(values.type) else np.zeros(1)
        if len(sizes) > 1:
            raise DatasetError(f"{where} holds lists of {sizes[0]} to {sizes[-1]} numbers; one length is expected.")
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False)
    check_real(array.dtype, where)
    return array.reshape(n_rows, -1)
