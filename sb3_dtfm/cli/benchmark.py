"""`sb3-dtfm benchmark`: algorithms compared on a grid of tasks, shares of the data and seeds."""

import argparse
from collections.abc import Sequence
from typing import Any

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.grid import ALGOS, N_EVALUATIONS, plan
from sb3_dtfm.benchmark.runner import run_grid
from sb3_dtfm.zoo.arguments import UsageError, import_packages, key_values

EXAMPLES = """\
examples:
  sb3-dtfm benchmark --dataset robosuite/Lift-v0=datasets/lift.hdf5 --seeds 0 1 2
  sb3-dtfm benchmark --datasets studies/suite.yml --env hopper cartpole --algo bc bc-best dt dtfm --fractions 1
  sb3-dtfm benchmark --env HalfCheetah-v5 --dataset HalfCheetah-v5=local/halfcheetah/expert-v0 --label ema \\
      -params ema_decay:0.99

The file of --datasets maps a task to its dataset, or to some of these keys:
  task            Gymnasium id, where the entry has a name of its own: several entries may have the same task
  dataset         Minari id, file or folder; the profile's by default
  target_return   in reward units; what `sb3-dtfm inspect` suggests of the dataset by default
  recorded_from   the agent or demonstrator, for the report
  env_kwargs      of the environment
  dataset_kwargs  of the dataset's reader: clip_actions, action_bounds and others
  fraction        share of the dataset's episodes that the entry consists of, in (0, 1]
  gym_packages    modules to import first: they register the task
  algorithms      those of --algo that can learn it; all by default
  chosen_with     true, where a default was chosen with it; the report marks it

  robosuite/Lift-v0: datasets/lift.hdf5
  cheetah: {task: HalfCheetah-v5, dataset: local/halfcheetah/expert-v0, recorded_from: "TQC, sampled actions"}

A run that is finished in the results folder is not started again; one that was interrupted continues from its checkpoint.
"""


def benchmark_parser() -> argparse.ArgumentParser:
    """Arguments of `benchmark`; those that `train` has too mean the same."""
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm benchmark",
        description="Train and evaluate algorithms on a grid of tasks, shares of the data and seeds.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    several: dict[str, Any] = dict(nargs="+", action="extend", default=[])
    grid = parser.add_argument_group("the grid").add_argument
    grid(
        "--env",
        "--tasks",
        dest="tasks",
        nargs="+",
        metavar="TASK",
        help="Gymnasium ids, or names in --datasets; those with a dataset by default",
    )
    grid(
        "--fractions",
        type=float,
        nargs="+",
        default=[1.0, 0.5],
        metavar="SHARE",
        help="shares of the episodes to learn from; 1.0 0.5 by default",
    )
    baselines = f"{' and '.join(ALGORITHMS)} by default; bc clones behaviour, bc-best that of the best tenth of the episodes"
    grid("--algo", dest="algos", nargs="+", choices=ALGOS, default=list(ALGORITHMS), help=baselines)
    grid("--seeds", "--seed", type=int, nargs="+", default=[0], metavar="SEED", help="0 by default")
    grid("--profile", default="default", help="default, paper, a YAML file, or a folder with dt.yml and dtfm.yml")
    grid("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first, which register tasks")
    grid("--label", default="", help="name of what -params change; part of a run's identity")
    data = parser.add_argument_group("data").add_argument
    data("--dataset", **several, metavar="TASK=DATASET", help="Minari id, file or folder")
    data("--datasets", metavar="FILE", help="YAML file with entries for many tasks, see below")
    data("--dataset-cache", metavar="DIR", help="learn from memory-mapped files made in this folder")
    data("--target-return", **several, metavar="[TASK=]RETURN", help="target return, in reward units")
    training = parser.add_argument_group("training and evaluation").add_argument
    training("-n", "--n-timesteps", type=int, metavar="N", help="gradient steps; the profile's by default")
    training("-params", "--hyperparams", **several, metavar="KEY:VALUE", help="settings to change; needs --label")
    training(
        "--eval-freq", type=int, metavar="N", help=f"gradient steps between evaluations; 1/{N_EVALUATIONS} of all by default"
    )
    training("--eval-episodes", type=int, default=20, metavar="N", help="episodes of each evaluation; 20 by default")
    training("--final-episodes", type=int, default=50, metavar="N", help="episodes after the last step; 50 by default")
    training("--n-eval-envs", type=int, default=10, metavar="N", help="environments side by side; 10 by default")
    training("--env-kwargs", **several, metavar="KEY:VALUE", help="arguments of the environment, as in train")
    training("--vec-env", choices=("dummy", "subproc"), default="dummy", help="kind of vectorised environment, as in train")
    training("--device", default="auto", help="device to train on, as in train")
    running = parser.add_argument_group("running").add_argument
    running("--jobs", type=int, default=1, metavar="N", help="runs at once, each with 1/N of the cores; 1 by default")
    running("-o", "--results", default="results", metavar="DIR", help="folder of the rows, results by default")
    running("-f", "--log-folder", default="logs/benchmark", metavar="DIR", help="models and logs; logs/benchmark by default")
    return parser


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """
    The user's arguments, in range; `hyperparams` is a mapping with all that changes the profile's settings.

    :raises UsageError: an argument out of range
    """
    options = benchmark_parser().parse_args(argv)
    for name in ("n_timesteps", "eval_freq", "eval_episodes", "final_episodes", "n_eval_envs", "jobs"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UsageError(f"--{name.replace('_', '-')}: must be at least 1, got {value}.")
    if wrong := [fraction for fraction in options.fractions if not 0.0 < fraction <= 1.0]:
        raise UsageError(f"--fractions: must lie in (0, 1], got {wrong[0]}.")
    if min(options.seeds) < 0:
        raise UsageError(f"--seeds: must be 0 or more, got {min(options.seeds)}.")
    for name in ("algos", "fractions", "seeds"):
        setattr(options, name, list(dict.fromkeys(getattr(options, name))))
    if options.hyperparams and not options.label:
        raise UsageError("-params: needs --label, or the rows would pass for the profile's own.")
    options.hyperparams = key_values("-params", options.hyperparams)
    if options.env_kwargs:
        options.hyperparams["env_kwargs"] = key_values("--env-kwargs", options.env_kwargs)
    if options.dataset_cache is not None:
        dataset_kwargs = options.hyperparams.get("dataset_kwargs", {})
        options.hyperparams["dataset_kwargs"] = {**dataset_kwargs, "cache_dir": options.dataset_cache}
    return options


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm benchmark`.

    :param argv: its arguments
    :raises UsageError: an argument, setting or dataset that does not fit; nothing was run
    :raises SystemExit: with code 1 if a run failed or was left to another process, 130 if interrupted
    """
    options = parse_arguments(argv)
    import_packages(options.gym_packages)
    jobs, done = plan(options)
    run_grid(jobs, len(done), options)
