"""`sb3-dtfm demo`: demonstrations, training and evaluation on robosuite's Lift, from nothing to a measured success rate."""

import argparse
import json
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
from rl_zoo3.utils import create_test_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.report.statistics import wilson
from sb3_dtfm.cli import train
from sb3_dtfm.cli.plot import plot_learning_curve
from sb3_dtfm.files import read_run, replacing
from sb3_dtfm.recording.demonstrations import record_demonstrations
from sb3_dtfm.zoo.arguments import at_least

ENV_ID = "robosuite/Lift-v0"
ENV_NAME = ENV_ID.replace("/", "-")  # RL-Zoo's spelling in folders
N_DEMONSTRATIONS = 200
DATASET_FRACTION = 0.5
EVALUATION_INTERVAL = 100  # gradient steps
TRAINING_SEED = 0
N_EVALUATION_ENVS = 4  # part of the result: each environment has a seed of its own
EVALUATION_SEED = 10_000  # far from the training evaluations', which count up from TRAINING_SEED


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm demo`. Finished parts of an interrupted demo are not repeated.

    :param argv: its arguments
    """
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm demo",
        description="Record demonstrations of robosuite's Lift, train DTFM on half of them, and measure its success.",
    )
    parser.add_argument("--output", default="demo", metavar="FOLDER", help="folder of all files, ./demo by default")
    parser.add_argument("--steps", type=at_least(1), metavar="N", help="gradient steps, those of zoo_configs by default")
    parser.add_argument("--episodes", type=at_least(1), default=50, metavar="N", help="evaluation episodes, 50 by default")
    parser.add_argument("--demonstrations", type=at_least(2), default=N_DEMONSTRATIONS, metavar="N", help="200 by default")
    options = parser.parse_args(argv)
    run_demo(Path(options.output), options.demonstrations, options.steps, options.episodes)


def run_demo(folder: Path, n_demonstrations: int, n_steps: int | None, n_episodes: int) -> dict[str, Any]:
    """
    Record, train, evaluate and plot; each stage only if its result is not in the folder.

    :param folder: folder of all files
    :param n_demonstrations: number of demonstrations to record; training sees half of them
    :param n_steps: number of gradient steps, None for that of the packaged settings
    :param n_episodes: number of episodes of the final evaluation
    :return: content of `evaluation.json`
    """
    start = time.monotonic()
    dataset = folder / "lift.hdf5"
    _announce(1, f"{n_demonstrations} demonstrations")
    record_if_missing(dataset, n_demonstrations)
    _announce(2, f"train DTFM on {DATASET_FRACTION:.0%} of them")
    run_folder = train_if_missing(folder, dataset, n_steps)
    _announce(3, f"evaluate {n_episodes} episodes")
    result = evaluate_if_missing(run_folder, n_episodes)
    tensorboard = _tensorboard_folder(folder, run_folder)
    title = f"DTFM on {ENV_ID}, {int(DATASET_FRACTION * n_demonstrations)} demonstrations"
    curve = plot_learning_curve(run_folder, folder / "learning_curve.png", tensorboard, title)
    print(
        f"\nSuccess: {result['successes']} of {result['episodes']} episodes = {result['success_rate']:.0%} "
        f"(95 % Wilson interval {result['interval'][0]:.0%} to {result['interval'][1]:.0%})\n"
        f"Model:          {_model_file(run_folder)}\n"
        f"TensorBoard:    {tensorboard}\n"
        f"Learning curve: {curve}\n"
        f"Took {(time.monotonic() - start) / 60:.1f} minutes."
    )
    return result


def record_if_missing(dataset: Path, n_demonstrations: int) -> None:
    """Record Lift demonstrations unless the file holds that many."""
    if dataset.is_file():
        with h5py.File(dataset) as file:
            if len(file["data"]) == n_demonstrations:
                print(f"{dataset} is there already.")
                return
    dataset.parent.mkdir(parents=True, exist_ok=True)
    print(record_demonstrations("lift", n_demonstrations, dataset, overwrite=True))


def train_if_missing(folder: Path, dataset: Path, n_steps: int | None) -> Path:
    """
    Train through `sb3-dtfm train`, as any other run, unless a finished run is there.

    :return: the run's folder
    """
    runs = folder / "logs" / "dtfm"
    finished = _finished_runs(runs)
    if finished:
        print(f"{finished[-1]} is there already.")
        return finished[-1]
    arguments = ["--algo", "dtfm", "--env", ENV_ID]
    arguments += ["--dataset", str(dataset), "--dataset-fraction", str(DATASET_FRACTION)]
    arguments += ["--eval-freq", str(EVALUATION_INTERVAL), "--eval-episodes", "10", "--n-eval-envs", "5"]
    arguments += ["--log-folder", str(folder / "logs"), "--tensorboard-log", str(folder / "tensorboard")]
    arguments += ["--seed", str(TRAINING_SEED), "--verbose", "0", "--progress", "--log-interval", "50"]
    if n_steps is not None:
        arguments += ["--n-timesteps", str(n_steps), "--eval-freq", str(min(EVALUATION_INTERVAL, n_steps))]
    print("sb3-dtfm train " + " ".join(arguments))
    train.main(arguments)
    return _finished_runs(runs)[-1]


def evaluate_if_missing(run_folder: Path, n_episodes: int) -> dict[str, Any]:
    """
    Success of a run's final model on episodes with seeds of their own.

    :return: successes, episodes, success_rate in [0, 1], its 95 % Wilson interval, mean_length in steps and seed
    """
    path = run_folder / "evaluation.json"
    if path.is_file():
        result = json.loads(path.read_text())
        if result["episodes"] == n_episodes:
            print(f"{path} is there already.")
            return result
    env = create_test_env(
        ENV_ID,
        n_envs=min(N_EVALUATION_ENVS, n_episodes),
        seed=EVALUATION_SEED,
        should_render=False,
        hyperparams=read_run(run_folder / ENV_NAME),
        vec_env_cls=SubprocVecEnv,
    )
    model = DTFM.load(_model_file(run_folder))
    successes: list[bool] = []

    def count(locals_: dict[str, Any], _globals: dict[str, Any]) -> None:
        if locals_["done"]:
            successes.append(bool(locals_["info"]["is_success"]))

    try:
        _, lengths = evaluate_policy(model, env, n_episodes, return_episode_rewards=True, callback=count)
    finally:
        env.close()
    assert isinstance(lengths, list)
    result = {
        "successes": sum(successes),
        "episodes": len(successes),
        "success_rate": sum(successes) / len(successes),
        "interval": wilson(sum(successes), len(successes))[1:],
        "mean_length": sum(lengths) / len(lengths),
        "seed": EVALUATION_SEED,
    }
    with replacing(path) as beside:
        beside.write_text(json.dumps(result, indent=2) + "\n")
    return result


def _model_file(run_folder: Path) -> Path:
    return run_folder / f"{ENV_NAME}.zip"


def _finished_runs(runs: Path) -> list[Path]:
    """Folders of runs whose final model is complete, oldest first."""
    folders = [folder for folder in runs.glob(f"{ENV_NAME}_*") if zipfile.is_zipfile(_model_file(folder))]
    return sorted(folders, key=lambda folder: int(folder.name.rsplit("_", 1)[1]))


def _tensorboard_folder(folder: Path, run_folder: Path) -> Path:
    """The newest log that was begun before the run's model was saved: runs that were interrupted have logs too."""
    saved = _model_file(run_folder).stat().st_mtime
    logs = [event.parent for event in (folder / "tensorboard" / ENV_NAME).glob("DTFM_*/events.*")]
    logs = [log for log in logs if log.stat().st_ctime <= saved]
    return max(logs, key=lambda log: int(log.name.rsplit("_", 1)[1]))


def _announce(stage: int, what: str) -> None:
    print(f"\n[{stage}/3] {what}", flush=True)
