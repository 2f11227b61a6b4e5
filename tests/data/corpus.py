"""Bad datasets, some hundreds: small good ones of each kind, each with one thing changed, and what should come of it."""

import contextlib
import itertools
import json
import math
import os
import re
import shutil
import signal
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import h5py
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

LENGTHS = (4, 6, 5)
DAMAGED = 1  # the episode that is changed
N_STEPS, N_OBSERVATIONS, N_ACTIONS = sum(LENGTHS), 3, 2
MINARI_ID = "corpus/set-v0"
DATA_FOLDER = Path("datasets") / MINARI_ID / "data"
LEROBOT_INFO, LEROBOT_DATA = Path("meta/info.json"), Path("data/chunk-000/file-000.parquet")
ARM, ZARR, ZARR_CHUNK = Path("arm"), Path("set.zarr"), 4  # folders, and rows of a chunk
MOST_SECONDS = 5  # to read a dataset, or to refuse it
# Results of reading: the good dataset's numbers, or other numbers.
SAME, READ = "same", "read"
SPARSE = 10**12  # rows


class Case(NamedTuple):
    """
    One bad dataset.

    :param name: what is wrong with it
    :param good: which good dataset it is made from
    :param change: makes it bad, given the folder of the copy
    :param dataset: what is loaded, a path in the folder or a Minari id
    :param expected: SAME, READ, or words of the message that refuses it
    """

    name: str
    good: str
    change: Callable[[Path], object]
    dataset: str
    expected: str | tuple[str, ...]


class Hang(BaseException):
    """No reader may take it for an error of the file."""


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    """
    Break off what waits, such as for a pipe without a writer.

    :raises Hang: after MOST_SECONDS
    """

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hang

    usual = signal.signal(signal.SIGALRM, ring)
    signal.alarm(MOST_SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, usual)


# ---------------------------------------------------------------------------------------------------------- good ones


def episodes() -> Iterator[dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    for n_steps in LENGTHS:
        yield {
            "observations": rng.normal(size=(n_steps + 1, N_OBSERVATIONS)),
            "actions": rng.uniform(-1, 1, (n_steps, N_ACTIONS)),
            "rewards": rng.normal(size=n_steps),
            "terminations": np.zeros(n_steps, bool),
            "truncations": np.arange(n_steps) == n_steps - 1,
        }


def write_good(folder: Path, monkeypatch: Any) -> None:
    """One good dataset of each kind, in a folder of its own below `folder`."""
    for data_format in ("hdf5", "arrow", "parquet"):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / data_format / "datasets"))
        (folder / data_format / "datasets").mkdir(parents=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            minari.create_dataset_from_buffers(
                MINARI_ID,
                [EpisodeBuffer(**episode) for episode in episodes()],
                observation_space=spaces.Box(-np.inf, np.inf, (N_OBSERVATIONS,), np.float64),
                action_space=spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float64),
                data_format=data_format,
                ref_min_score=0.0,
                ref_max_score=1.0,
            )
    (folder / "robomimic").mkdir()
    with h5py.File(folder / "robomimic" / "set.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = N_STEPS
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_version": "1.5.1", "env_kwargs": {}})
        for number, episode in enumerate(episodes()):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = len(episode["actions"])
            demo["obs/state"] = episode["observations"][:-1]
            demo["actions"], demo["rewards"] = episode["actions"], episode["rewards"]
            demo["dones"] = episode["truncations"].astype(np.int64)
        file["mask/train"] = np.array([b"demo_0", b"demo_1", b"demo_2"])
    (folder / "npz").mkdir()
    np.savez(folder / "npz" / "set.npz", **flat_arrays())
    (folder / "flat").mkdir()
    with h5py.File(folder / "flat" / "set.hdf5", "w") as file:
        for name, array in d4rl_arrays().items():
            file[name] = array
    write_lerobot(folder / "lerobot" / ARM)
    write_zarr(folder / "zarr" / ZARR)
    for kind in ("csv", "table"):
        (folder / kind).mkdir()
    columns = table_columns()
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    (folder / "csv" / "set.csv").write_text("\n".join(lines))
    pyarrow.parquet.write_table(pa.table(columns), folder / "table" / "set.parquet")


def table_columns() -> dict[str, np.ndarray]:
    arrays = flat_arrays()
    columns = {f"obs_{i}": column for i, column in enumerate(arrays["observations"].T)}
    columns |= {f"action_{i}": column for i, column in enumerate(arrays["actions"].T)}
    return {**columns, "reward": arrays["rewards"], "episode": np.repeat(np.arange(len(LENGTHS)), LENGTHS)}


def write_lerobot(folder: Path) -> None:
    arrays = flat_arrays()
    features = {
        "observation.state": arrays["observations"], "action": arrays["actions"], "next.reward": arrays["rewards"],
        "frame_index": np.concatenate([np.arange(n) for n in LENGTHS]),
        "episode_index": np.repeat(np.arange(len(LENGTHS)), LENGTHS),
    }  # fmt: skip
    told = {name: {"dtype": str(array.dtype), "shape": array.shape[1:] or [1]} for name, array in features.items()}
    for file in (LEROBOT_INFO, LEROBOT_DATA):
        (folder / file).parent.mkdir(parents=True)
    counts = {"total_frames": N_STEPS, "total_episodes": len(LENGTHS)}
    (folder / LEROBOT_INFO).write_text(json.dumps({"codebase_version": "v3.0", **counts, "features": told}))
    pyarrow.parquet.write_table(pa.table({name: list(array) for name, array in features.items()}), folder / LEROBOT_DATA)


def d4rl_arrays() -> dict[str, np.ndarray]:
    names = {"terminations": "terminals", "truncations": "timeouts"}
    return {names.get(name, name): array for name, array in flat_arrays().items() if name != "episode_ends"}


def zarr_arrays() -> dict[str, np.ndarray]:
    arrays = flat_arrays()
    ends = arrays.pop("episode_ends")
    names = {"observations": "state", "actions": "action", "rewards": "reward"}
    return {**{f"data/{names.get(name, name)}": array for name, array in arrays.items()}, "meta/episode_ends": ends}


def write_zarr(folder: Path) -> None:
    """Format 2, whose every chunk is a file of its own."""
    for group in (folder, folder / "data", folder / "meta"):
        group.mkdir(parents=True)
        (group / ".zgroup").write_text(json.dumps({"zarr_format": 2}))
    for name, array in zarr_arrays().items():
        write_zarr_array(folder / name, array)


def write_zarr_array(folder: Path, array: np.ndarray, compressed: bool = False) -> None:
    folder.mkdir()
    chunks = (ZARR_CHUNK, *(max(1, n) for n in array.shape[1:]))[: array.ndim]
    told = {"zarr_format": 2, "shape": array.shape, "chunks": chunks, "order": "C", "fill_value": 0, "filters": None,
            "dtype": array.dtype.descr if array.dtype.names else array.dtype.str,
            "compressor": {"id": "zlib", "level": 1} if compressed else None}  # fmt: skip
    (folder / ".zarray").write_text(json.dumps(told))
    for number in range(-(-len(array) // ZARR_CHUNK) if array.ndim else 1):
        part = array[number * ZARR_CHUNK :][:ZARR_CHUNK] if array.ndim else array
        chunk = np.zeros(chunks, array.dtype)
        chunk[tuple(map(slice, part.shape))] = part
        content = zlib.compress(chunk.tobytes()) if compressed else chunk.tobytes()
        (folder / ".".join([str(number), *"0" * (array.ndim - 1)])).write_bytes(content)


def flat_arrays() -> dict[str, np.ndarray]:
    arrays = {key: np.concatenate([episode[key][:n] for n, episode in zip(LENGTHS, episodes(), strict=True)]) for key in
              ("observations", "actions", "rewards", "terminations", "truncations")}  # fmt: skip
    return {**arrays, "episode_ends": np.cumsum(LENGTHS)}


# ------------------------------------------------------------------------------------------------------------- arrays


def with_first(array: np.ndarray, value: float) -> np.ndarray:
    array = array.astype(np.float64)
    array.flat[0] = value
    return array


def records(array: np.ndarray) -> np.ndarray:
    return np.array([(1.0, 2.0)] * len(array), dtype=[("x", "f8"), ("y", "f8")])


# Changes to an array, and the expected result of reading the dataset; None expects a refusal.
CHANGED: dict[str, tuple[Callable[[np.ndarray], Any], str | None]] = {
    "float16": (lambda a: a.astype(np.float16), READ),
    "float32": (lambda a: a.astype(np.float32), READ),
    "long double": (lambda a: a.astype(np.longdouble), SAME),
    "big-endian": (lambda a: a.astype(">f8"), SAME),
    "integers": (lambda a: a.astype(np.int64), READ),
    "small integers": (lambda a: a.astype(np.int8), READ),
    "complex": (lambda a: a.astype(np.complex128), None),
    "complex of 64 bits": (lambda a: a + 1j * a.astype(np.float32), None),
    "words": (lambda a: a.astype("S8"), None),
    "records": (records, None),
    "nan": (lambda a: with_first(a, np.nan), None),
    "inf": (lambda a: with_first(a, np.inf), None),
    "-inf": (lambda a: with_first(a, -np.inf), None),
    "too large": (lambda a: with_first(a, 1e39), None),
    "row less": (lambda a: a[:-1], None),
    "two rows less": (lambda a: a[:-2], None),
    "row more": (lambda a: np.concatenate([a, a[-1:]]), None),
    "rows twice": (lambda a: np.concatenate([a, a]), None),
    "no row": (lambda a: a[:0], None),
    "scalar": (lambda a: a.flat[0], None),
    "one more axis": (lambda a: np.stack([a, a], axis=-1), None),
    "axis before": (lambda a: a[None], None),
    "transposed": (lambda a: a.reshape(len(a), -1).T, None),
    "column more": (lambda a: np.concatenate([a.reshape(len(a), -1)] * 2, axis=1), None),
    "no column": (lambda a: a.reshape(len(a), -1)[:, :0], None),
}


def replace(file: h5py.File, path: str, write: Callable[[np.ndarray], object]) -> None:
    array = file[path][()]
    del file[path]
    write(array)


def claims(n_written: int) -> Callable[[h5py.File, str, Path], object]:
    """An array that says it has a million million rows, of which some are there."""

    def change(file: h5py.File, path: str, folder: Path) -> None:
        array = file[path][()]
        del file[path]
        data = file.create_dataset(path, (SPARSE, *array.shape[1:]), array.dtype, chunks=(8, *array.shape[1:]))
        data[:n_written] = array[:n_written]

    return change


def virtual(file: h5py.File, path: str, folder: Path) -> None:
    array = outside(folder, file[path][()])
    del file[path]
    layout = h5py.VirtualLayout(array.shape, array.dtype)
    layout[...] = h5py.VirtualSource(str(folder / "other.hdf5"), "array", array.shape)
    file.create_virtual_dataset(path, layout)


def outside(folder: Path, array: np.ndarray) -> np.ndarray:
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["array"] = array
    array.tofile(folder / "other.bin")
    return array


def put(value: Callable[[Path, np.ndarray], Any]) -> Callable[[h5py.File, str, Path], object]:
    def change(file: h5py.File, path: str, folder: Path) -> None:
        array = outside(folder, file[path][()])
        del file[path]
        file[path] = value(folder, array)

    return change


def recreate(**kwargs: Any) -> Callable[[h5py.File, str, Path], object]:
    def change(file: h5py.File, path: str, folder: Path) -> None:
        replace(file, path, lambda array: file.create_dataset(path, data=array, **kwargs))

    return change


def external_storage(file: h5py.File, path: str, folder: Path) -> None:
    array = outside(folder, file[path][()])
    del file[path]
    file.create_dataset(path, array.shape, array.dtype, external=[(str(folder / "other.bin"), 0, array.nbytes)])


def unwritten(file: h5py.File, path: str, folder: Path) -> None:
    replace(file, path, lambda array: file.create_dataset(path, array.shape, array.dtype))


def pipe(folder: Path) -> str:
    """A pipe without a writer, so that whoever opens it waits for ever."""
    os.mkfifo(folder / "pipe")
    return str(folder / "pipe")


def link_through_pipe(file: h5py.File, path: str, folder: Path) -> None:
    del file[path]
    file["/elsewhere"] = h5py.ExternalLink(pipe(folder), "/")
    file[path] = h5py.SoftLink("/elsewhere/array")


def virtual_over_pipe(file: h5py.File, path: str, folder: Path) -> None:
    """Make the array a virtual one with as many rows as the pipe's file has."""
    array = file[path][()]
    del file[path]
    shapes = dict(shape=array.shape, maxshape=(None, *array.shape[1:]))
    layout, everything = h5py.VirtualLayout(dtype=array.dtype, **shapes), slice(0, h5py.h5s.UNLIMITED)
    layout[everything] = h5py.VirtualSource(str(folder / "pipe"), "array", dtype=array.dtype, **shapes)[everything]
    file.create_virtual_dataset(path, layout)
    file.flush()
    pipe(folder)


def some_chunks(file: h5py.File, path: str, folder: Path) -> None:
    array = file[path][()]
    del file[path]
    data = file.create_dataset(path, array.shape, array.dtype, chunks=(2, *array.shape[1:]), fillvalue=0)
    data[:4] = array[:4]


def short_chunk(
    stored: bytes, filter_mask: int = 0, overlong: bool = False, **filters: Any
) -> Callable[[h5py.File, str, Path], object]:
    """One chunk has a byte of its many; `overlong`: another one has more than it needs."""

    def change(file: h5py.File, path: str, folder: Path) -> None:
        array = file[path][()]
        del file[path]
        chunks = (2, *array.shape[1:])
        data = file.create_dataset(path, data=array, chunks=chunks, **filters)
        data.id.write_direct_chunk((0,) * array.ndim, stored, filter_mask)
        if overlong:
            data.id.write_direct_chunk((2,) + (0,) * (array.ndim - 1), bytes(3 * data[:2].nbytes))

    return change


def cut_chunk(**filters: Any) -> Callable[[h5py.File, str, Path], object]:
    """Filters that fill a chunk up from a few of its bytes, where others tell that it is cut."""

    def change(file: h5py.File, path: str, folder: Path) -> None:
        array = file[path][()]
        del file[path]
        options = dict(chunks=(8, *array.shape[1:]), maxshape=(None, *array.shape[1:]), **filters)
        data = file.create_dataset(path, data=array.astype(np.uint8) if array.dtype == bool else array, **options)
        first = (0,) * array.ndim
        data.id.write_direct_chunk(first, data.id.read_direct_chunk(first)[1][:8])

    return change


def linked(file: h5py.File, path: str, folder: Path) -> None:
    file.move(path, "/elsewhere")
    file[path] = h5py.SoftLink("/elsewhere")


HDF5: dict[str, tuple[Callable[[h5py.File, str, Path], object], str | None]] = {
    "missing": (lambda file, path, folder: file.__delitem__(path), None),
    "a group": (lambda file, path, folder: replace(file, path, lambda _: file.create_group(path)), None),
    "link within": (linked, SAME),
    "link into nothing": (put(lambda folder, array: h5py.SoftLink("/nowhere")), None),
    "link to another file": (put(lambda folder, array: h5py.ExternalLink(str(folder / "other.hdf5"), "array")), None),
    "link to no file": (put(lambda folder, array: h5py.ExternalLink("/none.hdf5", "array")), None),
    "link to a device": (put(lambda folder, array: h5py.ExternalLink("/dev/zero", "array")), None),
    "link to a pipe": (put(lambda folder, array: h5py.ExternalLink(pipe(folder), "array")), None),
    "link through a pipe": (link_through_pipe, None),
    "virtual over a pipe": (virtual_over_pipe, None),
    "some chunks unwritten": (some_chunks, None),
    "a short chunk": (short_chunk(b"1"), None),
    "a short and a long chunk": (short_chunk(b"1", overlong=True), None),
    "a short shuffled chunk": (short_chunk(b"1", shuffle=True), None),
    "a short compressed chunk": (short_chunk(zlib.compress(b"1"), compression="gzip"), None),
    "a short lzf chunk": (short_chunk(b"\x001", compression="lzf"), None),
    "a short chunk beside lzf": (short_chunk(b"1", filter_mask=1, compression="lzf"), None),
    "a cut szip chunk": (cut_chunk(compression="szip"), None),
    "a cut scaleoffset chunk": (cut_chunk(scaleoffset=4), None),
    "storage in another file": (external_storage, None),
    "virtual": (virtual, None),
    "unwritten": (unwritten, None),
    "claimed": (claims(0), None),
    "claimed but some": (claims(4), None),
    "of no shape": (put(lambda folder, array: h5py.Empty("f8")), None),
    "compressed": (recreate(compression="gzip", chunks=True), SAME),
    "in chunks": (recreate(chunks=True), SAME),
    "with checksums": (recreate(fletcher32=True, chunks=True), SAME),
    "lzf": (recreate(compression="lzf", chunks=True, shuffle=True, fletcher32=True), SAME),
    "references": (
        lambda file, path, folder: replace(
            file, path, lambda array: file.create_dataset(path, data=[file.ref] * len(array), dtype=h5py.ref_dtype)
        ),
        None,
    ),
    "objects": (put(lambda folder, array: np.array(["a"] * len(array), h5py.string_dtype())), None),
}


def link_to_itself(file: h5py.File, path: str, folder: Path) -> None:
    del file[path]
    file[path] = h5py.SoftLink("/" + path)


HDF5["link to itself"] = (link_to_itself, None)


def hdf5_change(file_name: Path, path: str, change: Callable[[h5py.File, str, Path], object]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        with warnings.catch_warnings(), h5py.File(folder / file_name, "a") as file:
            warnings.simplefilter("ignore")
            change(file, path, folder)

    return apply


def of_array(make: Callable[[np.ndarray], Any]) -> Callable[[h5py.File, str, Path], object]:
    return lambda file, path, folder: replace(file, path, lambda array: file.__setitem__(path, make(array)))


MINARI_FIELDS = ("observations", "actions", "rewards", "terminations", "truncations")
# Fields with another result than their row above: they are optional, or their shape may be another.
EXCEPTIONS: dict[tuple[str, str, str], str | tuple[str, ...] | None] = {
    ("hdf5", "observations", "row less"): SAME,  # the last one is not needed
    ("hdf5", "terminations", "column more"): None,
    **{("robomimic", field, "missing"): READ for field in ("rewards", "dones")},
    **{("robomimic", field, "no column"): None for field in ("rewards", "dones")},
    **{(kind, field, name): READ for kind in ("hdf5", "robomimic", "npz", "zarr") for field in
       ("terminations", "truncations", "dones") for name in ("float16", "float32", "integers", "small integers")},
    **{("flat", field, name): READ for field in ("terminals", "timeouts") for name in
       ("float16", "float32", "integers", "small integers")},
    ("flat", "terminals", "missing"): SAME,
    ("flat", "rewards", "missing"): READ,
    ("flat", "actions", "missing"): ("set.hdf5", "has no group 'data', only 'observations'"),  # as robomimic's files have
    **{("npz", field, "missing"): READ for field in ("rewards", "terminations", "truncations", "episode_ends")},
    **{(kind, "episode_ends", name): SAME for kind in ("npz", "zarr") for name in
       ("float16", "float32", "integers", "small integers")},
    # (N, ...) is accepted
    **{(kind, field, name): READ for kind, field in (("npz", "observations"), ("flat", "observations"), ("zarr", "state"))
       for name in ("one more axis", "column more")},
    **{(kind, field, "column more"): READ for kind, field in (("npz", "actions"), ("flat", "actions"), ("zarr", "action"))},
    ("robomimic", "obs/state", "flat"): READ,
    **{("lerobot", field, name): READ for field in ("observation.state", "action") for name in ("wider", "flat")},
    **{("table", field, "missing"): READ for field in ("obs_0", "action_0", "reward")},
    ("table", "obs_0", "lists"): READ,
    # An episode's name may be anything.
    **{("table", "episode", name): READ for name in ("words", "dates", "too large")},
    **{("csv", "episode", name): READ for name in
       ("too large", "a word", "a hexadecimal number", "a comma", "a control character")},
    **{("zarr", "reward", name): READ for name in ("missing", "a group")},
    **{("zarr", field, name): SAME for field in ("terminations", "truncations") for name in ("missing", "a group")},
    **{("zarr", "episode_ends", name): None for name in
       ("a chunk unwritten", "nothing written", "a chunk is a link into nothing")},
    ("zarr, chunk", "file", "cut off early"): SAME,  # it has less than that
    **{("zarr, chunk", "file", name): READ for name in ("of zeros", "zeroed in the middle", "is a folder", "is missing")},
}  # fmt: skip


def expected(kind: str, field: str, name: str, usual: str | None, words: tuple[str, ...]) -> str | tuple[str, ...]:
    return EXCEPTIONS.get((kind, field, name), usual) or words


def hdf5_cases() -> Iterator[Case]:
    places = [
        *(("hdf5", f"episode_{DAMAGED}/{field}", field, f"episode {DAMAGED}", MINARI_ID, DATA_FOLDER / "main_data.hdf5")
          for field in MINARI_FIELDS),
        *(("robomimic", f"data/demo_{DAMAGED}/{field}", field, f"demo_{DAMAGED}", "set.hdf5", Path("set.hdf5"))
          for field in ("obs/state", "actions", "rewards", "dones")),
        *(("flat", field, field, "set.hdf5", "set.hdf5", Path("set.hdf5")) for field in d4rl_arrays()),
    ]  # fmt: skip
    changes = {**{name: (of_array(make), usual) for name, (make, usual) in CHANGED.items()}, **HDF5}
    for (kind, path, field, episode, dataset, file), (name, (change, usual)) in itertools.product(places, changes.items()):
        said = (file.name, episode, "state|observation" if field == "obs/state" else field[:-1])
        outcome = expected(kind, field, name, usual, said)
        yield Case(f"{kind}, {field}: {name}", kind, hdf5_change(file, path, change), dataset, outcome)


# ---------------------------------------------------------------------------------------------------------------- npz


def npz_change(field: str, make: Callable[[np.ndarray], Any]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        arrays = flat_arrays()
        value = make(arrays[field])
        np.savez(folder / "set.npz", **({name: array for name, array in arrays.items() if name != field} if value is None
                                        else {**arrays, field: value}))  # fmt: skip

    return apply


def npz_arrays(**arrays: Any) -> Callable[[Path], object]:
    changed = {**flat_arrays(), **arrays}
    kept = {name: array for name, array in changed.items() if array is not None}
    return lambda folder: np.savez(folder / "set.npz", **kept)


def npz_member(name: str, content: bytes, compressed: bool = False) -> Callable[[Path], object]:
    """One member of the archive is other bytes."""

    def apply(folder: Path) -> None:
        with zipfile.ZipFile(folder / "set.npz") as archive:
            members = {each: archive.read(each) for each in archive.namelist()}
        members[name] = content
        with zipfile.ZipFile(folder / "set.npz", "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED) as archive:
            for each, data in members.items():
                archive.writestr(each, data)

    return apply


def header(shape: str, dtype: str = "'<f8'", version: bytes = b"\x01\x00") -> bytes:
    text = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text


def npz_cases() -> Iterator[Case]:
    fields = (*MINARI_FIELDS, "episode_ends")
    changes: dict[str, tuple[Callable[[np.ndarray], Any], str | None]] = {
        **CHANGED,
        "missing": (lambda a: None, None),
        "objects": (lambda a: np.array([print] * len(a)), None),
        "dates": (lambda a: np.arange(len(a)).astype("M8[s]"), None),
        "unicode": (lambda a: np.array(["a"] * len(a)), None),
    }
    for field, (name, (make, usual)) in itertools.product(fields, changes.items()):
        outcome = expected("npz", field, name, usual, ("set.npz", field[:-1]))
        yield Case(f"npz, {field}: {name}", "npz", npz_change(field, make), "set.npz", outcome)
    ends: dict[str, tuple[Any, str | tuple[str, ...]]] = {
        "not ascending": ([4, 3, 15], ("episode_ends", "episode 1")),
        "descending, unsigned": (np.array([9, 4, 15], np.uint64), ("episode_ends", "episode 1")),
        "negative": ([-4, 10, 15], ("episode_ends", "episode 0")),
        "beyond the data": ([4, 10, 99], ("episode_ends", "episode 2")),
        "too early": ([4, 10], ("episode_ends", "10 steps")),
        "an empty episode": ([4, 4, 15], ("episode_ends", "episode 1")),
        "from zero": ([0, 4, 10, 15], ("episode_ends", "episode 0")),
        "halves": ([4.5, 10.0, 15.0], ("episode_ends", "whole")),
        "nan": ([4.0, np.nan, 15.0], ("episode_ends",)),
        "whole floats": ([4.0, 10.0, 15.0], SAME),
        "a column": (np.array([[4], [10], [15]]), SAME),
        "a square": (np.array([[4, 10], [12, 15]]), ("episode_ends", "whole")),
        "a number": (15, ("episode_ends",)),
        "none": (np.zeros(0, int), ("episode_ends",)),
        "around the corner": (np.array([2**63 - 1, -(2**63), 15]), ("episode_ends", "episode 0")),
        "too large": (np.array([4, 2**64 - 1, 15], np.uint64), ("episode_ends",)),
        "flags": (np.array([True, True, True]), ("episode_ends",)),
    }
    for name, (value, outcome) in ends.items():
        words = outcome if isinstance(outcome, str) else ("set.npz", *outcome)
        yield Case(f"npz, ends: {name}", "npz", npz_arrays(episode_ends=np.asarray(value)), "set.npz", words)
    lengths: dict[str, tuple[Any, str | tuple[str, ...]]] = {
        "alone": (dict(episode_ends=None, episode_lengths=LENGTHS), SAME),
        "that agree": (dict(episode_lengths=LENGTHS), SAME),
        "that do not agree": (dict(episode_lengths=[5, 5, 5]), ("episode_ends", "episode_lengths")),
        "negative": (dict(episode_ends=None, episode_lengths=[20, -10, 5]), ("episode_lengths", "episode 0")),
        "zero": (dict(episode_ends=None, episode_lengths=[15, 0]), ("episode_lengths", "episode 1")),
        "around the corner": (dict(episode_ends=None, episode_lengths=[2**63 - 1, 2**63 - 1, 17]), ("episode_lengths",)),
        "too few": (dict(episode_ends=None, episode_lengths=[4, 6]), ("episode_lengths", "10 steps")),
        "too many": (dict(episode_ends=None, episode_lengths=[4, 6, 5, 5]), ("episode_lengths", "20 steps")),
        "small, unsigned": (dict(episode_ends=None, episode_lengths=np.array(LENGTHS, np.uint8)), SAME),
    }
    for name, (changed, outcome) in lengths.items():
        words = outcome if isinstance(outcome, str) else ("set.npz", *outcome)
        made = npz_arrays(**{key: None if value is None else np.asarray(value) for key, value in changed.items()})
        yield Case(f"npz, lengths: {name}", "npz", made, "set.npz", words)
    rewards = np.array([3e38] * N_STEPS)
    yield Case("npz: overflowing return", "npz", npz_arrays(rewards=rewards), "set.npz", ("set.npz", "episode 0", "rewards"))
    yield Case("npz: overflowing from float32", "npz", npz_arrays(rewards=rewards.astype(np.float32)), "set.npz",
               ("set.npz", "episode 0", "rewards"))  # fmt: skip
    yield Case("npz: overflow that cancels", "npz", npz_arrays(rewards=np.array([3e38, -3e38] * 7 + [0.0])), "set.npz", READ)
    yield Case("npz: no step", "npz", npz_arrays(actions=np.zeros((0, 2))), "set.npz", ("set.npz", "actions"))
    yield Case("npz: no end", "npz", npz_arrays(episode_ends=None, terminations=None, truncations=None), "set.npz",
               ("set.npz", "episode_ends"))  # fmt: skip
    yield Case("npz: actions out of bounds", "npz", npz_arrays(actions=np.full((N_STEPS, 2), 3.0)), "set.npz",
               ("set.npz", "episode 0", "action"))  # fmt: skip
    members = {
        "no array": b"no array",
        "nothing": b"",
        "pickle": b"\x80\x04K\x01.",
        "header cut off": header("(15,)")[:40],
        "cut off": header("(15,)") + bytes(64),
        "too long": header("(15,)") + bytes(256),
        "huge": header(f"({SPARSE},)") + bytes(120),
        "huge and wide": header(f"(15, {SPARSE})") + bytes(120),
        "negative": header("(-15,)") + bytes(120),
        "negative twice": header("(-15, -1)") + bytes(120),
        "no numbers for a shape": header("('a',)") + bytes(120),
        "floats for a shape": header("(15.0,)") + bytes(120),
        "truth for a shape": header("(True,)") + bytes(8),
        "objects": header("(15,)", "'|O'") + b"\x80\x04K\x01.",
        "a call for a type": header("(15,)", "print(1)") + bytes(120),
        "no type": header("(15,)", "'nonsense'") + bytes(120),
        "rows in rows": header("(15,)", "('<f8', (1000000000,))") + bytes(120),
        "version 9": header("(15,)", version=b"\x09\x00") + bytes(120),
        "a header like a bomb": header("(15,)", "[" * 5000) + bytes(120),
    }
    for name, content in members.items():
        yield Case(f"npz, member: {name}", "npz", npz_member("rewards.npy", content), "set.npz", ("set.npz", "rewards"))
    bomb = header(f"({2**20}, 8)") + bytes(2**26)
    yield Case(
        "npz: bomb", "npz", npz_member("observations.npy", bomb, compressed=True), "set.npz", ("set.npz", "observations")
    )


# ------------------------------------------------------------------------------------------------------ files, metadata


def whole_file(change: Callable[[bytes], bytes], file: str | Path) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_bytes(change((folder / file).read_bytes()))


def to_folder(file: str | Path) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        (folder / file).unlink()
        (folder / file).mkdir()

    return apply


def zeroed(content: bytes) -> bytes:
    return content[: len(content) // 3] + bytes(len(content) // 3) + content[2 * len(content) // 3 :]


FILES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "of one byte": lambda content: content[:1],
    "cut off early": lambda content: content[:100],
    "cut off in the middle": lambda content: content[: len(content) // 2],
    "cut off late": lambda content: content[:-10],
    "of zeros": lambda content: bytes(len(content)),
    "words": lambda content: b"no dataset",
    "a script": lambda content: b"#!/bin/sh\necho\n",
    "reversed": lambda content: content[::-1],
    "zeroed in the middle": zeroed,
}


def to_pipe(file: str | Path) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        (folder / file).unlink()
        os.mkfifo(folder / file)

    return apply


def to_link(file: str | Path, target: str | Path = "elsewhere") -> Callable[[Path], object]:
    """Move a file, or a folder, and have a link in its place; `target` is below the folder of the copy."""

    def apply(folder: Path) -> None:
        (folder / file).rename(folder / target)
        (folder / file).symlink_to(folder / target)

    return apply


class Place(NamedTuple):
    """
    A file of a good dataset.

    :param good: which one
    :param file: path in its folder
    :param dataset: what is loaded, as in :class:`Case`
    :param said: words of the message that refuses it
    """

    good: str
    file: Path
    dataset: str
    said: str


PLACES = {
    "npz": Place("npz", Path("set.npz"), "set.npz", "set.npz"),
    "robomimic": Place("robomimic", Path("set.hdf5"), "set.hdf5", "set.hdf5"),
    "flat": Place("flat", Path("set.hdf5"), "set.hdf5", "set.hdf5"),
    "csv": Place("csv", Path("set.csv"), "set.csv", "set.csv"),
    "table": Place("table", Path("set.parquet"), "set.parquet", "set.parquet"),
    "hdf5": Place("hdf5", DATA_FOLDER / "main_data.hdf5", MINARI_ID, "main_data.hdf5"),
    "metadata": Place("hdf5", DATA_FOLDER / "metadata.json", MINARI_ID, "metadata.json"),
    "arrow": Place("arrow", DATA_FOLDER / "1" / "part-0.arrow", MINARI_ID, "episode 1|data/1/part-0"),
    "parquet": Place("parquet", DATA_FOLDER / "1" / "part-0.parquet", MINARI_ID, "episode 1|data/1/part-0"),
    "lerobot": Place("lerobot", ARM / LEROBOT_DATA, str(ARM), "file-000.parquet|below data"),
    "lerobot, info": Place("lerobot", ARM / LEROBOT_INFO, str(ARM), "info.json|arm"),
    "zarr, metadata": Place("zarr", ZARR / "data/action/.zarray", str(ZARR), "set.zarr.*action"),
    "zarr, chunk": Place("zarr", ZARR / "data/action/1.0", str(ZARR), "set.zarr.*action"),
}


def file_cases() -> Iterator[Case]:
    for (place, (good, file, dataset, said)), (name, change) in itertools.product(PLACES.items(), FILES.items()):
        outcome = expected(place, "file", name, None, (said,))
        yield Case(f"{place}: {name}", good, whole_file(change, file), dataset, outcome)
    for place, (good, file, dataset, said) in PLACES.items():
        makes = {
            "is a folder": to_folder(file),
            "is missing": lambda folder, file=file: (folder / file).unlink(),
            "is a pipe": to_pipe(file),
        }
        if dataset != str(file):
            makes["is a link out of the folder"] = to_link(file)
        for name, make in makes.items():
            yield Case(f"{place}: {name}", good, make, dataset, expected(place, "file", name, None, (said,)))


def metadata_change(**changes: Any) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        path = folder / DATA_FOLDER / "metadata.json"
        metadata = {**json.loads(path.read_text()), **changes}
        path.write_text(json.dumps({name: value for name, value in metadata.items() if value is not MISSING}))

    return apply


MISSING = object()
NO_STRINGS: dict[str, Any] = {
    "missing": MISSING,
    "null": None,
    "a number": 3,
    "a list": ["Box"],
    "an object": {},
    "true": True,
}
OLD = ("data_format", "missing")  # as in Minari's first versions
NO_COUNTS: dict[str, Any] = {"missing": MISSING, "null": None, "a word": "3", "a fraction": 3.5, "negative": -1,
                             "true": True, "NaN": math.nan, "infinite": math.inf, "huge": SPARSE, "beyond 64 bits": 2**70,
                             "one more": "+1", "one less": "-1", "none": 0, "a list": [3]}  # fmt: skip
NO_SPACES: dict[str, Any] = {
    "empty": "",
    "a word": "Box",
    "a list": "[]",
    "null": "null",
    "no type": "{}",
    "unknown": {"type": "Graph"},
    "a list for a type": {"type": []},
    "no bounds": {"type": "Box", "dtype": "float64", "shape": [3]},
    "no shape": {"type": "Box", "dtype": "float64", "low": -1, "high": 1},
    "other shape": {"type": "Box", "dtype": "float64", "shape": [3, 3], "low": [-1] * 3, "high": [1] * 3},
    "huge shape": {"type": "Box", "dtype": "float64", "shape": [10**9], "low": -1, "high": 1},
    "huge twice": {"type": "Box", "dtype": "float64", "shape": [10**6, 10**6], "low": -1, "high": 1},
    "negative shape": {"type": "Box", "dtype": "float64", "shape": [-3], "low": -1, "high": 1},
    "fraction": {"type": "Box", "dtype": "float64", "shape": [2.5], "low": -1, "high": 1},
    "objects": {"type": "Box", "dtype": "object", "shape": [3], "low": [-1] * 3, "high": [1] * 3},
    "words": {"type": "Box", "dtype": "float64", "shape": [3], "low": ["a"] * 3, "high": ["b"] * 3},
    "unknown dtype": {"type": "Box", "dtype": "f9", "shape": [3], "low": [-1] * 3, "high": [1] * 3},
    "low above high": {"type": "Box", "dtype": "float64", "shape": [3], "low": [1] * 3, "high": [-1] * 3},
    "NaN bounds": {"type": "Box", "dtype": "float64", "shape": [3], "low": [math.nan] * 3, "high": [math.nan] * 3},
    "images": {"type": "Box", "dtype": "uint8", "shape": [40, 40, 3], "low": 0, "high": 255},
    "huge Discrete": {"type": "Discrete", "dtype": "int64", "n": 10**10, "start": 0},
    "negative Discrete": {"type": "Discrete", "dtype": "int64", "n": -3, "start": 0},
    "huge MultiDiscrete": {"type": "MultiDiscrete", "dtype": "int64", "nvec": [10**10, 2], "start": [0, 0]},
    "huge MultiBinary": {"type": "MultiBinary", "n": 10**10},
    "empty Dict": {"type": "Dict", "subspaces": {}},
    "Dict of nothing": {"type": "Dict"},
    "empty Tuple": {"type": "Tuple", "subspaces": []},
    "nested deeply": '{"type": "Tuple", "subspaces": [' * 5000 + "]}" * 5000,
    "text": {"type": "Text", "max_length": 3, "min_length": 1, "charset": "abc"},
}
NO_SPECS: dict[str, Any] = {"empty": "", "a word": "Hopper", "a list": "[]", "null": "null", "no id": "{}", "a number": 3,
                            "an object": {}, "other fields": '{"id": "A-v0", "additional_wrappers": [], "new": 1}',
                            "a number for an id": '{"id": 3, "entry_point": "a:b", "additional_wrappers": []}'}  # fmt: skip
NO_SCORES: dict[str, Any] = {"a word": "best", "a list": [1], "NaN": math.nan, "infinite": math.inf, "true": True}
NO_METADATA: dict[str, bytes] = {
    "no JSON": b"{", "a list": b"[]", "a number": b"3", "null": b"null", "a word": b'"a"',
    "an empty object": b"{}",
    "bytes": bytes(range(256)), "nested deeply": b"[" * 100_000, "many digits": b'{"total_steps": ' + b"9" * 10_000 + b"}",
    "UTF-16": '{"a": 1}'.encode("utf-16"),
}  # fmt: skip


def metadata_cases() -> Iterator[Case]:
    def case(name: str, value: Any, field: str, outcome: str | tuple[str, ...] = ()) -> Case:
        words = (
            outcome
            if isinstance(outcome, str)
            else ("metadata.json|main_data", "steps" if field == "total_steps" else field, *outcome)
        )
        return Case(f"metadata, {field}: {name}", "hdf5", metadata_change(**{field: value}), MINARI_ID, words)

    for field in ("dataset_id", "minari_version", "data_format", "observation_space", "action_space"):
        yield from (case(name, value, field) for name, value in NO_STRINGS.items() if (field, name) != OLD)
    yield case("missing", MISSING, "data_format")._replace(expected=SAME)
    for field, right in {"total_episodes": len(LENGTHS), "total_steps": N_STEPS}.items():
        for name, value in NO_COUNTS.items():
            yield case(name, right + int(value) if value in ("+1", "-1") else value, field)
    for field, (name, space) in itertools.product(("observation_space", "action_space"), NO_SPACES.items()):
        text = space if isinstance(space, str) else json.dumps(space)
        yield Case(
            f"{field}: {name}",
            "hdf5",
            metadata_change(**{field: text}),
            MINARI_ID,
            (field.replace("_", ".") + "|Observation space",),
        )
    for field, (name, value) in itertools.product(("env_spec", "eval_env_spec"), NO_SPECS.items()):
        change = metadata_change(**{field: value})
        words = ("metadata.json", "env_spec|EnvSpec|additional_wrappers")
        yield Case(f"{field}: {name}", "hdf5", change, MINARI_ID, words)
    for field, (name, value) in itertools.product(("ref_min_score", "ref_max_score"), NO_SCORES.items()):
        yield case(name, value, field)
    yield case("unknown", "sqlite", "data_format")
    yield Case(
        "data_format: other", "hdf5", metadata_change(data_format="arrow"), MINARI_ID, ("metadata.json", "0 episodes")
    )
    yield Case(
        "minari_version: unknown", "hdf5", metadata_change(minari_version="99.0"), MINARI_ID, ("metadata.json", "99.0")
    )
    yield case("a path", "../../etc", "dataset_id", SAME)
    yield case("null", None, "env_spec", SAME)
    yield Case("author: a number", "hdf5", metadata_change(author=3), MINARI_ID, ("metadata.json",))
    for name, content in NO_METADATA.items():
        change = whole_file(lambda _, content=content: content, DATA_FOLDER / "metadata.json")
        yield Case(f"metadata: {name}", "hdf5", change, MINARI_ID, ("metadata.json",))


# -------------------------------------------------------------------------------------------- episodes of Minari, arrow


def parquet_change(file: Path, change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        with open(folder / file, "rb") as source:
            table = pyarrow.parquet.read_table(source)
        pyarrow.parquet.write_table(change(table), folder / file)

    return apply


def arrow_change(kind: str, change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], object]:
    if kind == "parquet":
        return parquet_change(PLACES[kind].file, change)

    def apply(folder: Path) -> None:
        path = folder / PLACES[kind].file
        with pa.OSFile(str(path)) as source:
            table = pa.ipc.open_file(source).read_all()
        table = change(table)
        with pa.OSFile(str(path), "w") as sink, pa.ipc.new_file(sink, table.schema) as writer:
            writer.write_table(table, max_chunksize=4)

    return apply


def with_column(name: str, make: Callable[[np.ndarray], Any]) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        column = make(np.array(table[name].to_pylist()))
        if column is None:
            return table.drop_columns([name])
        return table.set_column(table.column_names.index(name), name, column)

    return change


def rows(array: np.ndarray) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(array.reshape(-1), array.shape[1])


# Changes to a column, all of which Minari's reader refuses.
VECTORS: dict[str, Callable[[np.ndarray], Any]] = {
    "missing": lambda a: None,
    "nan": lambda a: rows(with_first(a, np.nan)),
    "infinite": lambda a: rows(with_first(a, np.inf)),
    "wider": lambda a: rows(np.hstack([a, a])),
    "flat": lambda a: pa.array(a[:, 0]),
    "lists": lambda a: pa.array([list(row) for row in a[:-1]] + [[1.0]]),
    "words": lambda a: pa.array(["a"] * len(a)),
    "nothing": lambda a: pa.nulls(len(a)),
    "objects": lambda a: pa.array([{"x": 1.0}] * len(a)),
    "dates": lambda a: pa.array(np.arange(len(a)).astype("M8[s]")),
    "with holes": lambda a: pa.array([None, *map(list, a[1:])], pa.list_(pa.float64(), a.shape[1])),
}
NUMBERS: dict[str, Callable[[np.ndarray], Any]] = {
    "missing": lambda a: None,
    "nan": lambda a: pa.array(with_first(a, np.nan)),
    "words": lambda a: pa.array(["a"] * len(a)),
    "nothing": lambda a: pa.nulls(len(a)),
    "with holes": lambda a: pa.array([None, *a[1:]]),
    "lists": lambda a: pa.array([[1.0, 2.0]] * len(a)),
    "dates": lambda a: pa.array(np.arange(len(a)).astype("M8[s]")),
}


def arrow_cases() -> Iterator[Case]:
    for kind in ("arrow", "parquet"):
        for field in MINARI_FIELDS:
            for name, make in (VECTORS if field in ("observations", "actions") else NUMBERS).items():
                change = arrow_change(kind, with_column(field, make))
                words = ("episode 1", f"{field}|lists to be of size")
                yield Case(f"{kind}, {field}: {name}", kind, change, MINARI_ID, words)
        tables = {"in batches": (lambda table: table, SAME), "no row": (lambda table: table[:0], ("episode 1",)),
                  "one row": (lambda table: table[:1], ("episode 1",)),
                  "rows less": (lambda table: table[:-2], ("total_steps",)),
                  "rows twice": (lambda table: pa.concat_tables([table, table]), ("total_steps",)),
                  "other columns": (lambda table: table.rename_columns(list("abcdef"[: table.num_columns])),
                                    ("episode 1", "observations"))}  # fmt: skip
        for name, (change, words) in tables.items():
            yield Case(f"{kind}: {name}", kind, arrow_change(kind, change), MINARI_ID, words)
        folder = DATA_FOLDER / "1"
        yield Case(
            f"{kind}: no folder",
            kind,
            lambda root, folder=folder: shutil.rmtree(root / folder),
            MINARI_ID,
            ("total_episodes",),
        )
        yield Case(
            f"{kind}: one folder more", kind, lambda root: (root / DATA_FOLDER / "3").mkdir(), MINARI_ID, ("total_episodes",)
        )
        yield Case(
            f"{kind}: its own metadata are no JSON",
            kind,
            whole_file(lambda _: b"{", folder / "metadata.json"),
            MINARI_ID,
            SAME,
        )


def group_cases() -> Iterator[Case]:  # noqa: C901 (a list)
    """Episodes as a whole, and what files say of themselves."""
    minari_file, robomimic_file = DATA_FOLDER / "main_data.hdf5", Path("set.hdf5")

    def case(kind: str, name: str, path: str, change: Callable[[h5py.File, str, Path], object], *words: str) -> Case:
        file, dataset = (minari_file, MINARI_ID) if kind == "hdf5" else (robomimic_file, "set.hdf5")
        outcome = words[0] if words[0] in (SAME, READ) else words
        return Case(f"{kind}: {name}", kind, hdf5_change(file, path, change), dataset, outcome)

    def move(target: str) -> Callable[[h5py.File, str, Path], object]:
        return lambda file, path, folder: file.move(path, target)

    def away(file: h5py.File, path: str, folder: Path) -> None:
        with h5py.File(folder / "other.hdf5", "w") as other:
            file.copy(path, other, "episode")
        del file[path]
        file[path] = h5py.ExternalLink(str(folder / "other.hdf5"), "episode")

    def link(target: Any) -> Callable[[h5py.File, str, Path], object]:
        def change(file: h5py.File, path: str, folder: Path) -> None:
            del file[path]
            file[path] = target

        return change

    def attribute(name: str, value: Any) -> Callable[[h5py.File, str, Path], object]:
        return lambda file, path, folder: file[path].attrs.__setitem__(name, value)

    for kind, path, name in (("hdf5", "episode_1", "main_data"), ("robomimic", "data/demo_1", "set.hdf5")):
        yield case(kind, "an episode in another file", path, away, name, path[-6:])
        yield case(kind, "an episode behind a pipe", path, link_through_pipe, name, path[-6:])
        yield case(kind, "an episode that links into nothing", path, link(h5py.SoftLink("/nowhere")), name, path[-6:])
        yield case(kind, "an episode that links to itself", path, link_to_itself, name, path[-6:])
        yield case(
            kind, "an episode that links to the whole", path, link(h5py.SoftLink("/")), name, path[-6:].replace("_", ".")
        )
        yield case(kind, "an array for an episode", path, link(np.zeros(3)), name, path[-6:])
        yield case(kind, "an episode elsewhere", path, linked, SAME)
    yield case("hdf5", "an episode more", "episode_1", lambda f, p, folder: f.copy(p, "episode_3"), "total_episodes", "4")
    yield case("hdf5", "an episode less", "episode_2", lambda f, p, folder: f.__delitem__(p), "total_episodes", "2")
    yield case("hdf5", "an episode of another number", "episode_1", move("/episode_7"), "main_data", "episode_1")
    yield case("hdf5", "an episode of another name", "episode_1", move("/episode_one"), "main_data", "episode_1")
    yield case("hdf5", "no episode", "episode_0", lambda f, p, folder: f.clear(), "total_episodes", "0")
    yield case("robomimic", "no demonstration", "data", lambda f, p, folder: f[p].clear(), "set.hdf5", "no demonstration")
    yield case("robomimic", "a mask behind a pipe", "mask/train", link_through_pipe, SAME)
    yield case("robomimic", "no data", "data", lambda f, p, folder: f.__delitem__(p), "set.hdf5", "data")
    yield case("robomimic", "an array for data", "data", link(np.zeros(3)), "set.hdf5", "data")
    yield case("robomimic", "data in another file", "data", away, "set.hdf5", "data")
    yield case(
        "robomimic", "a demonstration less", "data/demo_2", lambda f, p, folder: f.__delitem__(p), "set.hdf5", "total"
    )
    yield case("robomimic", "no observations", "data/demo_1/obs", lambda f, p, folder: f.__delitem__(p), "demo_1", "obs")
    yield case("robomimic", "observations in another file", "data/demo_1/obs", away, "demo_1", "obs")
    for value in (3, -1, "many", [5, 5], 6.5, SPARSE):
        yield case("robomimic", f"total of {value}", "data", attribute("total", value), "set.hdf5", "total")
        yield case(
            "robomimic", f"num_samples of {value}", "data/demo_1", attribute("num_samples", value), "demo_1", "num_samples"
        )
    env_args = ["", "{", "\\xff", b"\xff\xfe", "9" * 10_000, "[" * 100_000, np.zeros(3)]
    for number, value in enumerate(env_args):
        yield case(
            "robomimic", f"env_args that are no JSON, {number}", "data", attribute("env_args", value), "set.hdf5", "env_args"
        )
    controllers: list[Any] = [
        3,
        [3],
        {"body_parts": 3},
        {"input_min": "a"},
        {"input_max": [1, 2, 3]},
        {"input_max": math.nan},
    ]
    odd = [{"type": []}, {"env_name": {}}, {"env_kwargs": []}, {"env_kwargs": 3}]
    odd += [{"env_kwargs": {"controller_configs": controller}} for controller in controllers]
    for number, value in enumerate(odd):
        yield case(
            "robomimic",
            f"odd env_args, {number}",
            "data",
            attribute("env_args", json.dumps(value)),
            "set.hdf5",
            "env_args|action space",
        )
    for number, value in enumerate(("[]", "3", "null", '"a"')):
        yield case("robomimic", f"env_args that say nothing, {number}", "data", attribute("env_args", value), SAME)
    over = of_array(lambda array: np.full(len(array), 3e38))
    yield case("hdf5", "overflowing return", "episode_1/rewards", over, "main_data", "episode 1", "rewards")
    yield case("robomimic", "overflowing return", "data/demo_1/rewards", over, "set.hdf5", "demo_1", "rewards")
    beyond = of_array(lambda array: array + 5.0)
    yield case("hdf5", "actions out of bounds", "episode_1/actions", beyond, "main_data", "episode 1", "action")
    yield case("robomimic", "actions out of bounds", "data/demo_1/actions", beyond, "set.hdf5", "demo_1", "action")


# ------------------------------------------------------------------------------------------------------ LeRobot, tables


CONTROL = "a\x1b[2Jb"  # clears a terminal that it is printed on
# Changes above that leave numbers as many as they are, in types that Parquet holds.
OTHER_NUMBERS = ("float32", "integers", "small integers", "inf", "-inf", "too large")


def column_cases(kind: str, vectors: tuple[str, ...], numbers: tuple[str, ...]) -> Iterator[Case]:
    """Changes to one column of a Parquet file that holds all steps."""
    _, file, dataset, _ = PLACES[kind]

    def case(field: str, name: str, make: Callable[[np.ndarray], Any], usual: str | None) -> Case:
        field_said = re.split("[._]", field.removeprefix("next."))[0]
        outcome = expected(kind, field, name, usual, (dataset, f"{field_said}|to be of size"))
        return Case(f"{kind}, {field}: {name}", kind, parquet_change(file, with_column(field, make)), dataset, outcome)

    for field in (*vectors, *numbers):
        for name, make in (VECTORS if field in vectors else NUMBERS).items():
            yield case(field, name, make, None)
        for name in OTHER_NUMBERS:
            changed, usual = CHANGED[name]
            to_column = rows if field in vectors else pa.array
            yield case(field, name, lambda a, changed=changed, to_column=to_column: to_column(changed(a)), usual)


def twice(table: pa.Table) -> pa.Table:
    return pa.concat_tables([table, table])


def one_column_twice(table: pa.Table) -> pa.Table:
    return table.append_column(table.column_names[0], table.column(0))


def bomb(array: np.ndarray) -> pa.Array:
    """Zeros that take a thousand times their bytes in the file."""
    return rows(np.zeros((len(array), 400_000), np.float32))


def info_change(**changes: Any) -> Callable[[Path], object]:
    """Other entries of `meta/info.json`; a function is given the entry that is there."""

    def apply(folder: Path) -> None:
        path = folder / ARM / LEROBOT_INFO
        info = json.loads(path.read_text())
        info |= {name: value(info[name]) if callable(value) else value for name, value in changes.items()}
        path.write_text(json.dumps({name: value for name, value in info.items() if value is not MISSING}))

    return apply


def feature(name: str, **changes: Any) -> Callable[[Path], object]:
    def change(features: dict[str, Any]) -> dict[str, Any]:
        told = {**features.get(name, {}), **changes}
        return {**features, name: {key: value for key, value in told.items() if value is not MISSING}}

    return info_change(features=change)


def both(*changes: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: [change(folder) for change in changes]


def lerobot_cases() -> Iterator[Case]:  # noqa: C901 (a list)
    def case(name: str, change: Callable[[Path], object], *words: str) -> Case:
        return Case(f"lerobot, {name}", "lerobot", change, str(ARM), words[0] if words[0] in (SAME, READ) else words)

    def of_table(change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], object]:
        return parquet_change(ARM / LEROBOT_DATA, change)

    yield from column_cases("lerobot", ("observation.state", "action"), ("next.reward", "frame_index", "episode_index"))
    for field, right in {"total_episodes": len(LENGTHS), "total_frames": N_STEPS}.items():
        for name, value in NO_COUNTS.items():
            told = right + int(value) if value in ("+1", "-1") else value
            yield case(f"{field}: {name}", info_change(**{field: told}), "info.json", field[6:])
    versions = {**NO_STRINGS, **{each: each for each in ("v9.0", "v3.99", "v3.1", "v2.2", "v1.6", "v3", "3.0", "v3.0\n")}}
    for name, value in versions.items():
        yield case(f"codebase_version: {name!r}", info_change(codebase_version=value), "info.json", "codebase_version is")
    for version in ("v2.0", "v2.1"):
        yield case(f"codebase_version: {version}", info_change(codebase_version=version), SAME)
    rates = {"a word": "a", "null": None, "zero": 0, "negative": -1, "NaN": math.nan, "infinite": math.inf, "true": True,
             "a list": [30], "huge": 10**400}  # fmt: skip
    for name, value in rates.items():
        yield case(f"fps: {name}", info_change(fps=value), "info.json", "fps is")
    for rate in (30, 0.5):
        yield case(f"fps: {rate}", info_change(fps=rate), SAME)
    for name, value in {**NO_STRINGS, "a word": "action", "of words": {"action": "float64"}}.items():
        yield case(
            f"features: {name}", info_change(features=value), "info.json|no feature", "features|action|cannot be read"
        )
    dtypes = {**NO_STRINGS, "words": "string", "objects": "object", "a video": "video", "an image": "image"}
    for name, value in dtypes.items():
        for field in ("action", "observation.state"):
            words = ("arm|info.json", f"dtype|fps|{field.split('.')[0]}")
            yield case(f"dtype of {field}: {name}", feature(field, dtype=value), *words)
    for name, value in {"a number": 3, "a word": "abc", "null": None, "an object": {"a": 1}, "true": True}.items():
        yield case(f"shape: {name}", feature("episode_index", shape=value), "info.json", "shape of episode_index is")
    yield case("shape: huge", feature("episode_index", shape=[SPARSE, SPARSE]), SAME)
    for name, content in NO_METADATA.items():
        change = whole_file(lambda _, content=content: content, ARM / LEROBOT_INFO)
        yield case(f"info: {name}", change, "info.json")
    numbers = {"half an episode": 0.5, "an episode of -1": -1, "an infinite episode": math.inf}
    for name, value in numbers.items():
        made = with_column("episode_index", lambda a, value=value: pa.array(np.where(a == 1, value, a)))
        yield case(name, of_table(made), "arm", f"episode_index is {value}.*a whole number of at least 0")
    two_rewards = with_column("next.reward", lambda a: rows(np.stack([a, a], axis=1)))
    yield case("two rewards", of_table(two_rewards), "arm", "next.reward has 2 numbers a frame; one")
    one_less = with_column("frame_index", lambda a: pa.array(a + 1))
    yield case("frames from 1 on", of_table(one_less), "arm", "episode 0: frame_index does not count its 4 frames from 0")
    over = with_column("next.reward", lambda a: pa.array(np.full(len(a), 3e38)))
    yield case("overflowing return", of_table(over), "arm", "episode 0", "rewards")
    success = (
        feature("next.success", dtype="float64"),
        of_table(lambda t: t.append_column("next.success", [[0.5] * len(t)])),
    )
    yield case("half a success", both(*success), "arm", "next.success hold 0.5 at step 0; 0 and 1")
    tables = {"no row": (lambda t: t[:0], "file-000.parquet"), "a row less": (lambda t: t[:-1], "14"),
              "rows twice": (twice, "30"), "a column twice": (one_column_twice, "file-000.parquet"),
              "other columns": (lambda t: t.rename_columns(list("abcde")), "has no column action, episode_index"),
              "a bomb": (with_column("action", bomb), "claim")}  # fmt: skip
    for name, (change, word) in tables.items():
        yield case(name, of_table(change), "arm", word)
    yield case("rows in another order", of_table(lambda t: t.take(list(range(len(t)))[::-1])), SAME)
    yield case(
        "a feature of control characters", both(feature(CONTROL, dtype="bool"), feature("action", dtype="a")), "arm", "2J"
    )
    yield case("a column of control characters", feature(f"observation.{CONTROL}", dtype="bool"), "file-000.parquet", "2J")
    yield case("no data", lambda folder: shutil.rmtree(folder / ARM / "data"), "arm", "below data")
    yield case(
        "data are a link out of the folder", to_link(ARM / "data"), "data leads to .*; links within .*arm are accepted"
    )
    yield case(
        "meta is a link out of the folder", to_link(ARM / "meta"), "meta leads to .*; links within .*arm are accepted"
    )
    yield case("a link to the root", lambda folder: (folder / ARM / "data/x").symlink_to("/"), "data/x leads to /; links")
    yield case("a pipe beside the data", lambda folder: pipe(folder / ARM / "data"), "data/pipe is no regular file")
    yield case("a link within", to_link(ARM / LEROBOT_DATA, ARM / "elsewhere"), SAME)
    yield case("a link that leads back", lambda folder: (folder / ARM / "data/back").symlink_to(folder / ARM), SAME)


def table_cases() -> Iterator[Case]:
    def case(name: str, change: Callable[[pa.Table], pa.Table], *words: str) -> Case:
        outcome = words[0] if words[0] in (SAME, READ) else ("set.parquet", *words)
        return Case(f"table: {name}", "table", parquet_change(Path("set.parquet"), change), "set.parquet", outcome)

    yield from column_cases("table", (), ("obs_0", "action_0", "reward", "episode"))
    yield case("no row", lambda t: t[:0], "actions")
    yield case("one row", lambda t: t[:1], READ)
    yield case("rows twice", twice, "episode 0 comes in several places")
    yield case("episodes in another order", lambda t: t.take(list(range(len(t)))[::-1]), READ)
    yield case("rows in the order of rewards", lambda t: t.sort_by("reward"), "episode . comes in several places")
    yield case("a column twice", one_column_twice, "obs_0")
    yield case("other columns", lambda t: t.rename_columns(list("abcdefg")), "no array called one of actions", "only a, b")
    names = [f"{CONTROL}{number}" for number in range(7)]
    yield case("columns of control characters", lambda t: t.rename_columns(names), "no array called one of actions", "2J")
    yield case("a bomb", with_column("obs_0", bomb), "claim")


def csv_entry(field: str, make: Callable[[str], str]) -> Callable[[Path], object]:
    """The first entry of a column is another text."""

    def change(content: bytes) -> bytes:
        first, second, *others = content.decode().split("\n")
        entries = second.split(",")
        number = first.split(",").index(field)
        entries[number] = make(entries[number])
        return "\n".join([first, ",".join(entries), *others]).encode()

    return whole_file(change, "set.csv")


def csv_cases() -> Iterator[Case]:
    entries: dict[str, tuple[Callable[[str], str], str | None]] = {
        "in quotes": (lambda word: f'"{word}"', SAME),
        "in spaces": (lambda word: f"  {word} ", SAME),
        "nearly nothing": (lambda word: "1e-400", READ),
        "empty": (lambda word: "", None),
        "nan": (lambda word: "nan", None),
        "inf": (lambda word: "-inf", None),
        "too large": (lambda word: "1e39", None),
        "many digits": (lambda word: "9" * 5000, None),
        "a word": (lambda word: "far", None),
        "a hexadecimal number": (lambda word: "0x10", None),
        "a comma": (lambda word: '"0,5"', None),
        "a control character": (lambda word: CONTROL, None),
    }
    for field, (name, (make, usual)) in itertools.product(("obs_0", "action_0", "reward", "episode"), entries.items()):
        outcome = expected("csv", field, name, usual, ("set.csv", field.split("_")[0]))
        yield Case(f"csv, {field}: {name}", "csv", csv_entry(field, make), "set.csv", outcome)
    texts: dict[str, tuple[Callable[[bytes], bytes], str]] = {
        "with a byte order mark": (lambda text: b"\xef\xbb\xbf" + text, SAME),
        "ends of lines of Windows": (lambda text: text.replace(b"\n", b"\r\n"), SAME),
        "empty lines": (lambda text: text.replace(b"\n", b"\n\n"), SAME),
        "no names": (lambda text: text.split(b"\n", 1)[1], "no array called one of actions"),
        "names alone": (lambda text: text.split(b"\n", 1)[0], "no array called one of actions.*only nothing"),
        "a short row": (lambda text: text + b"\n1.0,1.0", "row 17: has 2 entries, and the first row names 7"),
        "a long row": (lambda text: text + b"\n" + b"1.0," * 8, "row 17: has 9 entries, and the first row names 7"),
        "semicolons": (lambda text: text.replace(b",", b";"), "the first row is 'obs_0;.*; commas are expected between"),
        "tabs": (lambda text: text.replace(b",", b"\t"), "the first row is .*; commas are expected between"),
        "a name twice": (lambda text: text.replace(b"obs_1", b"obs_0"), "a name for each column is expected, each once"),
        "rows twice": (lambda text: text + b"\n" + text.split(b"\n", 1)[1], "episode 0 comes in several places"),
        "a quote without end": (lambda text: text + b'\n"', "cannot be read"),
        "zero bytes": (lambda text: text.replace(b"0.", b"\0", 1), "hold object|cannot be read"),
        "Latin-1": (lambda text: text.replace(b"obs_1", b"\xe9"), "cannot be read"),
        "UTF-16": (lambda text: text.decode().encode("utf-16"), "cannot be read"),
        "a huge entry": (lambda text: text + b"\n" + b"1" * 200_000, "cannot be read"),
        "names of control characters": (
            lambda text: text.replace(b"action", CONTROL.encode()),
            "no array called one of actions.*2J",
        ),
    }
    for name, (change, words) in texts.items():
        outcome = words if words in (SAME, READ) else ("set.csv", words)
        yield Case(f"csv, text: {name}", "csv", whole_file(change, "set.csv"), "set.csv", outcome)


# --------------------------------------------------------------------------------------------------------------- zarr


def zarr_told(**changes: Any) -> Callable[[Path], object]:
    """Other entries of an array's `.zarray`; a function is given the entry that is there."""

    def change(array: Path) -> None:
        told = json.loads((array / ".zarray").read_text())
        told |= {name: value(told[name]) if callable(value) else value for name, value in changes.items()}
        (array / ".zarray").write_text(json.dumps(told))

    return change


def first_chunk(array: Path) -> Path:
    return min(path for path in array.iterdir() if path.name != ".zarray")


def compressed(array: Path) -> None:
    shape, name = json.loads((array / ".zarray").read_text())["shape"], f"{array.parent.name}/{array.name}"
    shutil.rmtree(array)
    write_zarr_array(array, zarr_arrays()[name].reshape(shape), compressed=True)


def zarr_group(array: Path) -> None:
    shutil.rmtree(array)
    array.mkdir()
    (array / ".zgroup").write_text(json.dumps({"zarr_format": 2}))


def in_first_chunk(content: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda array: first_chunk(array).write_bytes(content(first_chunk(array).read_bytes()))


def nothing_written(array: Path) -> None:
    for path in array.iterdir():
        if path.name != ".zarray":
            path.unlink()


# Changes to the folder of an array, and the expected result; None expects a refusal that names the array.
ZARR_ARRAYS: dict[str, tuple[Callable[[Path], object], str | None]] = {
    "missing": (shutil.rmtree, None),
    "a group": (zarr_group, None),
    "compressed": (compressed, SAME),
    "a chunk unwritten": (lambda array: first_chunk(array).unlink(), READ),
    "nothing written": (nothing_written, READ),
    "a short chunk": (in_first_chunk(lambda content: content[:1]), None),
    "a long chunk": (in_first_chunk(lambda content: 2 * content), None),
    "a short compressed chunk": (both(compressed, in_first_chunk(lambda content: content[:9])), None),
    "a compressed chunk of other bytes": (both(compressed, in_first_chunk(lambda content: zlib.compress(b"1"))), None),
    "no compression where it is told": (zarr_told(compressor={"id": "zlib", "level": 1}), None),
    "a pickle for a compressor": (zarr_told(compressor={"id": "pickle"}), None),
    "an unknown compressor": (zarr_told(compressor={"id": "json2"}), None),
    "a number for a compressor": (zarr_told(compressor=3), None),
    "a pickle for a filter": (zarr_told(filters=[{"id": "pickle", "protocol": 4}]), None),
    "objects": (zarr_told(dtype="|O"), None),
    "claimed records": (zarr_told(dtype=[["a", "<f4"]]), None),
    "an unknown type": (zarr_told(dtype="<f9"), None),
    "claimed": (zarr_told(shape=lambda shape: [SPARSE, *shape[1:]]), None),
    "a negative shape": (zarr_told(shape=lambda shape: [-15, *shape[1:]]), None),
    "a word for a shape": (zarr_told(shape="15"), None),
    "chunks of no row": (zarr_told(chunks=lambda chunks: [0, *chunks[1:]]), None),
    "huge chunks": (zarr_told(chunks=lambda chunks: [SPARSE, *chunks[1:]]), None),
    "another format": (zarr_told(zarr_format=9), None),
    "a chunk is a pipe": (lambda array: to_pipe(first_chunk(array).name)(array), None),
    "a chunk is a link out of the folder": (lambda array: to_link(first_chunk(array), array.parents[2] / "x")(array), None),
    "a chunk is a link within": (lambda array: to_link(first_chunk(array), array.parent / "x")(array), SAME),
    "a chunk is a link into nothing": (lambda array: (first_chunk(array).unlink(), (array / "0").symlink_to("none")), READ),
    "is a link out of the folder": (lambda array: to_link(array, array.parents[2] / "x")(array), None),
}


# Arrays that zarr opens together, so that the message names their file alone.
NOT_OPENED = ("an unknown type", "a negative shape", "a word for a shape", "another format")


def zarr_change(name: str, change: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: change(folder / ZARR / name)


def zarr_array(make: Callable[[np.ndarray], Any]) -> Callable[[Path], object]:
    def change(array: Path) -> None:
        made = np.asarray(make(zarr_arrays()[f"{array.parent.name}/{array.name}"]))
        shutil.rmtree(array)
        write_zarr_array(array, made)

    return change


def zipped(change: Callable[[Path], object]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        change(folder)
        shutil.make_archive(str(folder / ZARR), "zip", folder / ZARR)

    return apply


def zarr_cases() -> Iterator[Case]:
    # Long doubles are read by its second version alone.
    arrays = {name: (zarr_array(make), usual) for name, (make, usual) in CHANGED.items() if name != "long double"}
    said = {"state": "state|observ", "action": "action|episode_ends"}
    for path, (name, (change, usual)) in itertools.product(zarr_arrays(), {**arrays, **ZARR_ARRAYS}.items()):
        field = path.rpartition("/")[2]
        words = ("set.zarr",) if name in NOT_OPENED else ("set.zarr", said.get(field, field))
        outcome = expected("zarr", field, name, usual, words)
        yield Case(f"zarr, {field}: {name}", "zarr", zarr_change(path, change), str(ZARR), outcome)
    for name, (change, usual) in ZARR_ARRAYS.items():
        if " link " not in name and " pipe" not in name:  # which a zip cannot hold
            outcome = usual or (("set.zarr.zip",) if name in NOT_OPENED else ("set.zarr.zip", "action"))
            yield Case(
                f"zarr zip, action: {name}", "zarr", zipped(zarr_change("data/action", change)), f"{ZARR}.zip", outcome
            )
    for name, content in FILES.items():
        change = both(zipped(lambda folder: None), whole_file(content, f"{ZARR}.zip"))
        yield Case(f"zarr zip: {name}", "zarr", change, f"{ZARR}.zip", ("set.zarr.zip",))

    def in_both(name: str, change: Callable[[Path], object], *words: str) -> Iterator[Case]:
        outcome = words[0] if words[0] in (SAME, READ) else ("set.zarr", *words)
        yield Case(f"zarr: {name}", "zarr", change, str(ZARR), outcome)
        yield Case(f"zarr zip: {name}", "zarr", zipped(change), f"{ZARR}.zip", outcome)

    def wrote(file: str, content: Any) -> Callable[[Path], object]:
        return lambda folder: (folder / ZARR / file).write_text(content if isinstance(content, str) else json.dumps(content))

    pickled = {"compressor": {"id": "pickle"}, "dtype": "<f8"}
    consolidated = {"metadata": {"data/action/.zarray": pickled}, "zarr_consolidated_format": 1}
    # In the consolidated metadata of zarr's third format an array's name stands where a user's attributes do elsewhere.
    hidden = {"attributes": {"codecs": [{"name": "numcodecs.pickle"}], "data_type": "float32"}}
    yield from in_both("a pickle in consolidated metadata", wrote(".zmetadata", consolidated), "zmetadata: codec 'pickle'")
    yield from in_both(
        "a pickle in an array called attributes",
        wrote("zarr.json", {"consolidated_metadata": {"metadata": hidden}}),
        r"zarr\.json: codec 'numcodecs\.pickle'",
    )
    yield from in_both("a file of another name", wrote("data/x.zarray", "[" * 100_000), SAME)
    yield from in_both("metadata of an array nested deeply", wrote("data/state/.zarray", "[" * 100_000), "state")
    yield from in_both("a bomb of metadata", wrote("data/state/.zarray", " " * 2**26), "state")
    control = lambda folder: (folder / ZARR / "data/action").rename(folder / ZARR / "data" / CONTROL)  # noqa: E731
    yield from in_both("an array of control characters", control, "data has no array actions or .*2J")
    yield from in_both("no group data", lambda folder: shutil.rmtree(folder / ZARR / "data"), "data")
    ends = {"halves": [4.5, 10, 15], "nan": [4, math.nan, 15], "beyond the data": [4, 10, 99], "descending": [10, 4, 15],
            "from zero": [0, 4, 15], "too early": [4, 10], "negative": [-4, 10, 15]}  # fmt: skip
    for name, value in ends.items():
        change = zarr_change("meta/episode_ends", zarr_array(lambda _, value=value: np.array(value)))
        yield Case(
            f"zarr, ends: {name}", "zarr", change, str(ZARR), ("set.zarr", "meta/episode_ends is .*, the last one 15")
        )
    two_rewards = zarr_change("data/reward", zarr_array(lambda a: np.stack([a, a], axis=1)))
    yield Case("zarr: two rewards", "zarr", two_rewards, str(ZARR), ("set.zarr", r"reward has shape \(15, 2\)"))
    yield Case("zarr: is a pipe", "zarr", lambda folder: (shutil.rmtree(folder / ZARR), os.mkfifo(folder / ZARR)), str(ZARR),
               ("set.zarr is no regular file",))  # fmt: skip
    yield Case("zarr zip: is a pipe", "zarr", lambda folder: os.mkfifo(folder / f"{ZARR}.zip"), f"{ZARR}.zip",
               ("set.zarr.zip is no regular file",))  # fmt: skip
    yield Case("zarr zip: is missing", "zarr", lambda folder: None, f"{ZARR}.zip", ("set.zarr.zip does not exist",))
    yield Case(
        "zarr: is missing", "zarr", lambda folder: shutil.rmtree(folder / ZARR), str(ZARR), ("set.zarr does not exist",)
    )
    yield Case("zarr: a pipe beside the data", "zarr", lambda folder: pipe(folder / ZARR / "data"), str(ZARR),
               ("data/pipe is no regular file",))  # fmt: skip


def cases() -> list[Case]:
    """All of them."""
    minari_and_files = (hdf5_cases, npz_cases, file_cases, metadata_cases, arrow_cases, group_cases)
    parts = (*minari_and_files, lerobot_cases, table_cases, csv_cases, zarr_cases)
    return list(itertools.chain.from_iterable(part() for part in parts))
