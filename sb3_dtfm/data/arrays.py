"""Arrays by their names, of an `.npz` file, an hdf5 file, or memory: looked at before they are read, never executed."""

import contextlib
import csv
import math
import os
import re
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_dtfm.data.arrow import as_numbers, import_pyarrow
from sb3_dtfm.data.cache import existing_file
from sb3_dtfm.data.hdf5 import check_within, describe_hdf5, read_hdf5
from sb3_dtfm.data.observations import as_vectors
from sb3_dtfm.data.trajectories import DatasetError, check_real, check_size, wrap_dataset_errors
from sb3_dtfm.files import warn

NPZ_SUFFIX, CSV_SUFFIX, PARQUET_SUFFIX = ".npz", ".csv", ".parquet"
EXPECTED = "the path of a file of flat arrays (.npz, .hdf5) or of a table (.csv, .parquet)"
PICKLE = (
    "a pickle of Python objects, which can run code when it is read. From people you trust, "
    "dataset=load_dataset(path, allow_pickle=True) reads it all the same."
)
# Expectation in errors of data that come from no file.
NUMBERS_EXPECTED = "arrays of numbers are expected"
# The name of what TrajectoryBuffer.save writes of the environment.
ENV_ID = "env_id"


class Arrays(ABC):
    """
    Arrays by name, none of which is read before it has been looked at.

    :param source: name of their source, for messages
    :param names: names of all arrays
    :param n_stored: size of the file, bytes; None in memory
    """

    # Whether each is a column of a table, (N,), several of which make up an observation.
    are_columns = False

    def __init__(self, source: str, names: Collection[str], n_stored: int | None = None) -> None:
        self.source = source
        self.n_stored = n_stored
        self.names = names

    @abstractmethod
    def _get(self, name: str, where: str) -> np.ndarray:
        """A whole array of numbers, or several by their names."""

    def has(self, names: Sequence[str]) -> bool:
        """Return whether there is one of these."""
        return any(name in self.names for name in names)

    def name(self, names: Sequence[str]) -> str:
        """The first of the names that is there."""
        for name in names:
            if name in self.names:
                return name
        accepted = names[0] if len(names) == 1 else f"called one of {', '.join(names)}"
        found = ", ".join(sorted(map(str, self.names))) or "nothing"
        cure = " Name the columns with observation_keys=[...] and action_keys=[...]." if self.are_columns else ""
        raise DatasetError(f"{self.source}: has no array {accepted}, only {found}.{cure}")

    def beginning(self, name: str) -> list[str]:
        """The columns of a table that begin with a name, except those of the next step."""
        following = rf"{name}[\W_]+next([\W_]|$)"
        return [each for each in self.names if re.match(rf"{name}[\W_\d]", each) and not re.match(following, each)]

    def columns(self, names: Sequence[str]) -> list[str]:
        """
        The columns of a table that begin with the first of the names that fits any column, such as `obs.x` and `obs.y`,
        except those of the next step. If some have nothing but numbers behind the name, such as `obs_0` or `obs[0]`, those
        alone.
        """
        if self.are_columns and not self.has(names):
            for name in names:
                found = self.beginning(name)
                numbered = [each for each in found if re.fullmatch(rf"{name}[\W_\d]*\d[\W_]*", each)]
                if unread := sorted(set(found) - set(numbered or found)):
                    warn(
                        f"{self.source}: {', '.join(numbered)} are read, and not {', '.join(unread)}. "
                        "observation_keys=[...] and action_keys=[...] name columns to read.",
                        stacklevel=4,
                    )
                found = numbered or found
                if found:
                    alike = len({re.sub(r"\d+", "0", each) for each in found}) == 1
                    return sorted(found, key=lambda each: list(map(int, re.findall(r"\d+", each)))) if alike else found
        return [self.name(names)]

    def stored(self, name: str) -> Any:
        """An array as it is, for those who look at it themselves."""
        where = f"{self.source}: {name}"
        with wrap_dataset_errors(where):
            return self._get(name, where)

    def read(self, names: Sequence[str], n_steps: int | None = None) -> np.ndarray:
        """The first of the named arrays that is there: numbers, one entry a step."""
        name = self.name(names)
        where, found = f"{self.source}: {name}", self.stored(name)
        array = as_vectors(found, where) if isinstance(found, Mapping) else np.asarray(found)
        check_real(array.dtype, where)
        if n_steps is not None and array.shape[:1] != (n_steps,):
            raise DatasetError(f"{where} has shape {array.shape} and actions have {n_steps} steps.")
        return array

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype] | None:
        """Return shape and type of an array without reading it; None where there is none, or nothing tells."""
        return None

    def env_id(self) -> str | None:
        """The environment that :meth:`TrajectoryBuffer.save` has written."""
        return None


class _Npz(Arrays):
    """Arrays of an opened `.npz` archive."""

    def __init__(self, archive: zipfile.ZipFile, source: str) -> None:
        self._archive = archive
        self._members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        super().__init__(source, self._members, os.path.getsize(source))

    def _get(self, name: str, where: str) -> np.ndarray:
        dtype = self._header(name, where)
        if dtype.hasobject:
            raise DatasetError(f"{where} is {PICKLE}")
        check_real(dtype, where)
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

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype] | None:
        with contextlib.suppress(Exception):  # over damaged files they raise nearly everything, and this is not read
            return self._claims(name)[:2]
        return None

    def _claims(self, name: str) -> tuple[tuple[int, ...], np.dtype, int]:
        """Return shape and type of an array, and the number of bytes behind its header."""
        member = self._members[name]
        with self._archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read_header(stream)
            return shape, dtype, member.file_size - stream.tell()

    def _header(self, name: str, where: str) -> np.dtype:
        """Refuse what an array claims to be before memory is taken for it."""
        shape, dtype, n_left = self._claims(name)
        n_bytes = math.prod(shape) * dtype.itemsize
        if n_bytes != n_left and not dtype.hasobject:
            raise DatasetError(f"{where} has shape {shape}, which takes {n_bytes} bytes; there are {n_left}.")
        check_size(n_bytes, self.n_stored or 0, where)
        return dtype


class _Hdf5(Arrays):
    """Arrays at the top of an opened hdf5 file; observations may be a group of arrays."""

    def __init__(self, file: h5py.Group, source: str) -> None:
        check_within(file, "infos", source)
        infos = file.get("infos")
        within = {f"infos/{name}" for name in infos} if isinstance(infos, h5py.Group) else set()
        super().__init__(source, {*file, *within}, file.file.id.get_filesize())
        self._file = file

    def _get(self, name: str, where: str) -> Any:
        check_within(self._file, name, self.source)
        group = self._file.get(name)
        if not isinstance(group, h5py.Group):
            return read_hdf5(self._file, name, self.source)
        parts = filter(None, (describe_hdf5(group, part, where) for part in group))  # several links may lead to one
        check_size(sum(math.prod(shape) * dtype.itemsize for shape, dtype in parts), self.n_stored or 0, where)
        return {part: read_hdf5(group, part, where) for part in group}

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype] | None:
        return describe_hdf5(self._file, name, self.source)


class _InMemory(Arrays):
    """Arrays in memory; observations may be a dictionary of arrays."""

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        super().__init__("arrays", arrays)
        self._arrays = arrays

    def _get(self, name: str, where: str) -> Any:
        found = self._arrays[name]
        with wrap_dataset_errors(where, NUMBERS_EXPECTED):
            return found if isinstance(found, Mapping) else np.asarray(found)

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype] | None:
        found = self._arrays[name]
        with contextlib.suppress(Exception):  # lists of different lengths, which are not read
            array = np.asarray(None if isinstance(found, Mapping) else found)
            return (array.shape, array.dtype) if array.dtype != object else None
        return None


def _unnested(entry: Any) -> np.ndarray:
    """An entry of a table as an array of numbers; pandas reads nested lists as arrays of arrays."""
    array = np.asarray(entry)
    if array.dtype == object and array.ndim and isinstance(array.flat[0], np.ndarray | list):
        return np.stack([_unnested(part) for part in array])
    return array


class _Table(Arrays):
    """A DataFrame's columns, whose entries are numbers, or arrays of one length."""

    are_columns = True

    def __init__(self, table: Any, source: str, n_stored: int | None = None) -> None:
        names = getattr(table, "columns", table)
        super().__init__(source, [str(name) for name in names], n_stored)
        self._columns = {str(name): table[name] for name in names}

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype] | None:
        column = self._columns[name]
        first = next(iter(column), None)
        with contextlib.suppress(Exception):  # lists of different lengths
            array = _unnested(first)
            return ((len(column), *array.shape), array.dtype) if array.dtype != object else None
        return None

    def _get(self, name: str, where: str) -> Any:
        column = self._columns[name]
        array = np.asarray(column.to_numpy() if hasattr(column, "to_numpy") else column)
        with wrap_dataset_errors(where, NUMBERS_EXPECTED):
            nested = array.dtype == object and array.size > 0 and np.ndim(np.asarray(array[0])) > 0
            return np.stack([_unnested(entry) for entry in array]) if nested else array


class _Parquet(Arrays):
    """Columns of an opened Parquet file."""

    are_columns = True

    def __init__(self, file: Any, source: str) -> None:
        super().__init__(source, file.schema_arrow.names, os.path.getsize(source))
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        n_numbers = sum(group.column(i).num_values for group in groups for i in range(group.num_columns))
        check_size(8 * n_numbers, self.n_stored or 0, f"{source}: {file.metadata.num_rows} rows")
        self._file = file

    def describe(self, name: str) -> tuple[tuple[int, ...], np.dtype] | None:
        n_rows, pyarrow = self._file.metadata.num_rows, import_pyarrow(self.source)
        with contextlib.suppress(Exception):  # no rows, lists of different lengths, or no numbers
            kind = self._file.schema_arrow.field(name).type
            if not pyarrow.types.is_nested(getattr(kind, "storage_type", kind)):
                return (n_rows,), np.dtype(kind.to_pandas_dtype())
            for row in self._file.iter_batches(batch_size=1, columns=[name]):
                found = as_numbers(row.column(0), name)
                return (n_rows, *found.shape[1:]), found.dtype
        return None

    def _get(self, name: str, where: str) -> Any:
        table = self._file.read(columns=[name])
        table.validate(full=True)
        column = table[name].combine_chunks()
        pyarrow = import_pyarrow(where)
        if pyarrow.types.is_nested(getattr(column.type, "storage_type", column.type)):
            return as_numbers(column, where)
        return column.to_numpy(zero_copy_only=False)


def is_table(dataset: Any) -> bool:
    """Return whether this is a DataFrame, of pandas or of another package."""
    return hasattr(dataset, "columns") and hasattr(dataset, "to_numpy") and hasattr(dataset, "__getitem__")


def _read_csv(path: Path) -> dict[str, np.ndarray]:
    """The columns of a CSV file by the names in its first line; numbers where all entries of a column are some."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file, strict=True)
        names = [name.strip() for name in next(rows, [])]
        lines = [row for row in rows if row]
    if len(names) == 1 and {";", "\t"} & set(names[0]):
        raise DatasetError(
            f"{path}: the first row is {names[0]!r}; commas are expected between names, and points in numbers."
        )
    for number, row in enumerate(lines, 2):
        if len(row) != len(names):
            raise DatasetError(f"{path}, row {number}: has {len(row)} entries, and the first row names {len(names)}.")
    if len(set(names)) < len(names):
        raise DatasetError(f"{path}: the first row is {', '.join(names)}; a name for each column is expected, each once.")
    return {name: _parsed(column) for name, column in zip(names, zip(*lines, strict=True), strict=True)} if lines else {}


def _parsed(column: Sequence[str]) -> np.ndarray:
    words = [word.strip() for word in column]
    if {word.lower() for word in words} <= {"true", "false"}:
        return np.array([word.lower() == "true" for word in words])
    with contextlib.suppress(ValueError, OverflowError):
        return np.array([int(word) for word in words], np.int64)
    with contextlib.suppress(ValueError):
        return np.array([float(word or "nan") for word in words])
    return np.array(words, dtype=object)


@contextlib.contextmanager
def opened(dataset: Any) -> Iterator[Arrays]:
    """
    Open arrays while they are read.

    :param dataset: path of the file, an opened hdf5 file or a group in it, arrays by name, or a DataFrame
    :raises DatasetError: no such file, or a damaged one
    """
    if isinstance(dataset, h5py.Group):
        source = f"{dataset.file.filename}{dataset.name.rstrip('/')}"
        with wrap_dataset_errors(source):
            yield _Hdf5(dataset, source)
        return
    if isinstance(dataset, Mapping):
        yield _InMemory(dataset)
        return
    if is_table(dataset):
        yield _Table(dataset, "table")
        return
    path = existing_file(dataset, EXPECTED)
    source = str(path)
    with wrap_dataset_errors(source), contextlib.ExitStack() as stack:
        if path.name.endswith(NPZ_SUFFIX):
            yield _Npz(stack.enter_context(zipfile.ZipFile(path)), source)
        elif path.name.endswith(CSV_SUFFIX):
            yield _Table(_read_csv(path), source, path.stat().st_size)
        elif path.name.endswith(PARQUET_SUFFIX):
            yield _Parquet(stack.enter_context(import_pyarrow(source).parquet.ParquetFile(path)), source)
        else:
            yield _Hdf5(stack.enter_context(h5py.File(path, "r")), source)
