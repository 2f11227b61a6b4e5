"""Bad datasets, some hundreds: small good ones of each kind, each with one thing changed, and what should come of it."""

import itertools
import json
import math
import os
import shutil
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
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
        for name, array in flat_arrays().items():
            file[name] = array
    write_lerobot(folder / "lerobot" / "arm")
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
    """A pipe that nobody writes to, so that whoever opens it waits for ever."""
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
EXCEPTIONS: dict[tuple[str, str, str], str | None] = {
    ("hdf5", "observations", "row less"): SAME,  # the last one is not needed
    ("hdf5", "terminations", "column more"): None,
    **{("robomimic", field, "missing"): READ for field in ("rewards", "dones")},
    **{("robomimic", field, "no column"): None for field in ("rewards", "dones")},
    **{(kind, field, name): READ for kind in ("hdf5", "robomimic", "npz") for field in
       ("terminations", "truncations", "dones") for name in ("float16", "float32", "integers", "small integers")},
    **{("npz", field, "missing"): READ for field in ("rewards", "terminations", "truncations", "episode_ends")},
    **{("npz", "episode_ends", name): SAME for name in ("float16", "float32", "integers", "small integers")},
    ("npz", "observations", "one more axis"): READ,  # (N, ...) is accepted
    ("npz", "observations", "column more"): READ,
    ("npz", "actions", "column more"): READ,
    ("robomimic", "obs/state", "flat"): READ,
}  # fmt: skip


def expected(kind: str, field: str, name: str, usual: str | None, words: tuple[str, ...]) -> str | tuple[str, ...]:
    return EXCEPTIONS.get((kind, field, name), usual) or words


def hdf5_cases() -> Iterator[Case]:
    places = [
        *(("hdf5", f"episode_{DAMAGED}/{field}", field, f"episode {DAMAGED}", MINARI_ID, DATA_FOLDER / "main_data.hdf5")
          for field in MINARI_FIELDS),
        *(("robomimic", f"data/demo_{DAMAGED}/{field}", field, f"demo_{DAMAGED}", "set.hdf5", Path("set.hdf5"))
          for field in ("obs/state", "actions", "rewards", "dones")),
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


def file_cases() -> Iterator[Case]:
    places = {"npz": "set.npz", "robomimic": "set.hdf5", "hdf5": DATA_FOLDER / "main_data.hdf5",
              "arrow": DATA_FOLDER / "1" / "part-0.arrow", "parquet": DATA_FOLDER / "1" / "part-0.parquet"}  # fmt: skip
    for (kind, file), (name, change) in itertools.product(places.items(), FILES.items()):
        is_path = kind in ("npz", "robomimic")
        said: str | tuple[str, ...] = (Path(file).name,) if kind in ("npz", "robomimic", "hdf5") else ("episode 1",)
        yield Case(f"{kind}: {name}", kind, whole_file(change, file), str(file) if is_path else MINARI_ID, said)
    for kind, file in places.items():
        is_path = kind in ("npz", "robomimic")
        words = (Path(file).name,) if kind in ("npz", "robomimic", "hdf5") else ("episode 1",)
        for name, make in {
            "is a folder": to_folder(file),
            "is missing": lambda folder, file=file: (folder / file).unlink(),
        }.items():
            yield Case(f"{kind}: {name}", kind, make, str(file) if is_path else MINARI_ID, words)


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
    "empty": b"", "no JSON": b"{", "a list": b"[]", "a number": b"3", "null": b"null", "a word": b'"a"',
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
    yield Case("metadata: a folder", "hdf5", to_folder(DATA_FOLDER / "metadata.json"), MINARI_ID, ("metadata.json",))


# -------------------------------------------------------------------------------------------- episodes of Minari, arrow


def arrow_change(kind: str, change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        path = folder / DATA_FOLDER / "1" / f"part-0.{kind}"
        if kind == "parquet":
            pyarrow.parquet.write_table(change(pyarrow.parquet.read_table(path)), path)
            return
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


def arrow_cases() -> Iterator[Case]:
    vectors: dict[str, Callable[[np.ndarray], Any]] = {
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
    numbers: dict[str, Callable[[np.ndarray], Any]] = {
        "missing": lambda a: None,
        "nan": lambda a: pa.array(with_first(a, np.nan)),
        "words": lambda a: pa.array(["a"] * len(a)),
        "nothing": lambda a: pa.nulls(len(a)),
        "with holes": lambda a: pa.array([None, *a[1:]]),
        "lists": lambda a: pa.array([[1.0, 2.0]] * len(a)),
        "dates": lambda a: pa.array(np.arange(len(a)).astype("M8[s]")),
    }
    for kind in ("arrow", "parquet"):
        for field in MINARI_FIELDS:
            for name, make in (vectors if field in ("observations", "actions") else numbers).items():
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


def cases() -> list[Case]:
    """All of them."""
    parts = (hdf5_cases, npz_cases, file_cases, metadata_cases, arrow_cases, group_cases)
    return list(itertools.chain.from_iterable(part() for part in parts))
