"""Evaluations of a run, as SB3's `EvalCallback` writes them."""

from pathlib import Path

import numpy as np


def read_evaluations(path: Path) -> dict[str, np.ndarray]:
    """
    The arrays of an `evaluations.npz`, of E evaluations of n episodes each.

    :param path: path of the file
    :return: `timesteps` (E,), `results` (E, n) in environment reward units, and others that there are, such as `successes`
    :raises FileNotFoundError: no such file
    :raises ValueError: a damaged file, or another one
    """
    if not path.is_file():  # but perhaps a pipe, which would wait for ever
        raise FileNotFoundError(f"{path} does not exist, or is no file; expected evaluations of a run.")
    try:
        with np.load(path, allow_pickle=False) as saved:
            arrays = {name: saved[name] for name in saved.files}
        timesteps, results = arrays["timesteps"], arrays["results"]
        fits = timesteps.ndim == 1 and results.ndim == 2 and len(timesteps) == len(results)
        successes = arrays.get("successes", results)
        numbers = all(array.dtype.kind in "biuf" for array in (timesteps, results, successes))
        if not fits or not numbers or successes.shape != results.shape:
            raise ValueError("arrays of other shapes or types")
    except (PermissionError, MemoryError):
        raise
    except Exception as error:  # a damaged archive can raise anything
        raise ValueError(
            f"{path} is damaged, or no file of SB3's EvalCallback ({type(error).__name__}); expected the arrays timesteps "
            "(E,) and results (E, n)."
        ) from error
    return arrays
