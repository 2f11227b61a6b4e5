"""A file appears under its name when it is complete: whoever is killed meanwhile leaves the one that was there before."""

import contextlib
import os
import re
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

# A hidden file that becomes the one asked for tells who writes it: the machine and the process, and a random word.
MACHINE = re.sub(r"\W", "-", socket.gethostname())
LEFTOVER = re.compile(r"\..+\.(?P<machine>[\w-]+)\.(?P<process>\d+)\.[0-9a-f]+\.part")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    A path to write to, which takes the place of `path` at the end if nothing was raised.

    Files that killed processes left behind in the folder are removed first.

    :param path: the file, there already or not; its folder is made if necessary
    :return: an empty file beside it
    :raises OSError: names `path` if it cannot be written; what was there before is still there
    """
    target = Path(os.path.realpath(path))  # of a link, what it leads to
    if target.exists() and not target.is_file() and not target.is_dir():  # a device or a pipe
        yield target
        return
    beside = target.with_name(hidden_name(target.name))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        for leftover in find_leftovers(target.parent):
            if leftover.is_file():
                leftover.unlink(missing_ok=True)
        beside.touch(exist_ok=False)
        try:
            yield beside
            _sync(beside)
            beside.replace(target)
        finally:
            beside.unlink(missing_ok=True)
        _sync(target.parent)
    except OSError as error:
        # Whatever was in the way, the hidden file or the folder: `path` is the name that the caller knows.
        if error.errno is None:  # a library's own message
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error


def hidden_name(name: str) -> str:
    """
    A name for what is not complete yet, which tells who is writing it.

    :param name: name that it will have
    """
    return f".{name}.{MACHINE}.{os.getpid()}.{secrets.token_hex(4)}.part"


def find_leftovers(folder: Path) -> list[Path]:
    """
    Find what processes of this machine were writing when they were killed.

    :param folder: folder in which files are replaced
    """
    found = ((path, LEFTOVER.fullmatch(path.name)) for path in folder.glob(".*.part"))
    return [
        path for path, named in found if named and named["machine"] == MACHINE and not _may_be_alive(int(named["process"]))
    ]


def _may_be_alive(process: int) -> bool:
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True


def _sync(path: Path) -> None:
    """Have a file, or the names in a folder, survive a loss of power."""
    if path.is_dir() and os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
