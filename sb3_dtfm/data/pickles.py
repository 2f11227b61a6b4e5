"""Data in pickles, which can run code when they are read: only on request."""

import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dtfm.data.arrays import NPZ_SUFFIX, PICKLE
from sb3_dtfm.data.cache import existing_file
from sb3_dtfm.data.flat import ACTIONS
from sb3_dtfm.data.trajectories import DatasetError, wrap_dataset_errors

SUFFIXES = (".pkl", ".pickle")


def unpickled(dataset: Any, allow_pickle: bool) -> Any:
    """
    Return what a pickle holds, and episodes of different lengths in arrays of objects as a list of episodes.

    :param dataset: see :func:`~sb3_dtfm.data.load_dataset`; what is no pickle stays as it is
    :param allow_pickle: whether to read pickles
    :raises DatasetError: a pickle that is not allowed, or is damaged
    """
    if isinstance(dataset, str | os.PathLike):
        name = os.fspath(dataset)
        if name.endswith(SUFFIXES):
            path = existing_file(dataset, "the path of a pickle, such as SB3's replay buffer")
            if not allow_pickle:
                raise DatasetError(f"{path} is {PICKLE}")
            with wrap_dataset_errors(str(path)), open(path, "rb") as file:
                dataset = pickle.load(file)
        elif allow_pickle and name.endswith(NPZ_SUFFIX):
            dataset = _of_npz(existing_file(dataset, "the path of an .npz file"))
    return _as_episodes(dataset) if isinstance(dataset, Mapping) else dataset


def _of_npz(path: Path) -> Any:
    """Its arrays, where some are of objects; else the path, which needs no pickle."""
    with wrap_dataset_errors(str(path)), np.load(path, allow_pickle=True) as file:
        arrays = dict(file)
    return arrays if any(array.dtype == object for array in arrays.values()) else path


def _as_episodes(arrays: Mapping[str, Any]) -> Any:
    """A list of episodes, where actions are an array of objects, one for each episode."""
    actions = next((arrays[name] for name in ACTIONS if name in arrays), None)
    if not isinstance(actions, np.ndarray) or actions.dtype != object or actions.ndim != 1:
        return arrays
    columns = {name: array for name, array in arrays.items() if len(np.atleast_1d(array)) == len(actions)}
    return [{name: array[number] for name, array in columns.items()} for number in range(len(actions))]


def without_pickles(options: Mapping[str, Any] | None) -> dict[str, Any]:
    """
    Options of :func:`~sb3_dtfm.data.load_dataset` from a model, settings or a run folder, which others may have written.

    :param options: options by name; None for none
    :raises DatasetError: they allow pickles, which only a call of `load_dataset` does
    """
    if "allow_pickle" in (options or {}):
        raise DatasetError(
            "dataset_kwargs: allow_pickle is accepted by load_dataset alone: "
            "dataset=load_dataset('buffer.pkl', allow_pickle=True), or .save('mine.npz') for the command line."
        )
    return dict(options or {})
