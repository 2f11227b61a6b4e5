"""What Parquet and Arrow files are read with, when there are any: pyarrow is as large as all else here but PyTorch."""

from types import ModuleType


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
