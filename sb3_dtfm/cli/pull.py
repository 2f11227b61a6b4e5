"""`sb3-dtfm pull`: a model that `push` has uploaded, as a run for `enjoy`, `video` and the others. Nothing in it is run."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import get_latest_run_id

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.zoo import hub
from sb3_dtfm.zoo.arguments import UsageError


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm pull`.

    :param argv: its arguments
    """
    options = _parser().parse_args(argv)
    repo_id = hub.repository_id(options)
    run = _new_run(options)
    folder = options.repo_folder or hub.download(repo_id)
    settings = hub.Settings.read(folder)
    if (settings.algo, settings.env) != (options.algo, options.env.gym_id):
        raise UsageError(f"{folder} holds a model of {settings.algo} for {settings.env} (--algo, --env).")
    model = folder / settings.model_name.filename
    ALGORITHMS[settings.algo].load(model, device="cpu")  # refuses what is damaged or holds pickles
    settings.write_run(run)
    hub.copy_model(model, run / f"{options.env}.zip")
    print(f"Run: {run} (target return {settings.target_return:g}, env_kwargs {settings.env_kwargs})")


def _new_run(options: argparse.Namespace) -> Path:
    """
    :raises UsageError: a run that is there already
    """
    runs = Path(options.folder, options.algo)
    run = runs / f"{options.env}_{options.exp_id or get_latest_run_id(str(runs), options.env) + 1}"
    if run.exists():
        raise UsageError(f"--exp-id {options.exp_id}: {run} exists already; 0 takes the next number.")
    return run


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm pull",
        description="Download a model of dt or dtfm from Hugging Face's hub, as a run.",
        allow_abbrev=False,
    )
    argument = parser.add_argument
    argument("--algo", required=True, help=" or ".join(ALGORITHMS))
    argument("--env", required=True, type=EnvironmentName, help="Gymnasium id")
    argument("-f", "--folder", default="logs", help="folder of runs, logs by default")
    argument("--exp-id", type=int, default=0, metavar="N", help="number of the run to make, the next one by default")
    hub.add_repository_arguments(parser)
    return parser
