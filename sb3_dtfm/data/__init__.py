"""Recorded episodes: readers, the buffer they fill, and one function that finds the right reader."""

import inspect
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from minari import MinariDataset

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, load_cached
from sb3_dtfm.data.episodes import Statistics
from sb3_dtfm.data.minari import load_minari, open_minari
from sb3_dtfm.data.robomimic import load_robomimic
from sb3_dtfm.data.trajectories import DatasetError, ScoreReference, Trajectory, returns_to_go

HDF5_SUFFIXES = (".hdf5", ".h5")
MINARI_ID = re.compile(r"[-\w/]+-v\d+")
ACCEPTED = (
    "a Minari id (namespace/name-vN), a minari.MinariDataset, the path of a robomimic file (.hdf5) or a TrajectoryBuffer"
)


def load_dataset(
    dataset: str | os.PathLike[str] | MinariDataset | TrajectoryBuffer,
    cache_dir: str | os.PathLike[str] | None = None,
    **kwargs: Any,
) -> TrajectoryBuffer:
    """
    Read recorded episodes from wherever they are.

    :param dataset: a Minari id (`namespace/name-vN`), an opened Minari dataset, the path of a robomimic hdf5 file, or a
        buffer, which is returned as it is
    :param cache_dir: learn from memory-mapped files in this folder, for datasets larger than memory; they are written at
        the first call and whenever the dataset has changed. None reads everything into memory
    :param kwargs: options of the reader (`filter_key` and `observation_keys` for robomimic files)
    :raises DatasetError: `dataset` is nothing of the above, its reader refuses it, or its cache cannot be used
    :raises TypeError: the reader has no such option
    """
    if isinstance(dataset, TrajectoryBuffer):
        given = {"cache_dir": cache_dir} if cache_dir is not None else {}
        _check_options(dataset.source, {**given, **kwargs}, [])
        return dataset
    reader, dataset = _find_reader(dataset)
    options = [name for name in inspect.signature(reader).parameters if name != "storage"][1:]
    _check_options(dataset, kwargs, [*options, "cache_dir"])
    if cache_dir is None:
        return reader(dataset, **kwargs)
    if reader is load_minari:
        dataset = open_minari(dataset) if isinstance(dataset, str) else dataset
        source, fingerprint = dataset.id, Fingerprint.of(Path(dataset.storage.data_path), _chosen_episodes(dataset))
    else:
        source, fingerprint = Path(dataset).name, Fingerprint.of(Path(dataset), kwargs)
    path = Path(cache_dir).expanduser()
    return load_cached(path, fingerprint, source, lambda storage: reader(dataset, storage=storage, **kwargs))


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


def _check_options(dataset: Any, given: dict[str, Any], accepted: list[str]) -> None:
    unknown = sorted(set(given) - set(accepted))
    if unknown:
        raise TypeError(
            f"dataset {dataset!s}: unknown option {', '.join(unknown)}; accepted: {', '.join(accepted) or 'none'}."
        )


def _chosen_episodes(dataset: MinariDataset) -> str | list[int]:
    """Which episodes an opened dataset consists of, as JSON can hold it."""
    episodes = dataset.episode_indices.tolist()
    return "all" if episodes == list(range(dataset.storage.total_episodes)) else episodes


__all__ = [
    "DatasetError",
    "ScoreReference",
    "Statistics",
    "Trajectory",
    "TrajectoryBuffer",
    "load_dataset",
    "load_minari",
    "load_robomimic",
    "returns_to_go",
]
