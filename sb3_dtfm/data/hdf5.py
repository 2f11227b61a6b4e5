"""Arrays in hdf5 files that nobody vouches for: checked before a byte of them is read."""

import contextlib
import math

import h5py
import numpy as np

from sb3_dtfm.data.trajectories import DatasetError, check_real, check_size, wrap_dataset_errors


def read_hdf5(group: h5py.Group, name: str, where: str) -> np.ndarray:
    """
    All values of an array.

    Most of the time that `group[name][:]` takes goes into h5py's objects, so HDF5 is asked directly.

    :param group: of the file that was opened
    :param name: what the array is called there
    :param where: the file and the episode, for messages
    :raises DatasetError: there is none, it holds no numbers, lies in another file, or is not there in full
    """
    data, shape, dtype = open_hdf5(group, name, where)
    with wrap_dataset_errors(f"{where}: {name}"):
        values = np.empty(shape, dtype)
        if values.size > 0:
            data.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
        return values


def open_hdf5(group: h5py.Group, name: str, where: str) -> tuple[h5py.h5d.DatasetID, tuple[int, ...], np.dtype]:
    """
    An array that may be read, its shape and its type.

    :param group: as for :func:`read_hdf5`, which says the rest too
    """
    what = f"{where}: {name}"
    try:
        data = h5py.h5d.open(group.id, name.encode())
    except (KeyError, TypeError, ValueError, OSError, RuntimeError) as error:  # no such name, a group, a link astray
        raise DatasetError(f"{where}: has no {name!r}, only {listed(group)}; the file is incomplete.") from error
    with wrap_dataset_errors(what):
        shape, dtype, n_stored = data.shape, data.dtype, data.get_storage_size()
        in_file = h5py.h5f.get_name(data) == h5py.h5f.get_name(group.id) and _stored_within(data)
    check_real(dtype, what)
    if not shape:
        raise DatasetError(f"{what} have shape {shape}; one entry for each step is expected.")
    if not in_file:  # what is there can change without a trace, or be what nobody meant to give away
        raise DatasetError(f"{what} lie in another file; one file that holds everything is accepted.")
    n_bytes = math.prod(shape) * dtype.itemsize
    if n_bytes and not n_stored:
        raise DatasetError(f"{what} have shape {shape}, of which nothing has been written; the file is incomplete.")
    check_size(n_bytes, n_stored, what)
    return data, shape, dtype


def _stored_within(data: h5py.h5d.DatasetID) -> bool:
    """Whether the numbers lie in the file that describes them."""
    if data.get_offset() is not None:
        return True
    with contextlib.suppress(TypeError, ValueError, RuntimeError):  # chunks always do, and a look at one takes no time
        return data.get_chunk_info(0) is not None
    layout = data.get_create_plist()
    return layout.get_layout() != h5py.h5d.VIRTUAL and layout.get_external_count() == 0


def open_group(parent: h5py.Group, name: str, where: str) -> h5py.Group:
    """
    A group of the same file.

    :param parent: what holds it
    :param name: what it is called there
    :param where: the file, for messages
    :raises DatasetError: there is none, or it lies in another file
    """
    with wrap_dataset_errors(f"{where}: {name}"):
        group = parent.get(name)
        if not isinstance(group, h5py.Group):
            raise DatasetError(f"{where}: has no group {name!r}, only {listed(parent)}.")
        if h5py.h5f.get_name(group.id) != h5py.h5f.get_name(parent.id):
            raise DatasetError(f"{where}: group {name!r} lies in another file; one file that holds everything is accepted.")
        return group


def listed(group: h5py.Group) -> str:
    """The names in a group, for messages."""
    return ", ".join(map(repr, sorted(group))) or "nothing"
