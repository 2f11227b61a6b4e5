"""Recorded episodes: readers, the buffer they fill, and one function that finds the right reader."""

import inspect
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from minari import MinariDataset

from sb3_dtfm.data.minari import load_minari
from sb3_dtfm.data.robomimic import load_robomimic
from sb3_dtfm.data.trajectories import (
    DatasetError,
    ScoreReference,
    SequenceBatch,
    Trajectory,
    TrajectoryBuffer,
    returns_to_go,
)

HDF5_SUFFIXES = (".hdf5", ".h5")
MINARI_ID = re.compile(r"[-\w/]+-v\d+")
ACCEPTED = (
    "a Minari id (namespace/name-vN), a minari.MinariDataset, the path of a robomimic file (.hdf5) or a TrajectoryBuffer"
)


def load_dataset(dataset: str | os.PathLike[str] | MinariDataset | TrajectoryBuffer, **kwargs: Any) -> TrajectoryBuffer:
    """
    Read recorded episodes from wherever they are.

    :param dataset: a Minari id (`namespace/name-vN`), an opened Minari dataset, the path of a robomimic hdf5 file, or a
        buffer, which is returned as it is
    :param kwargs: options of the reader (`filter_key` and `observation_keys` for robomimic files)
    :raises DatasetError: `dataset` is nothing of the above, or its reader refuses it
    :raises TypeError: the reader has no such option
    """
    if isinstance(dataset, TrajectoryBuffer):
        accepted: list[str] = []
    else:
        reader, dataset = _find_reader(dataset)
        accepted = list(inspect.signature(reader).parameters)[1:]
    unknown = sorted(set(kwargs) - set(accepted))
    if unknown:
        raise TypeError(
            f"dataset {dataset!s}: unknown option {', '.join(unknown)}; accepted: {', '.join(accepted) or 'none'}."
        )
    return dataset if isinstance(dataset, TrajectoryBuffer) else reader(dataset, **kwargs)


def _find_reader(dataset: Any) -> tuple[Callable[..., TrajectoryBuffer], Any]:
    """The reader for a dataset, and what to give to it."""
    if isinstance(dataset, MinariDataset):
        return load_minari, dataset
    if not isinstance(dataset, str | os.PathLike):
        raise DatasetError(f"dataset is a {type(dataset).__name__}; accepted are {ACCEPTED}.")
    path = Path(dataset).expanduser()
    if path.is_file():
        return load_robomimic, path
    if isinstance(dataset, os.PathLike) or dataset.endswith(HDF5_SUFFIXES) or dataset.startswith((".", "~", os.sep)):
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise DatasetError(f"dataset file {path.absolute()} {problem}; accepted are {ACCEPTED}.")
    if not MINARI_ID.fullmatch(dataset):
        raise DatasetError(f"dataset {dataset!r} is neither a file nor a Minari id; accepted are {ACCEPTED}.")
    return load_minari, dataset


__all__ = [
    "DatasetError",
    "ScoreReference",
    "SequenceBatch",
    "Trajectory",
    "TrajectoryBuffer",
    "load_dataset",
    "load_minari",
    "load_robomimic",
    "returns_to_go",
]
