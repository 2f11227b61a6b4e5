"""Writes recorded episodes as a robomimic hdf5 file, in the layout of robomimic 1.5."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_dtfm.files import replacing
from sb3_dtfm.recording.episodes import RecordedEpisode, stack_observations

VALIDATION_SHARE = 0.1


def refuse_existing(path: Path, overwrite: bool) -> None:
    """
    :raises FileExistsError: `path` exists and is not to be overwritten, or is a folder
    """
    if path.is_dir():
        raise FileExistsError(f"{path} is a folder; the path of a file is expected.")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; pass overwrite=True (--overwrite) to replace it.")


def write_robomimic(
    path: str | os.PathLike[str], episodes: Iterable[RecordedEpisode], env_args: dict[str, Any], seed: int = 0
) -> None:
    """
    Write episodes into a file, which appears when it is complete.

    :param path: the file, which is replaced if it is there; its folder is made if necessary
    :param episodes: episodes with dicts of observations, simulator states and the scene
    :param env_args: description of the environment, stored as JSON
    :param seed: seed of the filter keys `train`, `valid` (a tenth) and `50_percent`
    """
    # In memory first: HDF5 ends in a segmentation fault where the disk is full.
    with replacing(path) as beside, h5py.File(beside, "w", driver="core", backing_store=False) as file:
        data = file.create_group("data")
        lengths = [_write_demo(data, f"demo_{number}", episode) for number, episode in enumerate(episodes)]
        data.attrs["total"] = sum(lengths)
        data.attrs["env_args"] = json.dumps(env_args, indent=4)
        for key, chosen in _filter_keys(len(lengths), seed).items():
            file[f"mask/{key}"] = np.array([f"demo_{number}" for number in np.sort(chosen)], dtype="S")
        file.flush()
        beside.write_bytes(file.id.get_file_image())


def _write_demo(data: h5py.Group, name: str, episode: RecordedEpisode) -> int:
    """Write one episode and return its number of steps."""
    demo = data.create_group(name)
    n_steps = len(episode.actions)
    for key, values in stack_observations(episode.observations).items():
        if values.dtype == np.uint8:  # images, of which the next ones would double the file
            demo.create_dataset(f"obs/{key}", data=values[:-1], compression="gzip", chunks=(1, *values.shape[1:]))
            continue
        demo[f"obs/{key}"] = values[:-1]
        demo[f"next_obs/{key}"] = values[1:]
    demo["actions"] = np.stack(episode.actions)
    demo["rewards"] = np.asarray(episode.rewards, np.float64)
    demo["dones"] = np.append(np.zeros(n_steps - 1, np.int64), 1)
    demo["states"] = np.stack(episode.states)
    demo.attrs["num_samples"] = n_steps
    demo.attrs["model_file"] = episode.model_file
    return n_steps


def _filter_keys(n_episodes: int, seed: int) -> dict[str, np.ndarray]:
    """Numbers of the episodes in each filter key."""
    order = np.random.default_rng(seed).permutation(n_episodes)
    n_valid = round(VALIDATION_SHARE * n_episodes)
    return {"train": order[n_valid:], "valid": order[:n_valid], "50_percent": order[: (n_episodes + 1) // 2]}
