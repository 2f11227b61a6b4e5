"""Origin of a row: the code, the machine, and the data."""

import contextlib
import json
import os
import platform
import re
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import torch as th

import sb3_dtfm
from sb3_dtfm.data import TrajectoryBuffer, load_dataset_for, without_pickles
from sb3_dtfm.data.inspection import BEST_SHARE, return_reference
from sb3_dtfm.data.minari import is_minari, open_minari
from sb3_dtfm.optimization import multiplies_bfloat16
from sb3_dtfm.zoo.arguments import with_target_return

PACKAGES = ("sb3-dtfm", "torch", "stable-baselines3", "rl_zoo3", "gymnasium", "mujoco", "robosuite", "numpy")
GIT_TIMEOUT = 20  # seconds


def commit() -> str | None:
    """Commit of this package's sources, with "-dirty" if they were changed since; None outside a git checkout."""
    source = Path(sb3_dtfm.__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(source.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=GIT_TIMEOUT, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", source.name)  # a package inside someone else's repository is not of its commit
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "--untracked-files=no", ":/") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, as far as they are installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def hardware(device: th.device) -> dict[str, Any]:
    """
    The machine that trains, without its name.

    :param device: device of the model
    """
    return {
        "cpu": _cpu_name(),
        "cores": n_cores(),
        "threads": th.get_num_threads(),
        "bfloat16": multiplies_bfloat16(device),
        "gpu": th.cuda.get_device_name(device) if device.type == "cuda" else None,
    }


def n_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.*)$", info.read_text(), re.MULTILINE) if info.is_file() else None
    return found[1] if found else platform.processor() or platform.machine()


def read_data(env_id: str, settings: dict[str, Any]) -> TrajectoryBuffer:
    """
    All episodes of a run's dataset, as `train` reads them.

    :param env_id: Gymnasium id
    :param settings: settings of the run; `dataset`, `dataset_kwargs`, `env_wrapper` and `env_kwargs` count
    :raises DatasetError: it cannot be read, or was recorded on another task; versions may differ
    """
    from rl_zoo3.utils import get_wrapper_class  # an extra

    wrap = get_wrapper_class({"env_wrapper": with_target_return(None, settings.get("env_wrapper"))})
    assert wrap is not None
    with contextlib.closing(wrap(gym.make(env_id, **(settings.get("env_kwargs") or {})))) as env:
        return load_dataset_for(env, settings["dataset"], **without_pickles(settings.get("dataset_kwargs")))


def describe_data(buffer: TrajectoryBuffer, dataset: str, recorded_from: str | None = None) -> dict[str, Any]:
    """
    Describe what a dataset was recorded from, and how good that was: the scale of normalised scores.

    :param buffer: episodes of the dataset
    :param dataset: Minari id, robomimic file or flat arrays
    :param recorded_from: agent or demonstrator, read from the dataset's metadata if not given
    :return: dataset (a file without its folder), recorded_from, n_episodes, n_steps; mean_return and success_rate of the
        episodes, best_return and best_success of the best tenth of them; best_return is the mean of all where the start
        decides, as the best had the easiest starts. Success, in [0, 1], is None where the data do not tell
    """
    reference, best = return_reference(buffer), buffer.best(best_share=BEST_SHARE)
    best_success = float(best.successes.mean())
    in_file = Path(dataset).expanduser().is_file()
    in_hdf5 = h5py.is_hdf5(Path(dataset).expanduser())
    source_of = _robomimic_source if in_hdf5 else _minari_source if is_minari(dataset) else _not_named
    return {
        "dataset": Path(dataset).name if in_file else dataset,
        "recorded_from": recorded_from or source_of(dataset),
        "n_episodes": buffer.n_episodes,
        "n_steps": len(buffer),
        "mean_return": round(reference.recorded, 4),
        "best_return": round(reference.suggested, 4),
        "success_rate": reference.success_rate,
        "best_success": None if np.isnan(best_success) else best_success,
    }


def _not_named(dataset: str) -> str:
    return "not named"


def _minari_source(dataset_id: str) -> str:
    stored = open_minari(dataset_id).storage.metadata
    return ": ".join(str(stored[key]) for key in ("algorithm_name", "description") if stored.get(key)) or "not named"


def _robomimic_source(path: str) -> str:
    """The task; such files do not say who demonstrated."""
    with h5py.File(Path(path).expanduser()) as file:
        env_args = json.loads(file["data"].attrs.get("env_args", "{}"))  # the reader has checked it
    version = env_args.get("env_version")
    return f"demonstrations of {env_args.get('env_name', 'a task not named')}" + (
        f", robosuite {version}" if version else ""
    )
