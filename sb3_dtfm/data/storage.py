"""Storage of the flat arrays of a buffer's steps while episodes are read: memory, or files that are then memory-mapped."""

import concurrent.futures
import contextlib
import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import numpy as np
import torch as th
from tqdm import tqdm

from sb3_dtfm.data.trajectories import DatasetError

# Arrays of float32; all others are uint8 images, named after their camera.
STEP_ARRAYS = ("observations", "actions", "rewards", "returns_to_go")
# A build that takes longer than this many seconds shows a progress bar.
PROGRESS_DELAY = 3.0
# Bytes that are collected before they are written.
WRITE_BUFFER = 2**20
# Not on Windows.
CAN_ADVISE = hasattr(mmap.mmap, "madvise")


class MemoryStorage:
    """Arrays in memory, made at once for an announced number of steps; they grow if there are more."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}
        self._n_steps = 0
        self._capacity = 0

    def reserve(self, n_steps: int) -> None:
        """Expect this many steps in all."""
        self._capacity = n_steps

    def append(self, steps: dict[str, np.ndarray]) -> None:
        """
        Copy the steps of one more episode.

        :param steps: (T, ...) for each of `STEP_ARRAYS`, and for each camera
        """
        stop = self._n_steps + len(steps["rewards"])
        if stop > self._capacity or not self._arrays:
            self._capacity = max(self._capacity, stop + stop // 2 if self._arrays else stop)
            self._arrays = {name: self._larger(name, values) for name, values in steps.items()}
        for name, values in steps.items():
            self._arrays[name][self._n_steps : stop] = values
        self._n_steps = stop

    def _larger(self, name: str, values: np.ndarray) -> np.ndarray:
        # Torch's memory: numpy asks for huge pages, which a virtual machine may have to gather first.
        dtype = th.float32 if name in STEP_ARRAYS else th.uint8
        array = th.empty(self._capacity, *values.shape[1:], dtype=dtype).numpy()
        if name in self._arrays:
            array[: self._n_steps] = self._arrays[name][: self._n_steps]
        return array

    def finish(self) -> dict[str, th.Tensor]:
        """The tensors, (N, ...) each."""
        return {name: th.from_numpy(array[: self._n_steps]) for name, array in self._arrays.items()}


class FileStorage:
    """
    One `.npy` file per array, written from front to back and memory-mapped when complete.

    Plain writes instead of a map of the growing file: a full disk is an error then and not a crash, and what was written
    does not count as this process's memory.

    :param folder: an existing folder
    :param description: text of the progress bar
    """

    def __init__(self, folder: Path, description: str) -> None:
        self.folder = folder
        self._files: dict[str, BinaryIO] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._n_steps = 0
        self._bar = tqdm(desc=description, unit="step", unit_scale=True, delay=PROGRESS_DELAY, leave=False)

    def reserve(self, n_steps: int) -> None:
        """Expect this many steps in all."""
        self._bar.total = n_steps

    def append(self, steps: dict[str, np.ndarray]) -> None:
        """
        Write the steps of one more episode.

        :param steps: (T, ...) for each of `STEP_ARRAYS`, and for each camera
        :raises DatasetError: the disk is full, for example
        """
        with self._writing():
            for name, values in steps.items():
                if name not in self._files:
                    path = step_file(self.folder, name)
                    self._files[name] = open(path, "wb", buffering=WRITE_BUFFER)  # noqa: SIM115 (close() does it)
                    self._shapes[name] = values.shape[1:]
                    self._write_header(name)
                self._files[name].write(np.ascontiguousarray(values, _dtype(name)).data)
        self._n_steps += len(steps["rewards"])
        self._bar.update(len(steps["rewards"]))

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # a reader would take it for an error of the file that it reads
            raise DatasetError(f"cache {self.folder} cannot be written: {error}") from error

    def _write_header(self, name: str) -> None:
        header = {
            "descr": np.lib.format.dtype_to_descr(_dtype(name)),
            "fortran_order": False,
            "shape": (self._n_steps, *self._shapes[name]),
        }
        np.lib.format.write_array_header_1_0(self._files[name], header)

    def finish(self) -> dict[str, th.Tensor]:
        """The tensors, (N, ...) each, mapped from the files."""
        with self._writing():
            for name, file in self._files.items():
                file.seek(0)
                self._write_header(name)  # of the same length: numpy leaves room for the number of rows
            self.close()
        return {name: MappedSteps(self.folder, name).tensor for name in self._files}

    def close(self) -> None:
        """Close the files, whatever has been written."""
        self._bar.close()
        for file in self._files.values():
            file.close()


def _dtype(name: str) -> np.dtype[Any]:
    return np.dtype("<f4" if name in STEP_ARRAYS else "u1")


def step_file(folder: Path, name: str) -> Path:
    """The file of an array; a camera's name may hold any characters."""
    return folder / f"{name if name in STEP_ARRAYS else 'image_' + quote(name, safe='')}.npy"


class MappedSteps:
    """
    An array as a tensor whose numbers are read from its file when they are used.

    Windows lie anywhere in the file. So the system is told to read no more than is used, and gets to know the windows of
    the next batch early and all at once: for cold pages that took 3 ms a batch, against 150 ms when each access to a page
    waited for the disk and for the neighbouring pages too.

    :param folder: folder of a cache
    :param name: name of the array, one of `STEP_ARRAYS` or a camera
    :ivar check: future of the check of the cache's files in the background; None if there is none
    :raises OSError: no such file
    :raises ValueError: not a npy file, or cut off
    """

    def __init__(self, folder: Path, name: str) -> None:
        # Copy on write: torch has no read-only tensors, and nothing that is written to one may reach the file.
        array = np.load(step_file(folder, name), mmap_mode="c")
        self.name = name
        self.check: concurrent.futures.Future[None] | None = None
        self.tensor = th.from_numpy(array)
        self._map: mmap.mmap = array.base
        if CAN_ADVISE:
            self._map.madvise(mmap.MADV_RANDOM)
        self._data_offset: int = array.offset
        self._row_bytes = array.strides[0]

    def will_need(self, stops: list[int], n_rows: int) -> None:
        """
        Have the system start to read some rows, without waiting for them.

        :param stops: rows that each range ends before
        :param n_rows: number of rows in each range
        :raises DatasetError: a file of the cache has turned out to be damaged
        """
        if self.check is not None and self.check.done():
            self.check.result()
        for stop in stops if CAN_ADVISE else ():
            start_byte = self._data_offset + max(0, stop - n_rows) * self._row_bytes
            start_byte -= start_byte % mmap.PAGESIZE
            stop_byte = self._data_offset + stop * self._row_bytes
            self._map.madvise(mmap.MADV_WILLNEED, start_byte, stop_byte - start_byte)
