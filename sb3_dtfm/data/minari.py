"""Reading Minari datasets into a `TrajectoryBuffer`."""

import itertools
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
from gymnasium import spaces
from minari.dataset.minari_dataset import parse_dataset_id
from minari.storage import get_dataset_path

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint
from sb3_dtfm.data.storage import FileStorage
from sb3_dtfm.data.trajectories import DatasetError, ScoreReference, Trajectory
from sb3_dtfm.envs.return_to_go import flatten_observation_space, sort_observation_space

HDF5_FILE_NAME = "main_data.hdf5"
# Bytes that HDF5 may keep of a file's structure; its own limit is a third of a usual dataset's size.
STRUCTURE_CACHE = 2**20
EPISODE_KEYS = ("observations", "actions", "rewards", "terminations", "truncations")


def is_minari(dataset: Any) -> bool:
    """Whether this is an opened Minari dataset or an id of one."""
    if not isinstance(dataset, str):
        return isinstance(dataset, minari.MinariDataset)
    try:
        parse_dataset_id(dataset)
    except (ValueError, TypeError):
        return False
    return True


def fingerprint_minari(dataset: str | minari.MinariDataset, options: dict[str, Any]) -> Fingerprint:
    """
    Of a dataset as it is now, downloaded if necessary, and of its choice of episodes.

    :param dataset: as for :func:`load_minari`, which has no options
    """
    dataset = open_minari(dataset) if isinstance(dataset, str) else dataset
    episodes = dataset.episode_indices.tolist()
    is_whole = episodes == list(range(dataset.storage.total_episodes))
    return Fingerprint.of(dataset.id, Path(dataset.storage.data_path), "all" if is_whole else episodes)


def load_minari(dataset: str | minari.MinariDataset, storage: FileStorage | None = None) -> TrajectoryBuffer:
    """
    Read a Minari dataset: a local one, else one that Minari's own client downloads.

    :param dataset: id (`namespace/name-vN`) or an opened dataset, whose choice of episodes is kept
    :param storage: where the steps go, memory if not given
    :return: its episodes, with the normalised-score scale of its metadata where it names one
    :raises DatasetError: neither found nor downloaded, damaged, or not fit for learning (names the file and episode)
    """
    if isinstance(dataset, str):
        dataset = open_minari(dataset)
    hdf5_file = Path(dataset.storage.data_path) / HDF5_FILE_NAME
    in_hdf5 = hdf5_file.exists()
    source = f"Minari dataset {dataset.id} ({hdf5_file if in_hdf5 else hdf5_file.parent})"
    if len(dataset.episode_indices) == 0:
        raise DatasetError(f"{source}: holds no episode; at least one is needed.")
    try:
        observation_space = flatten_observation_space(dataset.observation_space)
    except ValueError as error:
        raise DatasetError(f"{source}: {error}") from error
    try:
        return TrajectoryBuffer.from_trajectories(
            _read_hdf5(dataset, source, hdf5_file) if in_hdf5 else _read_storage(dataset, source),
            dataset.action_space,
            observation_space,
            n_steps=dataset.total_steps,
            source=source,
            score_reference=score_reference(dataset),
            env_id=dataset.env_spec.id if dataset.env_spec else None,
            storage=storage,
        )
    except (OSError, LookupError, RuntimeError) as error:
        raise DatasetError(f"{source}: the file is damaged or incomplete: {error}") from error


def open_minari(dataset_id: str) -> minari.MinariDataset:
    """
    Open a local dataset, or download it first.

    :param dataset_id: `namespace/name-vN`
    :raises DatasetError: malformed id, damaged local files, or neither found nor downloaded
    """
    if not is_minari(dataset_id):
        raise DatasetError(f"{dataset_id!r} is no Minari id; expected namespace/name-vN.")
    data_path = get_dataset_path(dataset_id) / "data"
    if not data_path.exists():
        _download(dataset_id)
    try:
        return minari.load_dataset(dataset_id)
    except Exception as error:  # Minari checks its files with assert, KeyError and ValueError alike
        raise DatasetError(f"Minari dataset {dataset_id} ({data_path}) is damaged or incomplete: {error!r}") from error


def _download(dataset_id: str) -> None:
    try:
        minari.download_dataset(dataset_id)
    except Exception as error:  # whatever the remote's client raises
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            local = sorted(minari.list_local_datasets())
        raise DatasetError(
            f"Minari dataset {dataset_id} is not in {get_dataset_path()} (set by MINARI_DATASETS_PATH), which holds "
            f"{', '.join(local) if local else 'no dataset'}; and it cannot be downloaded: {error}"
        ) from error


def score_reference(dataset: minari.MinariDataset) -> ScoreReference | None:
    """The scale of normalised scores that a dataset's metadata holds, if it holds one that can be used."""
    metadata = dataset.storage.metadata
    minimum, maximum = metadata.get("ref_min_score"), metadata.get("ref_max_score")
    if minimum is None or maximum is None or not minimum < maximum:
        return None
    scale = f"Minari's scale: ref_min_score and ref_max_score of {dataset.id}"
    return ScoreReference(float(minimum), float(maximum), scale)


def _read_hdf5(dataset: minari.MinariDataset, source: str, path: Path) -> Iterator[Trajectory]:
    """Reads the HDF5 file itself, since Minari's storage decodes all infos with every episode."""
    with h5py.File(path, "r") as file:
        cache = file.id.get_mdc_config()
        cache.set_initial_size = True
        cache.initial_size = cache.min_size = cache.max_size = STRUCTURE_CACHE
        file.id.set_mdc_config(cache)
        for index in dataset.episode_indices:
            try:
                yield make_trajectory(file[f"episode_{index}"], dataset.observation_space, f"episode {index}", source)
            except KeyError:
                keys = set(file.get(f"episode_{index}", ()))
                missing = [key for key in EPISODE_KEYS if key not in keys]
                if not missing:
                    raise
                raise DatasetError(
                    f"{source}, episode {index}: holds no {', '.join(missing)}; the file is incomplete."
                ) from None


def _read_storage(dataset: minari.MinariDataset, source: str) -> Iterator[Trajectory]:
    """Reads through Minari's storage: Arrow and Parquet."""
    episodes = dataset.storage.get_episodes(dataset.episode_indices)
    for index, episode in zip(dataset.episode_indices, episodes, strict=True):
        yield make_trajectory(episode, dataset.observation_space, f"episode {index}", source)


def make_trajectory(episode: Mapping[str, Any], observation_space: spaces.Space, name: str, source: str) -> Trajectory:
    """
    One episode of a Minari file.

    :param episode: HDF5 group or dict with observations, actions, rewards, terminations, truncations
    :param observation_space: the dataset's own
    :param name: what the file calls the episode
    :param source: the file, for messages
    :raises DatasetError: its arrays differ in length
    :raises KeyError: one of them is missing
    """
    rewards = np.asarray(read_array(episode, "rewards"), dtype=np.float64)
    n_steps = len(rewards)
    columns = flatten_observations(episode, "observations", sort_observation_space(observation_space))
    counts = sorted({len(column) for column in columns})
    if len(counts) != 1 or counts[0] - n_steps not in (0, 1):
        raise DatasetError(
            f"{source}, {name}: holds {' and '.join(map(str, counts))} observations for {n_steps} rewards; "
            f"{n_steps + 1} or {n_steps} are accepted."
        )
    return Trajectory(
        observations=np.concatenate(columns, axis=1)[:n_steps] if len(columns) > 1 else columns[0][:n_steps],
        actions=read_array(episode, "actions"),
        rewards=rewards,
        terminated=bool(n_steps and read_array(episode, "terminations")[-1]),
        truncated=bool(n_steps and read_array(episode, "truncations")[-1]),
        name=name,
    )


def flatten_observations(parent: Any, key: str | int, space: spaces.Space) -> list[np.ndarray]:
    """
    A whole episode's observations as columns of the vector that the wrapper makes of one observation.

    :param parent: HDF5 group, dict or tuple that holds T + 1 (or T) entries
    :param key: under this name, or in groups, dicts and tuples of that name for Dict and Tuple
    :param space: observation space with sorted keys
    :return: arrays (T + 1, .) to be joined along the second axis
    """
    if isinstance(space, spaces.Dict):
        columns = [flatten_observations(parent[key], name, part) for name, part in space.spaces.items()]
        return list(itertools.chain.from_iterable(columns))
    if isinstance(space, spaces.Tuple):
        data = parent[key]
        names = [f"_index_{i}" if isinstance(data, h5py.Group) else i for i in range(len(space))]
        columns = [flatten_observations(data, name, part) for name, part in zip(names, space.spaces, strict=True)]
        return list(itertools.chain.from_iterable(columns))
    values = read_array(parent, key)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return [np.stack([np.asarray(spaces.flatten(space, value)) for value in values])]
    return [values.reshape(len(values), -1)]


def read_array(parent: Any, key: str | int) -> np.ndarray:
    """
    All values of an array.

    Most of the time that `parent[key][:]` takes goes into h5py's objects, so HDF5 is asked directly.

    :param parent: HDF5 group, dict or tuple
    :param key: what the array is called there
    :raises KeyError: nothing is called so
    """
    if not isinstance(parent, h5py.Group):
        return np.asarray(parent[key])
    data = h5py.h5d.open(parent.id, str(key).encode())
    values = np.empty(data.shape, data.dtype)
    if values.size > 0:
        data.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values
