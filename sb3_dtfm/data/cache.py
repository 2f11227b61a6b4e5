"""Datasets as folders of flat float32 arrays that are memory-mapped: built once, opened at once, larger than memory."""

import concurrent.futures
import contextlib
import hashlib
import json
import os
import re
import shutil
import threading
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from filelock import FileLock
from gymnasium import spaces

from sb3_dtfm.actions import bounds_of, choices_between, vector_space
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.episodes import EpisodeTable
from sb3_dtfm.data.storage import STEP_ARRAYS, WRITE_BUFFER, FileStorage, MappedSteps
from sb3_dtfm.data.trajectories import DatasetError, ScoreReference

# Counts up whenever what is stored, or what the readers make of a dataset, changes: older caches are then built anew.
FORMAT = 12
DESCRIPTION = "cache.json"
EPISODES = "episodes.npz"
SPACES = ("observation_space", "action_space")
# Files of more bytes than this are checked in the background; reading takes about a second for 2**30.
LARGE = 2**26
# NumPy's errors for a file that is missing, empty, cut off, or of another kind.
READ_ERRORS = (OSError, EOFError, LookupError, TypeError, ValueError, zipfile.BadZipFile)


def existing_file(path: str | os.PathLike[str], expected: str) -> Path:
    """
    The path of a dataset's file.

    :param path: path of the file; `~` is the home folder
    :param expected: description of the expected file, for the message
    :raises DatasetError: no such file
    """
    path = Path(path).expanduser()
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "is no regular file" if path.exists() else "does not exist"
        raise DatasetError(f"{path.absolute()} {problem}; {expected} is expected.")
    return path


def files_below(folder: Path, part: str = "") -> list[Path]:
    """
    All files in a part of a folder and below it, behind links within the folder, too, sorted.

    :param folder: folder of a dataset; a snapshot of Hugging Face's hub may link to the hub's `blobs`
    :param part: path of the part, relative to the folder; the whole folder by default
    :raises DatasetError: a link leads out of the folder, to anything on this machine, or a pipe or device lies in it
    """
    root, files, seen = folder.resolve(), [], set()
    within = [root, *(parent.parents[1] / "blobs" for parent in (root, *root.parents) if parent.parent.name == "snapshots")]

    def check(path: Path) -> str:
        real = os.path.realpath(path)
        if not any(Path(real).is_relative_to(one) for one in within):
            raise DatasetError(f"{path} leads to {real}; links within {folder} are accepted.")
        return real

    check(folder / part)
    for parent, folders, names in os.walk(folder / part, followlinks=True):
        if (real := check(Path(parent))) in seen:  # a link leads back
            folders.clear()
            continue
        seen.add(real)
        files += [Path(parent, name) for name in names]
    for file in files:
        if file.is_symlink():
            check(file)
        if file.exists() and not file.is_file():  # to open a pipe can take for ever
            raise DatasetError(f"{file} is no regular file; files and folders are accepted.")
    return sorted(file for file in files if file.is_file())


class Fingerprint(NamedTuple):
    """
    Origin of a cache.

    :param name: name of the dataset
    :param path: file or folder of the dataset
    :param arguments: arguments of the reader, as JSON
    :param state: digest of names, sizes and modification times of its files
    """

    name: str
    path: str
    arguments: str
    state: str

    @classmethod
    def of(cls, name: str, path: Path, arguments: Any) -> "Fingerprint":
        """
        Take the fingerprint of a dataset as it is now.

        :param name: name of the dataset, for its cache's folder and for messages
        :param path: file of the dataset, or the folder that holds its files
        :param arguments: arguments of the reader, values that JSON can hold
        """
        path = path.resolve()
        files = [path] if path.is_file() else files_below(path)
        state = [(str(file.relative_to(path)), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
        return cls(name, str(path), json.dumps(arguments, sort_keys=True), _digest(state))

    @property
    def folder_name(self) -> str:
        """One name for each dataset and arguments of its reader, so that a changed dataset's cache replaces the old one."""
        name = re.sub(r"[^\w.-]+", "-", self.name)
        return f"{name}-{_digest([self.path, self.arguments])[:16]}"


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()


def load_cached(
    cache_dir: Path, fingerprint: Fingerprint, read: Callable[[FileStorage], TrajectoryBuffer]
) -> TrajectoryBuffer:
    """
    Open a dataset's cache, which is built first if there is none or the dataset has changed since.

    Other processes wait while one builds. A build that does not come to its end leaves no cache, and the next one removes
    what it leaves.

    :param cache_dir: folder of caches, made if necessary
    :param fingerprint: fingerprint of the dataset as it is now
    :param read: function that reads the dataset into a storage, and returns the buffer
    :raises DatasetError: the dataset cannot be read, or the cache cannot be written or is damaged
    """
    folder = cache_dir / fingerprint.folder_name
    try:
        if not _is_current(folder, fingerprint):  # one that is needs no lock, which a read-only folder could not hold
            cache_dir.mkdir(parents=True, exist_ok=True)
            with FileLock(cache_dir / f".{folder.name}.lock"):
                if not _is_current(folder, fingerprint):
                    _build(folder, fingerprint, read)
    except OSError as error:
        raise DatasetError(f"cache {folder} of {fingerprint.name} cannot be written: {error}") from error
    return open_cache(folder)


def _is_current(folder: Path, fingerprint: Fingerprint) -> bool:
    if not folder.exists():
        return False
    description = _read_description(folder)
    return description.get("format") == FORMAT and description.get("fingerprint") == fingerprint._asdict()


def _build(folder: Path, fingerprint: Fingerprint, read: Callable[[FileStorage], TrajectoryBuffer]) -> None:
    part, old = (folder.with_name(f".{folder.name}.{suffix}") for suffix in ("part", "old"))
    for left in (part, old):  # by a build that was killed
        if left.exists():
            shutil.rmtree(left)
    if folder.exists():  # outdated, and its room may be needed; half of it must never be found under its name
        folder.rename(old)
        shutil.rmtree(old)
    part.mkdir()
    try:
        with contextlib.closing(FileStorage(part, f"Caching {fingerprint.name}")) as storage:
            buffer = read(storage)
        _write_episodes(part, buffer)
        description = {
            "format": FORMAT,
            "fingerprint": fingerprint._asdict(),
            "source": buffer.source,
            "env_id": buffer.env_id,
            "controller": buffer.controller,
            "score_reference": buffer.score_reference,
            "n_steps": len(buffer),
            "images": {camera: list(space.shape) for camera, space in buffer.image_spaces.items()},
            "dropped": buffer.dropped,
            "digests": {file.name: _file_digest(file) for file in sorted(part.iterdir())},
        }
        (part / DESCRIPTION).write_text(json.dumps({**description, "digest": _digest(description)}, indent=2))
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _write_episodes(folder: Path, buffer: TrajectoryBuffer) -> None:
    """The arrays that are small: one row per episode, and the bounds of the spaces."""
    bounds = {}
    for name in SPACES:
        bounds[f"{name}_low"], bounds[f"{name}_high"] = bounds_of(getattr(buffer, name))
    np.savez(folder / EPISODES, **buffer.episodes._asdict(), **bounds)


def _stored_space(arrays: Mapping[str, np.ndarray], name: str) -> Any:
    low, high = arrays[f"{name}_low"], arrays[f"{name}_high"]
    return spaces.Box(low, high, dtype=low.dtype.type) if low.ndim else choices_between(low, high)


def _read_description(folder: Path) -> dict[str, Any]:
    try:
        description = json.loads((folder / DESCRIPTION).read_text())
    except (OSError, ValueError) as error:
        raise _damaged(folder, DESCRIPTION, error) from error
    if not isinstance(description, dict):
        raise _damaged(folder, DESCRIPTION, "no JSON object")
    return description


def _damaged(folder: Path, file: str, problem: object) -> DatasetError:
    return DatasetError(f"cache {folder}: {file} is damaged ({problem}); delete this folder to have it built anew.")


def open_cache(folder: Path) -> TrajectoryBuffer:
    """
    A buffer whose steps are memory-mapped.

    :param folder: folder of the cache
    :raises DatasetError: the cache is damaged or incomplete
    """
    description = _read_description(folder)
    if description.pop("digest", None) != _digest(description):
        raise _damaged(folder, DESCRIPTION, "not as it was written")
    check = _check_members(folder, description["digests"])
    try:
        with np.load(folder / EPISODES) as arrays:
            episodes = EpisodeTable(*(arrays[name] for name in EpisodeTable._fields))
            observation_space, action_space = (_stored_space(arrays, name) for name in SPACES)
    except READ_ERRORS as error:
        raise _damaged(folder, EPISODES, error) from error
    shapes: dict[str, tuple[int, ...]] = {
        "observations": observation_space.shape,
        "actions": vector_space(action_space).shape,
    }
    n_steps = int(description["n_steps"])
    reference = description["score_reference"]
    images = {camera: spaces.Box(0, 255, shape, np.uint8) for camera, shape in description["images"].items()}
    shapes |= {camera: space.shape for camera, space in images.items()}
    maps = {name: _checked_map(folder, name, (n_steps, *shapes.get(name, ()))) for name in (*STEP_ARRAYS, *images)}
    for steps in maps.values():
        steps.check = check
    buffer = TrajectoryBuffer(
        {name: steps.tensor for name, steps in maps.items()},
        episodes,
        observation_space,
        action_space,
        f"{description['source']}, cached in {folder}",
        None if reference is None else ScoreReference(*reference),
        description["env_id"],
        maps=[steps for name, steps in maps.items() if name != "rewards"],  # which windows do not hold
        dropped=description["dropped"],
        image_spaces=images,
    )
    buffer.controller = description["controller"]
    return buffer


def _file_digest(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(WRITE_BUFFER):
            digest.update(block)
    return digest.hexdigest()


# Files that this process has looked at: path, size, time of the last change, and digest.
_checked: set[tuple[str, int, int, str]] = set()


def _check_members(folder: Path, digests: dict[str, str]) -> concurrent.futures.Future[None] | None:
    """
    Compare files with what was written, once in a process: at once, or one after the other in the background if large.

    :param digests: SHA-256 digest of each file, by file name
    :return: future of the checks in the background, which holds their error if there is one; None if there are none
    :raises DatasetError: a small file is missing or holds other bytes
    """
    large = []
    for name, digest in digests.items():
        try:
            state = (folder / name).stat()
        except OSError as error:
            raise _damaged(folder, name, error) from error
        key = (str((folder / name).absolute()), state.st_size, state.st_mtime_ns, digest)
        if key in _checked:
            continue
        if state.st_size > LARGE:
            large.append(key)
        else:
            _check_member(key)
    if not large:
        return None
    future: concurrent.futures.Future[None] = concurrent.futures.Future()

    def run() -> None:
        try:
            for key in large:
                _check_member(key)
            future.set_result(None)
        except DatasetError as error:
            future.set_exception(error)

    threading.Thread(target=run, name="cache digests", daemon=True).start()  # a run that ends early does not wait
    return future


def _check_member(key: tuple[str, int, int, str]) -> None:
    path, digest = Path(key[0]), key[-1]
    try:
        found = _file_digest(path)
    except OSError as error:
        raise _damaged(path.parent, path.name, error) from error
    if found != digest:
        raise _damaged(path.parent, path.name, "not as it was written")
    _checked.add(key)


def _checked_map(folder: Path, name: str, shape: tuple[int, ...]) -> MappedSteps:
    try:
        steps = MappedSteps(folder, name)
    except READ_ERRORS as error:
        raise _damaged(folder, f"{name}.npy", error) from error
    dtype = th.float32 if name in STEP_ARRAYS else th.uint8
    if steps.tensor.dtype != dtype or steps.tensor.shape != shape:
        found = f"{steps.tensor.dtype} of shape {tuple(steps.tensor.shape)}, expected {dtype} of shape {shape}"
        raise _damaged(folder, f"{name}.npy", found)
    return steps
