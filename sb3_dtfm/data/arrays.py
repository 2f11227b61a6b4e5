"""Arrays by their names, of an `.npz` file, an hdf5 file, or memory: looked at before they are read, never executed."""

import contextlib
import math
import os
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import h5py
import numpy as np

from sb3_dtfm.data.cache import existing_file
from sb3_dtfm.data.hdf5 import check_within, read_hdf5
from sb3_dtfm.data.observations import as_vectors
from sb3_dtfm.data.trajectories import DatasetError, check_real, check_size, wrap_dataset_errors

NPZ_SUFFIX = ".npz"
EXPECTED = "the path of a file of flat arrays (.npz, .hdf5)"
# Of what is no file.
NUMBERS_EXPECTED = "arrays of numbers are expected"
# The name of what TrajectoryBuffer.save writes of the environment.
ENV_ID = "env_id"


class Arrays(ABC):
    """
    Arrays by name, none of which is read before it has been looked at.

    :param source: what they are called, for messages
    :param names: of all that are there
    :param n_stored: bytes of the file, None in memory
    """

    def __init__(self, source: str, names: Collection[str], n_stored: int | None = None) -> None:
        self.source = source
        self.n_stored = n_stored
        self.names = names

    @abstractmethod
    def _get(self, name: str, where: str) -> np.ndarray:
        """A whole array of numbers."""

    def has(self, names: Sequence[str]) -> bool:
        """Whether there is one of these."""
        return any(name in self.names for name in names)

    def name(self, names: Sequence[str]) -> str:
        """The first of the names that is there."""
        for name in names:
            if name in self.names:
                return name
        accepted = names[0] if len(names) == 1 else f"one of {', '.join(names)}"
        found = ", ".join(sorted(map(str, self.names))) or "nothing"
        raise DatasetError(f"{self.source}: has no array {accepted}, only {found}.")

    def read(self, names: Sequence[str], n_steps: int | None = None) -> np.ndarray:
        """The first of the named arrays that is there: numbers, one entry a step."""
        name = self.name(names)
        where = f"{self.source}: {name}"
        with wrap_dataset_errors(where):
            array = self._get(name, where)
        check_real(array.dtype, where)
        if n_steps is not None and array.shape[:1] != (n_steps,):
            raise DatasetError(f"{where} has shape {array.shape} and actions have {n_steps} steps.")
        return array

    def env_id(self) -> str | None:
        """The environment that :meth:`TrajectoryBuffer.save` has written."""
        return None


class _Npz(Arrays):
    """Of an opened archive."""

    def __init__(self, archive: zipfile.ZipFile, source: str) -> None:
        self._archive = archive
        self._members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        super().__init__(source, self._members, os.path.getsize(source))

    def _get(self, name: str, where: str) -> np.ndarray:
        check_real(self._header(name, where), where)
        return self._stored(name)

    def env_id(self) -> str | None:
        where = f"{self.source}: {ENV_ID}"
        if not self.has((ENV_ID,)):
            return None
        with wrap_dataset_errors(where):
            dtype = self._header(ENV_ID, where)
            array = self._stored(ENV_ID) if dtype.kind == "U" else np.zeros(0)
        if array.size != 1:
            raise DatasetError(f"{where} holds {dtype} of shape {array.shape}; the id of an environment is expected.")
        return str(array.reshape(()))

    def _stored(self, name: str) -> np.ndarray:
        with self._archive.open(self._members[name]) as stream:
            return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))

    def _header(self, name: str, where: str) -> np.dtype:
        """Refuse what an array claims to be before memory is taken for it."""
        member = self._members[name]
        with self._archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read_header(stream)
            n_left = member.file_size - stream.tell()
        n_bytes = math.prod(shape) * dtype.itemsize
        if n_bytes != n_left and not dtype.hasobject:
            raise DatasetError(f"{where} has shape {shape}, which takes {n_bytes} bytes; there are {n_left}.")
        check_size(n_bytes, self.n_stored or 0, where)
        return dtype


class _Hdf5(Arrays):
    """Of an opened file, at its top."""

    def __init__(self, file: h5py.File, source: str) -> None:
        check_within(file, "infos", source)
        infos = file.get("infos")
        within = {f"infos/{name}" for name in infos} if isinstance(infos, h5py.Group) else set()
        super().__init__(source, {*file, *within}, os.path.getsize(source))
        self._file = file

    def _get(self, name: str, where: str) -> np.ndarray:
        return read_hdf5(self._file, name, self.source)


class _InMemory(Arrays):
    """Of anyone's own; observations may be a dictionary of arrays."""

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        super().__init__("arrays", arrays)
        self._arrays = arrays

    def _get(self, name: str, where: str) -> np.ndarray:
        found = self._arrays[name]
        with wrap_dataset_errors(where, NUMBERS_EXPECTED):
            return as_vectors(found, where) if isinstance(found, Mapping) else np.asarray(found)


@contextlib.contextmanager
def opened(dataset: str | os.PathLike[str] | Mapping[str, Any]) -> Iterator[Arrays]:
    """
    While they are read.

    :param dataset: path of the file, or arrays by name
    :raises DatasetError: no such file, or a damaged one
    """
    if isinstance(dataset, Mapping):
        yield _InMemory(dataset)
        return
    path = existing_file(dataset, EXPECTED)
    source = str(path)
    with wrap_dataset_errors(source), contextlib.ExitStack() as stack:
        if path.name.endswith(NPZ_SUFFIX):
            yield _Npz(stack.enter_context(zipfile.ZipFile(path)), source)
        else:
            yield _Hdf5(stack.enter_context(h5py.File(path, "r")), source)
