"""Repositories of Hugging Face's hub: their content, and the part of it that a download trusts."""

import argparse
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from pprint import pformat
from typing import Any, NamedTuple

import yaml
from huggingface_hub import EvalResult, HfApi, ModelCard, ModelCardData, snapshot_download
from huggingface_hub.errors import HfHubHTTPError
from huggingface_sb3 import EnvironmentName, ModelName, ModelRepoId

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.files import replacing
from sb3_dtfm.zoo.arguments import WRAPPER, UsageError, check_algorithm

CARD, SETTINGS, RESULTS, VIDEO = "README.md", "settings.json", "results.json", "replay.mp4"
LARGEST_SETTINGS = 1_000_000  # bytes


class HubError(OSError):
    """The hub cannot be reached, or refuses."""


class Settings(NamedTuple):
    """
    Everything that acting needs besides the model.

    :param algo: a key of `ALGORITHMS`
    :param env: Gymnasium id
    :param target_return: target return in reward units
    :param env_kwargs: arguments of ``gymnasium.make``, values of JSON
    """

    algo: str
    env: str
    target_return: float
    env_kwargs: dict[str, Any]

    @property
    def model_name(self) -> ModelName:
        """Name of the model and, by default, of its repository."""
        return ModelName(self.algo, EnvironmentName(self.env))

    def write(self, folder: Path) -> None:
        """
        :param folder: folder of the repository
        :raises UsageError: `env_kwargs` with something else than values of JSON
        """
        try:
            text = json.dumps(self._asdict(), indent=1)
        except TypeError as error:
            raise UsageError(
                f"env_kwargs {self.env_kwargs}: only numbers, texts, lists and the like can be pushed."
            ) from error
        with replacing(folder / SETTINGS) as path:
            path.write_text(text + "\n")

    @classmethod
    def read(cls, folder: Path) -> "Settings":
        """
        Read what others wrote as data, and check it.

        :param folder: folder of the repository
        :raises FileNotFoundError: `sb3-dtfm push` did not make it
        :raises ValueError: something else than settings
        """
        path = folder / SETTINGS
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist; expected a repository that `sb3-dtfm push` made.")
        if path.stat().st_size > LARGEST_SETTINGS:
            raise ValueError(f"{path} has {path.stat().st_size} bytes; settings have {LARGEST_SETTINGS} at most.")
        try:
            settings = cls(**json.loads(path.read_text()))
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} holds no settings: {error}.") from error
        expected = (settings.algo in ALGORITHMS, isinstance(settings.env, str), isinstance(settings.env_kwargs, dict))
        if not all(expected) or not _is_finite(settings.target_return):
            raise ValueError(f"{path}: expected algo, env, a finite target_return and env_kwargs, found {settings}.")
        return settings

    def write_run(self, run: Path) -> None:
        """
        Write what RL-Zoo's `enjoy` reads, in plain YAML.

        :param run: the run's folder
        """
        folder = run / EnvironmentName(self.env)
        folder.mkdir(parents=True)
        config = {"env_wrapper": [{WRAPPER: {"target_return": self.target_return}}]}
        arguments = {"algo": self.algo, "env": self.env, "env_kwargs": self.env_kwargs}
        for name, content in (("config.yml", config), ("args.yml", arguments)):
            (folder / name).write_text(yaml.safe_dump(content))


class Result(NamedTuple):
    """
    Result of an evaluation.

    :param mean_reward: mean return of the episodes, reward units
    :param std_reward: standard deviation of their returns
    :param n_episodes: number of episodes
    """

    mean_reward: float
    std_reward: float
    n_episodes: int


def target_return_of(hyperparams: Mapping[str, Any]) -> float:
    """
    A run's target return. RL-Zoo imports and calls what `env_wrapper` names, so a repository holds this number alone.

    :param hyperparams: settings of the run
    :raises UsageError: it acts behind another wrapper
    """
    wrappers = hyperparams.get("env_wrapper")
    wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
    if len(wrappers) == 1 and isinstance(wrappers[0], dict) and list(wrappers[0]) == [WRAPPER]:
        return float(wrappers[0][WRAPPER]["target_return"])
    raise UsageError(f"env_wrapper {wrappers}: a model can be pushed that acts behind {WRAPPER} alone.")


def write_card(
    folder: Path, repo_id: str, settings: Settings, hyperparams: Mapping[str, Any], result: Result, has_video: bool
) -> None:
    """
    Write the model card: how to get the model, what it reached, what it was trained with.

    :param folder: folder of the repository
    :param repo_id: organisation/name
    :param settings: settings of acting
    :param hyperparams: settings of training; the card shows absolute paths among them by their last part
    :param result: result of an evaluation
    :param has_video: whether there is a video in the repository
    """
    algorithm = ALGORITHMS[settings.algo].__name__
    score = EvalResult(
        task_type="reinforcement-learning",
        dataset_type=settings.env,
        dataset_name=settings.env,
        metric_type="mean_reward",
        metric_value=f"{result.mean_reward:.2f} +/- {result.std_reward:.2f}",
    )
    tags = [settings.env, "offline-reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3"]
    data = ModelCardData(library_name="sb3-dtfm", model_name=algorithm, tags=tags, eval_results=[score])
    organization, name = repo_id.split("/")
    named = "" if name == settings.model_name else f" -name {name}"
    choice = f"--algo {settings.algo} --env {settings.env}"
    env_kwargs = f", **{settings.env_kwargs!r}" if settings.env_kwargs else ""
    text = f"""
# {algorithm} on {settings.env}
Trained by offline reinforcement learning, with sb3-dtfm on Stable-Baselines3. In {result.n_episodes} episodes with a target
return of {settings.target_return:g} it reached {result.mean_reward:.2f} ± {result.std_reward:.2f} (standard deviation).
{f"[Video]({VIDEO})" if has_video else ""}

## On the command line
```
sb3-dtfm pull {choice} -orga {organization}{named}
sb3-dtfm enjoy {choice}
```

## In Python
Loading the model runs nothing that its file holds.
```python
import gymnasium as gym
from huggingface_hub import hf_hub_download
from stable_baselines3.common.evaluation import evaluate_policy
from sb3_dtfm import {algorithm}
from sb3_dtfm.envs import ReturnToGoWrapper

model = {algorithm}.load(hf_hub_download("{repo_id}", "{settings.model_name.filename}"))
env = ReturnToGoWrapper(gym.make("{settings.env}"{env_kwargs}), target_return={settings.target_return!r})
print(evaluate_policy(model, env, n_eval_episodes=10, warn=False))
```

## Trained with
```python
{pformat(_shown(hyperparams), sort_dicts=False)}
```
"""
    with replacing(folder / CARD) as path:
        path.write_text(f"---\n{data.to_yaml()}\n---\n{text}", encoding="utf-8")
    ModelCard.load(folder / CARD)  # fails where the hub could not read it


def upload(folder: Path, repo_id: str, message: str) -> str:
    """
    :param folder: folder to upload as a whole
    :param repo_id: organisation/name, made if there is none
    :param message: message of the commit
    :return: address of the repository
    :raises HubError: no network, no right to write
    """
    try:
        api = HfApi()
        url = api.create_repo(repo_id, exist_ok=True)
        api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message)
    except Exception as error:  # the hub's client and its connection raise many kinds
        raise HubError(
            f"{repo_id}: {_reason(error)}; `hf auth login` lets you in, --repo-folder writes a folder."
        ) from error
    return str(url)


def download(repo_id: str) -> Path:
    """
    :param repo_id: organisation/name
    :return: a folder of the hub's cache, with the model, its settings and its card
    :raises HubError: no network, no such repository
    """
    try:
        return Path(str(snapshot_download(repo_id, allow_patterns=["*.zip", SETTINGS, CARD])))
    except Exception as error:
        raise HubError(f"{repo_id}: {_reason(error)}; --repo-folder takes a folder.") from error


def add_repository_arguments(parser: argparse.ArgumentParser) -> None:
    """
    RL-Zoo's arguments that name a repository, and that of a folder.

    :param parser: parser that gets them
    """
    argument = parser.add_argument
    argument("-orga", "--organization", required=True, help="user or organisation on the hub")
    argument("-name", "--repo-name", metavar="NAME", help="name of the repository, ALGO-ENV by default")
    argument("--repo-folder", type=Path, metavar="FOLDER", help="a folder instead of the hub")


def repository_id(options: argparse.Namespace) -> str:
    """
    :param options: parsed arguments of :func:`add_repository_arguments`, algo and env
    :raises UsageError: an unknown algorithm, or one whose files are pickles
    """
    check_algorithm(options.algo)
    if options.algo not in ALGORITHMS:
        raise UsageError(
            f"--algo {options.algo}: accepted are {' and '.join(ALGORITHMS)}. RL-Zoo's load_from_hub "
            "downloads models of SB3's algorithms."
        )
    return ModelRepoId(options.organization, options.repo_name or ModelName(options.algo, options.env))


def copy_model(source: Path, target: Path) -> None:
    """
    :param source: zip file of a model
    :param target: file to write, replaced if it is there
    """
    with replacing(target) as path:
        shutil.copyfile(source, path)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _reason(error: Exception) -> str:
    status = f"{error.response.status_code} " if isinstance(error, HfHubHTTPError) and error.response is not None else ""
    return f"{status}{type(error).__name__}: {' '.join(str(error).split())}"


def _shown(value: Any) -> Any:
    """Prepare settings for everybody to read: plain containers, and no path of a machine."""
    if isinstance(value, Mapping):
        return {str(key): _shown(part) for key, part in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_shown(part) for part in value]
    return Path(value).name if isinstance(value, str) and value.startswith("/") else value
