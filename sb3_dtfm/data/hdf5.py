"""Arrays in hdf5 files that nobody vouches for: checked before a byte of them is read."""

import contextlib
import math
import re
import zlib
from operator import itemgetter

import h5py
import numpy as np

from sb3_dtfm.data.observations import STORED_AS_JPEG
from sb3_dtfm.data.trajectories import DatasetError, check_real, check_size, wrap_dataset_errors

# Links one after the other that are followed at most, which is HDF5's own limit.
MOST_LINKS = 16
# Names in a list, and bytes of a name, at most.
MOST_NAMES, LONGEST_NAME = 1_000_000, 255
CHECKSUM = 4  # bytes that Fletcher's filter adds to a chunk
# Names of filters that unpack without an error what is cut off.
UNKNOWN_LENGTH = {h5py.h5z.FILTER_SZIP: "szip", h5py.h5z.FILTER_NBIT: "nbit", h5py.h5z.FILTER_SCALEOFFSET: "scaleoffset"}
# A run of up to 32 bytes behind its length, a short reference, or a long one with its length in the second byte.
LZF_RUNS = [b"\\x%02x.{%d}" % (n, n + 1) for n in range(32)]
LZF_TOKEN = re.compile(b"|".join([*LZF_RUNS, b"[\\x20-\\xdf].", b"[\\xe0-\\xff].."]), re.DOTALL)


def read_hdf5(group: h5py.Group, name: str, where: str) -> np.ndarray:
    """
    All values of an array.

    Most of the time that `group[name][:]` takes goes into h5py's objects, so HDF5 is asked directly.

    :param group: group of an opened file
    :param name: name of the array in the group
    :param where: the file and the episode, for messages
    :raises DatasetError: there is none, it holds no numbers, lies in another file, or is not there in full
    """
    data, shape, dtype = open_hdf5(group, name, where)
    with wrap_dataset_errors(f"{where}: {name}"):
        values = np.empty(shape, dtype)
        if values.size > 0:
            data.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
        return values


def read_images(group: h5py.Group, name: str, where: str) -> np.ndarray | h5py.Dataset:
    """
    :param group: see :func:`read_hdf5`, also for the parameters that follow
    :return: images as they are stored: an array, or the bytes of one file each, which are read one by one
    """
    data, _, dtype = open_hdf5(group, name, where, encoded=True)
    return h5py.Dataset(data) if h5py.check_vlen_dtype(dtype) else read_hdf5(group, name, where)


def open_hdf5(
    group: h5py.Group, name: str, where: str, encoded: bool = False
) -> tuple[h5py.h5d.DatasetID, tuple[int, ...], np.dtype]:
    """
    An array that may be read, its shape and its type.

    :param group: see :func:`read_hdf5`, also for the parameters that follow
    :param encoded: accept strings of bytes, too
    """
    what = f"{where}: {name}"
    data, shape, dtype, n_stored = _opened(group, name, where)
    strings = h5py.check_vlen_dtype(dtype) == np.uint8
    if strings and not encoded:
        raise DatasetError(f"{what} {STORED_AS_JPEG}")
    check_real(np.uint8 if strings else dtype, what)
    if not shape:
        raise DatasetError(f"{what} have shape {shape}; one entry for each step is expected.")
    _check_stored(data, shape, dtype, n_stored, what)
    return data, shape, dtype


def read_names(group: h5py.Group, name: str, where: str) -> list[str]:
    """
    An array of names.

    :param group: see :func:`read_hdf5`, also for the parameters that follow
    """
    what = f"{where}: {name}"
    data, shape, dtype, n_stored = _opened(group, name, where)
    if dtype.kind != "S" and h5py.check_string_dtype(dtype) is None:
        raise DatasetError(f"{what} hold {dtype}; names are expected.")
    if shape is None or len(shape) != 1 or shape[0] > MOST_NAMES:
        raise DatasetError(f"{what} have shape {shape}; a list of at most {MOST_NAMES:,} names is expected.")
    _check_stored(data, shape, dtype, n_stored, what)
    names = []
    with wrap_dataset_errors(what):
        for each in h5py.Dataset(data):  # one by one: a small file can name one long text many times
            if len(each) > LONGEST_NAME:
                raise DatasetError(f"{what} hold a text of {len(each):,} bytes; names are expected.")
            names.append(each.decode())
    return names


def _opened(group: h5py.Group, name: str, where: str) -> tuple[h5py.h5d.DatasetID, tuple[int, ...], np.dtype, int]:
    """An array that lies in the file, its shape and its type, and the bytes that are stored of it."""
    what = f"{where}: {name}"
    check_within(group, name, where)
    try:
        data = h5py.h5d.open(group.id, name.encode())
    except (KeyError, TypeError, ValueError, OSError, RuntimeError) as error:  # no such name, a group, a link astray
        with wrap_dataset_errors(what):
            if group.get(name, getclass=True) is h5py.Group:
                raise DatasetError(
                    f"{what} is a group of {listed(group[name])}; an array of numbers is expected."
                ) from error
        raise DatasetError(f"{where}: has no {name!r}, only {listed(group)}; the file is incomplete.") from error
    with wrap_dataset_errors(what):
        if not _stored_within(data):  # what is there can change without a trace, or be what nobody meant to give away
            raise DatasetError(f"{what} lie in another file; one file that holds everything is accepted.")
        return data, data.shape, data.dtype, data.get_storage_size()


def _check_stored(data: h5py.h5d.DatasetID, shape: tuple[int, ...], dtype: np.dtype, n_stored: int, what: str) -> None:
    """Refuse an array of which less is stored than it claims."""
    n_bytes = math.prod(shape) * dtype.itemsize
    if n_bytes and not n_stored:
        raise DatasetError(f"{what} have shape {shape}, of which nothing has been written; the file is incomplete.")
    check_size(n_bytes, n_stored, what)
    with wrap_dataset_errors(what):
        if n_bytes and data.get_offset() is None:
            _check_chunks(data, shape, what)


def describe_hdf5(group: h5py.Group, name: str, where: str) -> tuple[tuple[int, ...], np.dtype] | None:
    """
    Return shape and type of an array that is not to be read, None where there is none in this file.

    :param group: see :func:`read_hdf5`
    :param name: name of what may be an array
    :param where: the file, for messages
    """
    with contextlib.suppress(Exception):  # over damaged files h5py raises nearly everything
        check_within(group, name, where)
        data = h5py.h5d.open(group.id, name.encode())
        return (data.shape, data.dtype) if _stored_within(data) else None
    return None


def check_within(group: h5py.Group, name: str, where: str) -> None:
    """
    Look at a path's links before HDF5 follows them: to open another file can run into a pipe, and wait for ever.

    :param group: group at which the path starts
    :param name: the path, whether anything is there or not
    :param where: the file and the episode, for messages
    :raises DatasetError: a link leads to another file, or too many follow each other
    """
    with wrap_dataset_errors(f"{where}: {name}"):
        if not _leads_within(group.id, name.encode()):
            raise DatasetError(
                f"{where}: {name!r} lies in another file, or behind links without end; one file that holds all is accepted."
            )


def _leads_within(group: h5py.h5g.GroupID, path: bytes, n_links: int = 0) -> bool:
    here = h5py.h5g.open(group, b"/") if path.startswith(b"/") else group
    parts = [part for part in path.split(b"/") if part not in (b"", b".")]
    for number, part in enumerate(parts, 1):
        if not here.links.exists(part):
            return True
        kind = here.links.get_info(part).type
        if kind == h5py.h5l.TYPE_SOFT:
            path = b"/".join([here.links.get_val(part), *parts[number:]])
            return n_links < MOST_LINKS and _leads_within(here, path, n_links + 1)
        if kind != h5py.h5l.TYPE_HARD:
            return False
        if number < len(parts):
            if h5py.h5o.get_info(here, part).type != h5py.h5o.TYPE_GROUP:
                return True
            here = h5py.h5g.open(here, part)
    return True


def _check_chunks(data: h5py.h5d.DatasetID, shape: tuple[int, ...], what: str) -> None:
    """Refuse chunks that are not there in full: HDF5 fills them with zeros, or with anything that lies in memory."""
    layout = data.get_create_plist()
    if layout.get_layout() != h5py.h5d.CHUNKED:
        return
    chunk = layout.get_chunk()
    n_bytes = math.prod(chunk) * data.get_type().get_size()
    n_chunks = math.prod(-(-length // of_chunk) for length, of_chunk in zip(shape, chunk, strict=True))
    filters = [layout.get_filter(number)[0] for number in range(layout.get_nfilters())]
    if unknown := [UNKNOWN_LENGTH[each] for each in filters if each in UNKNOWN_LENGTH]:
        raise DatasetError(
            f"{what} are stored with the filter {', '.join(unknown)}, by which HDF5 makes up numbers that are missing. gzip "
            "and lzf are accepted: `h5repack -f GZIP=4 OLD NEW` writes gzip."
        )
    n_found = data.get_num_chunks()
    if n_found < n_chunks:
        raise DatasetError(
            f"{what} have shape {shape}, {n_chunks} chunks of {n_bytes} bytes; {n_found} chunks are there: the file is "
            "incomplete."
        )
    data.chunk_iter(lambda info: _check_chunk(data, info, filters, n_bytes, what))


def _check_chunk(data: h5py.h5d.DatasetID, info: h5py.h5d.StoreInfo, filters: list[int], n_bytes: int, what: str) -> None:
    """Compare the bytes of a chunk, unpacked, with those that it should have."""
    passed = {each for number, each in enumerate(filters) if not info.filter_mask >> number & 1}
    n_found = info.size - CHECKSUM * (h5py.h5z.FILTER_FLETCHER32 in passed)
    packed = passed - {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
    if packed == {h5py.h5z.FILTER_DEFLATE}:
        stored = data.read_direct_chunk(info.chunk_offset)[1]
        n_found = len(zlib.decompressobj().decompress(stored, n_bytes))
    elif packed == {h5py.h5z.FILTER_LZF}:
        n_found = _lzf_length(data.read_direct_chunk(info.chunk_offset)[1][:n_found])
    elif packed:  # another library's filter, which knows the length itself
        return
    if n_found < n_bytes:
        at = f"the chunk at {info.chunk_offset}"
        raise DatasetError(f"{what}: {at} holds {n_found} bytes of {n_bytes}; the file is incomplete.")


def _lzf_length(packed: bytes) -> int:
    """Count the bytes that LZF unpacks: runs of up to 32 bytes as they are, and references to up to 264 earlier ones."""
    tokens = LZF_TOKEN.findall(packed)
    first = np.frombuffer(bytes(map(itemgetter(0), tokens)), np.uint8)
    second = np.frombuffer(bytes(map(itemgetter(1), tokens)), np.uint8)
    lengths = np.select([first < 32, first < 224], [first + 1, (first >> 5) + 2], 9 + second.astype(np.int64))
    return int(lengths.sum())


def _stored_within(data: h5py.h5d.DatasetID) -> bool:
    """Return whether the numbers lie in the file that describes them; a virtual array's shape would open other files."""
    if data.get_offset() is not None:
        return True
    layout = data.get_create_plist()
    return layout.get_layout() != h5py.h5d.VIRTUAL and layout.get_external_count() == 0


def open_group(parent: h5py.Group, name: str, where: str) -> h5py.Group:
    """
    A group of the same file.

    :param parent: group that holds it
    :param name: name of the group in `parent`
    :param where: the file, for messages
    :raises DatasetError: there is none, or it lies in another file
    """
    check_within(parent, name, where)
    with wrap_dataset_errors(f"{where}: {name}"):
        group = parent.get(name)
        if not isinstance(group, h5py.Group):
            raise DatasetError(f"{where}: has no group {name!r}, only {listed(parent)}.")
        return group


def listed(group: h5py.Group) -> str:
    """The names in a group, for messages."""
    return ", ".join(map(repr, sorted(group))) or "nothing"
