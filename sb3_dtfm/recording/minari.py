"""Writes recorded episodes as a Minari dataset."""

import errno
import io
import os
import shutil
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id
from minari.dataset.minari_storage import MinariStorage, is_image_space
from minari.namespace import create_namespace, list_local_namespaces
from minari.storage import get_dataset_path
from PIL import Image

from sb3_dtfm.data.minari import HDF5_FILE_NAME
from sb3_dtfm.data.trajectories import DatasetError
from sb3_dtfm.envs import image_spaces
from sb3_dtfm.files import find_leftovers, hidden_name
from sb3_dtfm.recording.episodes import RecordedEpisode, stack_observations

# A dataset that is being replaced, in the hidden folder of the new one.
OLD = "old"
# Bytes that HDF5 and the metadata may need beside the episodes.
SPARE = 2**20


def check_dataset_id(dataset_id: str, overwrite: bool) -> None:
    """
    Refuse an id that cannot be written.

    :raises DatasetError: malformed, or there is such a dataset and `overwrite` is not set
    """
    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError) as error:
        raise DatasetError(f"{dataset_id!r} is no Minari id; expected namespace/name-vN.") from error
    path = get_dataset_path(dataset_id)
    if path.exists() and not overwrite:
        raise DatasetError(f"Minari dataset {dataset_id} exists at {path}; choose another id or allow to overwrite it.")


def write_minari(
    dataset_id: str, episodes: Iterable[RecordedEpisode], env: gym.Env, metadata: dict[str, Any]
) -> minari.MinariDataset:
    """
    Write episodes as they come into a hidden folder, which takes the dataset's place when it is complete.

    :param dataset_id: `namespace/name-vN`; a dataset that is there is replaced
    :param episodes: recorded episodes, at least one
    :param env: environment whose spaces and spec are stored
    :param metadata: entries of the dataset's metadata; `ref_max_score`, the episodes' mean return, is added
    """
    target = get_dataset_path(dataset_id)
    namespace = parse_dataset_id(dataset_id)[0]
    _clear_up(get_dataset_path(), target)
    staging = get_dataset_path() / hidden_name(_plain(target))
    staging.mkdir()
    try:
        (staging / "new").mkdir()
        storage = MinariStorage.new(staging / "new" / "data", env.observation_space, env.action_space, _storable_spec(env))
        storage.update_metadata({"dataset_id": dataset_id, "minari_version": minari.__version__})
        returns: list[float] = []
        for episode in episodes:
            seen = stack_observations(episode.observations)
            _check_space(staging, seen, episode)
            storage.update_episodes([_episode_buffer(episode, seen, env.observation_space)])
            _write_images(storage.data_path / HDF5_FILE_NAME, len(returns), seen, env.observation_space)
            returns.append(float(np.sum(episode.rewards)))
        storage.update_metadata({**metadata, "dataset_size": storage.get_size(), "ref_max_score": float(np.mean(returns))})
        if namespace is not None and namespace not in list_local_namespaces():
            create_namespace(namespace)
        if target.exists():
            target.rename(staging / OLD)
        (staging / "new").rename(target)
    finally:
        if (staging / OLD).exists() and not target.exists():
            (staging / OLD).rename(target)
        shutil.rmtree(staging, ignore_errors=True)
    return minari.MinariDataset(target / "data")


def _plain(target: Path) -> str:
    return "-".join(target.relative_to(get_dataset_path()).parts)


def _clear_up(folder: Path, target: Path) -> None:
    """Remove what killed recordings left; a dataset that one had moved away to replace it comes back."""
    for leftover in find_leftovers(folder):
        if (leftover / OLD).exists():
            if not leftover.name.startswith(f".{_plain(target)}."):
                continue
            if not target.exists():
                (leftover / OLD).rename(target)
        shutil.rmtree(leftover, ignore_errors=True)


def _check_space(folder: Path, seen: Any, episode: RecordedEpisode) -> None:
    """
    Stop before the disk is full, where HDF5 ends in a segmentation fault.

    :raises OSError: an episode may not fit
    """
    needed = 2 * sum(map(_n_bytes, (seen, episode.actions, episode.rewards))) + SPARE
    if shutil.disk_usage(folder).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder.parent))


def _n_bytes(observations: Any) -> int:
    if isinstance(observations, dict):
        return sum(map(_n_bytes, observations.values()))
    return np.asarray(observations).nbytes


def _exact(space: spaces.Space, values: Any) -> Any:
    """Values of steps that Minari stores as they are: it makes JPEG of uint8. Images are left to :func:`_write_images`."""
    if isinstance(space, spaces.Dict):
        return {key: _exact(space[key], values[key]) for key in values if key not in image_spaces(space)}
    if image_spaces(space):
        return np.zeros((len(values), 1, 1), np.uint8)
    return values.astype(np.int16) if values.dtype == np.uint8 else values


def _write_images(path: Path, number: int, seen: Any, space: spaces.Space) -> None:
    """
    Store the images of an episode without loss: Minari reads PNG where it would have written JPEG.

    :param path: the file of the dataset
    :param number: number of the episode
    :param seen: observations of its steps, (T + 1, ...)
    :param space: observation space
    """
    with h5py.File(path, "a") as file:
        group = file[f"episode_{number}"]
        for camera, image in image_spaces(space).items():
            alone = not isinstance(space, spaces.Dict)
            images, name = (seen, "observations") if alone else (seen[camera], f"observations/{camera}")
            if alone:
                del group[name]
            if not is_image_space(image):  # by Minari's rule, which then expects no file of an image
                group.create_dataset(name, data=images, compression="gzip", chunks=(1, *images.shape[1:]))
                continue
            stored = group.create_dataset(name, (len(images),), h5py.vlen_dtype(np.uint8))
            for step, each in enumerate(images):
                content = io.BytesIO()
                Image.fromarray(each[:, :, 0] if each.shape[2] == 1 else each).save(content, "PNG")
                stored[step] = np.frombuffer(content.getbuffer(), np.uint8)


def _episode_buffer(episode: RecordedEpisode, seen: Any, space: spaces.Space) -> EpisodeBuffer:
    ends = np.zeros((2, len(episode.actions)), dtype=bool)
    ends[:, -1] = episode.terminated, episode.truncated
    told = [False, *map(bool, episode.reported)]  # as many as observations; the last one tells of the episode
    return EpisodeBuffer(
        seed=episode.seed,
        observations=_exact(space, seen),
        actions=np.stack(episode.actions),
        rewards=np.asarray(episode.rewards, dtype=np.float64),
        terminations=ends[0],
        truncations=ends[1],
        infos=None if episode.success is None else {"is_success": np.array(told)},
    )


def _storable_spec(env: gym.Env) -> EnvSpec | None:
    """The environment's spec if it can be written to a file; the dataset can do without it."""
    if env.spec is None:
        return None
    try:
        env.spec.to_json()
    except (TypeError, ValueError) as error:
        warnings.warn(f"The environment cannot be recovered from the dataset: {error}", stacklevel=2)
        return None
    return env.spec
