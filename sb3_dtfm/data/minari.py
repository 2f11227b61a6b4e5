"""Reading Minari datasets into a `TrajectoryBuffer`."""

import contextlib
import json
import math
import os
import reprlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import minari
import numpy as np
from minari.dataset._storages import get_minari_storage
from minari.dataset.minari_dataset import parse_dataset_id
from minari.serialization import deserialize_space
from minari.storage import get_dataset_path

from sb3_dtfm.data.arrow import import_pyarrow
from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, existing_file, files_below
from sb3_dtfm.data.flat import fitted
from sb3_dtfm.data.hdf5 import open_group, read_hdf5, read_images
from sb3_dtfm.data.image_files import decode_images
from sb3_dtfm.data.observations import Chosen, ReadArray, chosen_space, flatten_chosen
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, ScoreReference, Trajectory, check_flags, wrap_dataset_errors
from sb3_dtfm.envs.success import SUCCESS

METADATA_FILE_NAME, HDF5_FILE_NAME = "metadata.json", "main_data.hdf5"
# Bytes that HDF5 may keep of a file's structure; its own limit is a third of a usual dataset's size.
STRUCTURE_CACHE = 2**20
EPISODE_KEYS = ("observations", "actions", "rewards", "terminations", "truncations")
INFOS = "infos"
# Fields of metadata.json: types that each may have, and whether every dataset has it.
FIELDS: dict[str, tuple[tuple[type, ...], bool]] = {
    "dataset_id": ((str,), True),
    "minari_version": ((str,), True),
    "data_format": ((str,), False),
    "total_episodes": ((int,), True),
    "total_steps": ((int,), True),
    "observation_space": ((str,), True),
    "action_space": ((str,), True),
    "env_spec": ((str,), False),
    "eval_env_spec": ((str,), False),
    "ref_min_score": ((int, float), False),
    "ref_max_score": ((int, float), False),
}
# Seconds in which a server has to answer.
REACHED_AFTER = 10.0
FORMATS = ("hdf5", "arrow", "parquet")
# Minari 0.5.3, the newest for NumPy 1 and Python 3.10, refuses files of 0.5.4, which differ only in images.
minari.supported_dataset_versions.add("0.5.4")
# Most entries of the vector that a step's observation, or action, becomes: no task has as many.
MOST_ENTRIES = 2**20


def is_minari(dataset: Any) -> bool:
    """Return whether this is an opened Minari dataset or an id of one."""
    if not isinstance(dataset, str):
        return isinstance(dataset, minari.MinariDataset)
    try:
        parse_dataset_id(dataset)
    except (ValueError, TypeError):
        return False
    return True


def fingerprint_minari(dataset: str | minari.MinariDataset, options: dict[str, Any]) -> Fingerprint:
    """
    Take the fingerprint of a dataset as it is now, downloaded if necessary, and of its choice of episodes.

    :param dataset: see :func:`load_minari`
    :param options: options of :func:`load_minari`
    """
    dataset = open_minari(dataset) if isinstance(dataset, str) else dataset
    episodes = dataset.episode_indices.tolist()
    arguments: Any = "all" if _is_whole(dataset) else episodes
    return Fingerprint.of(dataset.id, Path(dataset.storage.data_path), [arguments, options] if options else arguments)


def _is_whole(dataset: minari.MinariDataset) -> bool:
    return bool(np.array_equal(dataset.episode_indices, np.arange(dataset.storage.total_episodes)))


def load_minari(
    dataset: str | minari.MinariDataset,
    observation_keys: Sequence[str] | None = None,
    clip_actions: bool = False,
    on_invalid: str = "raise",
    storage: FileStorage | None = None,
) -> TrajectoryBuffer:
    """
    Read a Minari dataset: a local one, else one that Minari's own client downloads.

    Nothing that its metadata name is imported, built or run: of `env_spec` only the id is read.

    :param dataset: id (`namespace/name-vN`) or an opened dataset, whose choice of episodes is kept
    :param observation_keys: names of the entries of dictionary observations, cameras too, that make up the observation, in
        this order
    :param clip_actions: bring actions outside of the dataset's action space to the nearest bound
    :param on_invalid: see :func:`~sb3_dtfm.data.load_dataset`
    :param storage: storage of the steps; memory if not given
    :return: buffer of its episodes, with the normalised-score scale of its metadata where it names one
    :raises DatasetError: neither found nor downloaded, damaged, or not fit for learning (names the file, episode and field)
    """
    if isinstance(dataset, str):
        dataset = open_minari(dataset)
    folder = Path(dataset.storage.data_path)
    in_hdf5 = dataset.storage.FORMAT == "hdf5"
    source = f"Minari dataset {dataset.id} ({folder / HDF5_FILE_NAME if in_hdf5 else folder})"
    metadata = read_metadata(folder, dataset.id)
    if len(dataset.episode_indices) == 0:
        raise DatasetError(f"{source}: holds no episode; at least one is needed.")
    with contextlib.ExitStack() as stack, wrap_dataset_errors(source):
        env_spec = dataset.env_spec
        chosen, action_space = chosen_space(dataset.observation_space, observation_keys, source), dataset.action_space
        read = _hdf5_reader(stack, folder, source) if in_hdf5 else _arrow_reader(dataset.storage.FORMAT, folder, source)

        def trajectory(index: int) -> Trajectory:
            name = f"episode {index}"
            with wrap_dataset_errors(f"{source}, {name}"):
                found = make_trajectory(*read(index), chosen, name, source)
                return replace(found, actions=fitted(found.actions, action_space, clip_actions))

        buffer = TrajectoryBuffer.from_trajectories(
            map(trajectory, dataset.episode_indices.tolist()),
            action_space,
            chosen.flat,
            n_steps=dataset.total_steps,
            source=source,
            score_reference=_score_reference(metadata),
            env_id=env_spec.id if env_spec else None,
            storage=storage,
            on_invalid=on_invalid,
            n_stored=sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()),
        )
        if len(buffer) != dataset.total_steps and not buffer.n_dropped:
            found = f"total_steps tells of {dataset.total_steps} steps, and the episodes have {len(buffer)}"
            raise DatasetError(f"{source}: {found}; the dataset is incomplete.")
        return buffer


def open_minari(dataset_id: str) -> minari.MinariDataset:
    """
    Open a local dataset, or download it first. Its metadata are checked before Minari sees them.

    :param dataset_id: `namespace/name-vN`
    :raises DatasetError: malformed id, damaged local files, or neither found nor downloaded
    """
    if not is_minari(dataset_id):
        raise DatasetError(f"{dataset_id!r} is no Minari id; expected namespace/name-vN.")
    folder = get_dataset_path(dataset_id) / "data"
    if not folder.exists():
        _download(dataset_id)
    metadata = read_metadata(folder, dataset_id)
    source = f"Minari dataset {dataset_id} ({folder / METADATA_FILE_NAME})"
    if metadata["minari_version"] not in minari.supported_dataset_versions:
        raise DatasetError(
            f"{source}: was written by Minari {metadata['minari_version']!r:.20}, which the installed Minari "
            f"{minari.__version__} does not read: pip install --upgrade minari."
        )
    with wrap_dataset_errors(source):
        space, action_space = (deserialize_space(metadata[name]) for name in ("observation_space", "action_space"))
        return minari.MinariDataset(get_minari_storage(metadata["data_format"])(folder, space, action_space))


def _download(dataset_id: str) -> None:
    try:
        if os.getenv("MINARI_REMOTE", "hf://").startswith("hf://"):
            _reach_hub()
        minari.download_dataset(dataset_id)
    except Exception as error:  # whatever the remote's client raises
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            local = sorted(minari.list_local_datasets())
        why = 'for that, pip install "sb3-dtfm[minari]"' if isinstance(error, ImportError) else error
        raise DatasetError(
            f"Minari dataset {dataset_id} is not in {get_dataset_path()} (set by MINARI_DATASETS_PATH), which holds "
            f"{', '.join(local) if local else 'no dataset'}; and it cannot be downloaded: {why}"
        ) from error


def _reach_hub() -> None:
    """Fail at once where there is no way to Hugging Face's hub, which its client would look for again and again."""
    from huggingface_hub.constants import ENDPOINT
    from huggingface_hub.utils import get_session

    get_session().head(ENDPOINT, timeout=REACHED_AFTER)


def read_metadata(folder: Path, dataset_id: str) -> dict[str, Any]:
    """
    Read a dataset's metadata, checked before anything is done with them.

    Minari takes memory for as many episodes and entries as are named, and where a space is missing it builds the
    environment of `env_spec`: it then imports and calls whatever stands there.

    :param folder: folder of the dataset's data
    :param dataset_id: id of the dataset, for messages
    :raises DatasetError: names the field, what was found and what is accepted; or a link that leads out of the folder
    """
    path = folder / METADATA_FILE_NAME
    source = f"Minari dataset {dataset_id} ({path})"
    files_below(folder)  # no link leads out of it
    with wrap_dataset_errors(source):
        metadata = json.loads(existing_file(path, "what a Minari dataset says of itself").read_text())
    if not isinstance(metadata, dict):
        raise DatasetError(f"{source}: holds a {type(metadata).__name__}; a JSON object is expected.")
    _check_fields(metadata, source)
    for name in ("observation_space", "action_space"):
        with wrap_dataset_errors(f"{source}: {name}"):
            n_entries = _n_entries(json.loads(metadata[name]))
            if not n_entries <= MOST_ENTRIES:
                raise DatasetError(f"{source}: {name} has {n_entries} entries; up to {MOST_ENTRIES} are accepted.")
            deserialize_space(metadata[name])
    for name in ("env_spec", "eval_env_spec"):
        with wrap_dataset_errors(f"{source}: {name}"):
            if metadata.get(name) is not None and not isinstance(json.loads(metadata[name]), dict):
                raise DatasetError(f"{source}: {name} is {reprlib.repr(metadata[name])}; a JSON object is expected.")
    n_episodes = _n_episodes(folder, metadata["data_format"], dataset_id)
    if n_episodes != metadata["total_episodes"]:
        raise DatasetError(f"{source}: total_episodes is {metadata['total_episodes']}; there are {n_episodes} episodes.")
    return metadata


def _check_fields(metadata: dict[str, Any], source: str) -> None:
    for name, (kind, needed) in FIELDS.items():
        value = metadata.get(name)
        if type(value) not in kind and (needed or value is not None):
            expected = " or ".join(one.__name__ for one in kind)
            raise DatasetError(f"{source}: {name} is {reprlib.repr(value)}; expected is one of type {expected}.")
        if isinstance(value, int | float) and not (math.isfinite(value) and (value >= 0 or name.startswith("ref"))):
            raise DatasetError(f"{source}: {name} is {value}; a number is expected, and a count of at least 0.")
    metadata.setdefault("data_format", FORMATS[0])  # which the first versions did not name, since there was no other
    if metadata["data_format"] not in FORMATS:
        found = f"data_format is {reprlib.repr(metadata['data_format'])}"
        raise DatasetError(f"{source}: {found}; accepted are {', '.join(FORMATS)}.")


def _n_entries(space: dict[str, Any]) -> int:
    """Return how many numbers a space's entries flatten to, before it is built."""
    if space["type"] in ("Dict", "Tuple"):
        parts = space["subspaces"]
        return sum(map(_n_entries, parts.values() if isinstance(parts, dict) else parts))
    size = space.get("shape", space.get("n", space.get("nvec", 0)))
    return int(np.sum(size, dtype=object) if space["type"] == "MultiDiscrete" else math.prod(np.ravel(size).tolist()))


def _n_episodes(folder: Path, data_format: str, dataset_id: str) -> int:
    """Return how many episodes there are, whatever the metadata say."""
    data = folder / HDF5_FILE_NAME if data_format == "hdf5" else folder
    with wrap_dataset_errors(f"Minari dataset {dataset_id} ({data})"):
        if data_format != "hdf5":
            return sum(path.name.isdigit() for path in data.iterdir())
        with h5py.File(existing_file(data, "an hdf5 file"), "r") as file:
            return sum(name.startswith("episode_") for name in file)


def _score_reference(metadata: dict[str, Any]) -> ScoreReference | None:
    """The scale of normalised scores that a dataset's metadata holds, if it holds one that can be used."""
    minimum, maximum = metadata.get("ref_min_score"), metadata.get("ref_max_score")
    if minimum is None or maximum is None or not minimum < maximum:
        return None
    scale = f"Minari's scale: ref_min_score and ref_max_score of {metadata['dataset_id']}"
    return ScoreReference(float(minimum), float(maximum), scale)


class _Episode(NamedTuple):
    """
    :param read: function that returns an array of observations, actions, rewards, terminations or truncations; a part of a
        Dict or Tuple by its keys
    :param read_images: function that returns images of observations as stored: an array, or the bytes of a file each
    :param success: success flags, (T,) or, with the reset's, (T + 1,), whose last one tells of the episode; None where the
        data do not tell
    """

    read: ReadArray
    read_images: ReadArray
    success: np.ndarray | None


def _hdf5_reader(stack: contextlib.ExitStack, folder: Path, source: str) -> Callable[[int], _Episode]:
    """Reads the HDF5 file itself, since Minari's storage decodes all infos with every episode."""
    file = stack.enter_context(h5py.File(folder / HDF5_FILE_NAME, "r"))
    cache = file.id.get_mdc_config()
    cache.set_initial_size = True
    cache.initial_size = cache.min_size = cache.max_size = STRUCTURE_CACHE
    file.id.set_mdc_config(cache)

    def episode(index: int) -> _Episode:
        group = open_group(file, f"episode_{index}", source)
        where = f"{source}, episode {index}"
        infos = set(open_group(group, INFOS, where)) if INFOS in set(group) else set()
        told = next((f"{INFOS}/{name}" for name in SUCCESS if name in infos), None)

        def array(*path: str | int) -> np.ndarray:
            return read_hdf5(group, "/".join(f"_index_{key}" if isinstance(key, int) else key for key in path), where)

        return _Episode(array, lambda *path: read_images(group, "/".join(path), where), array(told) if told else None)

    return episode


def _arrow_reader(data_format: str, folder: Path, source: str) -> Callable[[int], _Episode]:
    """Reads the Arrow or Parquet files of an episode itself, since Minari's storage takes each for a single batch."""
    pyarrow = import_pyarrow(source)

    def episode(index: int) -> _Episode:
        paths = files_below(folder, str(index))
        found = [str(path) for path in paths if not path.name.startswith(("_", ".", METADATA_FILE_NAME))]
        files = pyarrow.dataset.dataset(found, format=data_format)
        missing = sorted(set(EPISODE_KEYS) - set(files.schema.names))
        if missing:
            raise DatasetError(f"{source}, episode {index}: holds no {', '.join(missing)}; the file is incomplete.")
        columns = {name: pyarrow.dataset.field(name) for name in EPISODE_KEYS}
        infos = files.schema.field(INFOS).type if INFOS in files.schema.names else pyarrow.struct([])
        names = SUCCESS if pyarrow.types.is_struct(infos) else ()
        told = next((name for name in names if infos.get_field_index(name) >= 0), None)
        if told:
            columns[INFOS] = pyarrow.dataset.field(INFOS, told)
        table = files.to_table(columns=columns)
        table.validate(full=True)

        def array(name: str, *path: str | int) -> np.ndarray:
            with wrap_dataset_errors(f"{source}, episode {index}: {name}"):
                values = table[name].combine_chunks()
                for key in path:
                    values = values.field(str(key))
                # Observations and infos are one more than actions: other columns are stored with an entry that nobody gave.
                values = values if name in ("observations", INFOS) else values[:-1]
                if not pyarrow.types.is_fixed_size_list(values.type):
                    return values.to_numpy(zero_copy_only=False)
                return values.flatten().to_numpy(zero_copy_only=False).reshape(len(values), -1)

        return _Episode(array, array, array(INFOS) if told else None)

    return episode


def make_trajectory(
    read: ReadArray, read_images: ReadArray, success: np.ndarray | None, chosen: Chosen, name: str, source: str
) -> Trajectory:
    """
    One episode of a Minari file.

    :param read: see :class:`_Episode`, also for the next two
    :param chosen: entries that are observed
    :param name: name of the episode in the file
    :param source: the file, for messages
    :raises DatasetError: one of its arrays is missing, or they differ in length
    """
    where = f"{source}, {name}"
    rewards, actions = read("rewards"), read("actions")
    n_steps = len(rewards)
    if len(actions) != n_steps:
        raise DatasetError(f"{where}: holds {len(actions)} actions for {n_steps} rewards; as many are expected.")
    columns = flatten_chosen(read, chosen, where)
    stored = {each: read_images("observations", *(() if chosen.alone else (each,))) for each in chosen.cameras}
    counts = sorted({len(each) for each in (*columns, *stored.values())})
    if len(counts) != 1 or counts[0] - n_steps not in (0, 1):
        raise DatasetError(
            f"{where}: holds {' and '.join(map(str, counts))} observations for {n_steps} rewards; "
            f"{n_steps + 1} or {n_steps} are accepted."
        )
    terminations, truncations = (
        check_flags(read(key), n_steps, f"{where}: {key}") for key in ("terminations", "truncations")
    )
    columns = columns or [np.zeros((n_steps, 1), np.float32)]
    return Trajectory(
        observations=np.concatenate(columns, axis=1)[:n_steps] if len(columns) > 1 else columns[0][:n_steps],
        images={
            camera: _images(stored[camera], n_steps, space.shape, f"{where}: {camera}")
            for camera, space in chosen.cameras.items()
        },
        actions=actions,
        rewards=rewards,
        terminated=bool(terminations[-1:].any()),
        truncated=bool(truncations[-1:].any()),
        success=None if success is None else bool(check_flags(success, len(success), f"{where}: success")[-1:].any()),
        name=name,
    )


def _images(stored: np.ndarray, n_steps: int, shape: tuple[int, ...], where: str) -> np.ndarray:
    """
    :param stored: (T, ...) or (T + 1, ...), bytes of images; or files of images: Minari 0.5.3 makes a JPEG of nearly every
        one, 0.5.4 unless it is told otherwise
    :param n_steps: T
    :param shape: shape of an image
    :return: (T, ...)
    """
    if isinstance(stored, np.ndarray) and stored.shape[1:] in (shape, (math.prod(shape),)):
        if stored.dtype != np.uint8:
            raise DatasetError(f"{where} hold {stored.dtype}; uint8 is expected.")
        return stored[:n_steps].reshape(n_steps, *shape)
    if (stored.dtype != np.uint8 and stored.dtype != object) or stored.ndim > 2:
        raise DatasetError(f"{where} have shape {stored.shape}, expected (steps, {', '.join(map(str, shape))}).")
    return decode_images(stored, n_steps, shape, where)
