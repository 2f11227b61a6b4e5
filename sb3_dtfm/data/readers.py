"""The table of readers, and one function that finds the right one for a dataset."""

import copy
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from minari import MinariDataset

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, load_cached
from sb3_dtfm.data.minari import fingerprint_minari, is_minari, load_minari
from sb3_dtfm.data.npz import fingerprint_npz, is_npz, load_npz
from sb3_dtfm.data.robomimic import fingerprint_robomimic, is_robomimic, load_robomimic
from sb3_dtfm.data.trajectories import DatasetError


class Reader(NamedTuple):
    """
    How datasets of one kind are read.

    :param kind: what they are, for messages
    :param accepts: whether something is one of them
    :param load: reads one; its other parameters are the options that users have, and `storage`, where the steps go
    :param fingerprint: what a cache of one is known by, given the dataset and the options for `load`; None for no caches
    """

    kind: str
    accepts: Callable[[Any], bool]
    load: Callable[..., TrajectoryBuffer]
    fingerprint: Callable[[Any, dict[str, Any]], Fingerprint] | None


# The first one that accepts a dataset reads it.
READERS = (
    Reader("the path of a file of flat arrays (.npz)", is_npz, load_npz, fingerprint_npz),
    Reader("the path of a robomimic file (.hdf5)", is_robomimic, load_robomimic, fingerprint_robomimic),
    Reader("a Minari id (namespace/name-vN) or MinariDataset", is_minari, load_minari, fingerprint_minari),
    Reader("a TrajectoryBuffer", lambda dataset: isinstance(dataset, TrajectoryBuffer), lambda dataset: dataset, None),
)


def load_dataset(
    dataset: str | os.PathLike[str] | MinariDataset | TrajectoryBuffer,
    cache_dir: str | os.PathLike[str] | None = None,
    env_id: str | None = None,
    **kwargs: Any,
) -> TrajectoryBuffer:
    """
    Read recorded episodes from wherever they are.

    :param dataset: a Minari id (`namespace/name-vN`), an opened Minari dataset, the path of a robomimic hdf5 file or
        of flat arrays (`.npz`), or a buffer, which is returned as it is
    :param cache_dir: learn from memory-mapped files in this folder, for datasets larger than memory; they are written at
        the first call and whenever the dataset has changed. None reads everything into memory
    :param env_id: Gymnasium id of the environment that the episodes count as coming from, whatever the dataset says
    :param kwargs: options of the reader: `on_invalid`, which is "raise" unless "drop" leaves episodes out that would be
        refused, with a warning that names their number and the first reason; `filter_key` and `observation_keys` for
        robomimic files, see also :func:`load_npz`
    :raises DatasetError: `dataset` is nothing of the above, its reader refuses it, or its cache cannot be used
    :raises TypeError: the reader has no such option
    """
    reader = _find_reader(dataset)
    own = [name for name in inspect.signature(reader.load).parameters if name != "storage"][1:]
    given = kwargs if cache_dir is None else {**kwargs, "cache_dir": cache_dir}
    accepted = [*own, *(["cache_dir"] if reader.fingerprint else []), "env_id"]
    unknown = sorted(set(given) - set(accepted))
    if unknown:
        raise TypeError(f"dataset {dataset!s}: unknown option {', '.join(unknown)}; accepted: {', '.join(accepted)}.")
    if cache_dir is None or reader.fingerprint is None:
        buffer = reader.load(dataset, **kwargs)
    else:
        fingerprint = reader.fingerprint(dataset, kwargs)
        buffer = load_cached(
            Path(cache_dir).expanduser(), fingerprint, lambda storage: reader.load(dataset, storage=storage, **kwargs)
        )
    if env_id is not None:
        buffer = copy.copy(buffer)
        buffer.env_id = env_id
    return buffer


def _find_reader(dataset: Any) -> Reader:
    for reader in READERS:
        if reader.accepts(dataset):
            return reader
    found = repr(dataset) if isinstance(dataset, str) else f"a {type(dataset).__name__}"
    kinds = ", ".join(reader.kind for reader in READERS)
    raise DatasetError(f"dataset is {found}; accepted are {kinds}.")
