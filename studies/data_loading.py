"""
Time and memory of loading a Minari dataset: `python studies/data_loading.py`.

Makes a dataset of noise in a temporary folder, and compares in fresh processes: reading all arrays of every episode with
h5py, `load_dataset` into memory, and `load_dataset` from a cache that is there already. Prints medians of three runs, the
ratio to h5py's time, and by how much the process grew at most, as a share of the float32 arrays. Linux only.
"""

import argparse
import itertools
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import h5py
import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from sb3_dtfm.data import load_dataset

DATASET_ID = "benchmark/noise-v0"
EPISODE_LENGTH = 1000
ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")
EPISODES_AT_ONCE = 20
N_RUNS = 3


def episodes(n_episodes: int, observation_dim: int, action_dim: int) -> Iterator[EpisodeBuffer]:
    """float64 as in Minari's MuJoCo sets."""
    rng = np.random.default_rng(0)
    for index in range(n_episodes):
        yield EpisodeBuffer(
            id=index,
            observations=rng.normal(size=(EPISODE_LENGTH + 1, observation_dim)),
            actions=rng.uniform(-1.0, 1.0, (EPISODE_LENGTH, action_dim)),
            rewards=rng.normal(size=EPISODE_LENGTH),
            terminations=np.zeros(EPISODE_LENGTH, bool),
            truncations=np.arange(EPISODE_LENGTH) == EPISODE_LENGTH - 1,
        )


def make_dataset(n_episodes: int, observation_dim: int, action_dim: int) -> None:
    recorded = episodes(n_episodes, observation_dim, action_dim)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = minari.create_dataset_from_buffers(
            DATASET_ID,
            [next(recorded)],
            observation_space=spaces.Box(-np.inf, np.inf, (observation_dim,), np.float64),
            action_space=spaces.Box(-1.0, 1.0, (action_dim,), np.float32),
        )
    while batch := list(itertools.islice(recorded, EPISODES_AT_ONCE)):
        dataset.update_dataset_from_buffer(batch)


def read_raw() -> None:
    path = Path(minari.load_dataset(DATASET_ID).storage.data_path) / "main_data.hdf5"
    with h5py.File(path, "r") as file:
        for index in range(len(file)):
            for name in ARRAYS:
                file[f"episode_{index}"][name][:]


WAYS = {
    "h5py, all arrays": read_raw,
    "load_dataset": lambda: load_dataset(DATASET_ID),
    "load_dataset, cached": lambda: load_dataset(DATASET_ID, cache_dir=os.environ["BENCHMARK_CACHE"]),
}


def peak_memory() -> int:
    """Bytes of this process alone; `resource` would report its parent's where that was larger."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) * 1024


def measure(way: str) -> tuple[float, int]:
    """Seconds, and bytes by which the process grew at most."""
    before = peak_memory()
    start = time.perf_counter()
    WAYS[way]()
    seconds = time.perf_counter() - start
    return seconds, peak_memory() - before


def measure_in_fresh_process(way: str) -> tuple[float, int]:
    output = subprocess.run([sys.executable, __file__, "--measure", way], check=True, capture_output=True, text=True)
    seconds, grown = json.loads(output.stdout)
    return seconds, grown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=1000, help=f"of {EPISODE_LENGTH} steps each")
    parser.add_argument("--observation-dim", type=int, default=17)
    parser.add_argument("--action-dim", type=int, default=6)
    parser.add_argument("--measure", choices=WAYS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure)))
        return
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = f"{folder}/datasets"
        os.environ["BENCHMARK_CACHE"] = f"{folder}/cache"
        make_dataset(options.episodes, options.observation_dim, options.action_dim)
        WAYS["load_dataset, cached"]()  # builds the cache
        runs = {way: [] for way in WAYS}
        for _ in range(N_RUNS):  # in turn, so that a slow moment of the machine does not hit one way alone
            for way in WAYS:
                runs[way].append(measure_in_fresh_process(way))
    payload = 4 * options.episodes * EPISODE_LENGTH * (options.observation_dim + options.action_dim + 2)
    size = f"{options.observation_dim} observations, {options.action_dim} actions"
    print(f"{options.episodes * EPISODE_LENGTH:,} steps, {size}: {payload / 1e6:,.0f} MB of float32\n")
    print("| | seconds | ratio to h5py | peak memory / float32 arrays |\n| --- | --- | --- | --- |")
    medians = {way: [statistics.median(column) for column in zip(*runs[way], strict=True)] for way in WAYS}
    raw_seconds = medians["h5py, all arrays"][0]
    for way, (seconds, grown) in medians.items():
        print(f"| {way} | {seconds:.2f} | {seconds / raw_seconds:.2f} | {grown / payload:.2f} |")


if __name__ == "__main__":
    main()
