"""
DT, DTFM and their baselines, trained and evaluated on the same data and initial states, one core each: `make baselines`.

    make baselines                                                          # everything of studies/baselines.yml
    make baselines ARGUMENTS="--data can-10 --algo dt dtfm bc --seeds 0"    # some of it
    python studies/summary.py mine                                      # the rows as a table

A run that is finished in the results folder is not started again; a kill loses at most the running one (ours continues from
its checkpoint). Two calls of the command, one for each core, share the runs between them.
"""

import argparse
import contextlib
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from tqdm import tqdm

from baselines.entries import (
    HERE,
    KINDS,
    WORKERS,
    Baseline,
    Data,
    baseline_key,
    budget_of,
    check_same,
    read_entries,
    row_settings,
    run_baseline,
)
from baselines.process import STUDIES, BaselineError
from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.provenance import read_data
from sb3_dtfm.benchmark.rows import write_row
from sb3_dtfm.cli import benchmark
from sb3_dtfm.data import DatasetError
from sb3_dtfm.files import replacing
from sb3_dtfm.zoo.arguments import UsageError, import_packages, key_values

FOLDERS = {"d3rlpy": ".venv-baselines", "robomimic": ".venv-robomimic"}  # the environments of the Makefile


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """
    :raises UsageError: a number out of range
    """
    parser = argparse.ArgumentParser("baselines", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--data", nargs="+", metavar="NAME", help="datasets of --datasets; all by default, but those of tasks not installed")
    add("--algo", dest="algos", nargs="+", metavar="NAME", help="dt, dtfm, and baselines of --settings; all by default")
    add("--seeds", type=int, nargs="+", default=[0, 1, 2], metavar="SEED", help="0 1 2 by default")
    add("--minutes", type=float, metavar="N", help="of a baseline's training on one core; the dataset's by default")
    add("--steps", type=int, metavar="N", help="gradient steps, instead of a baseline's minutes or our settings'")
    add("--label", default="", help="added to the dataset's name in the rows, for what was changed")
    several: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
    add(
        "-params",
        "--hyperparams",
        **several,
        metavar="KEY:VALUE",
        help="settings to change, of baselines or ours; needs --label",
    )
    add("--final-episodes", type=int, default=100, metavar="N", help="100 by default")
    add("--n-eval-envs", type=int, default=10, metavar="N", help="environments side by side; 10 by default")
    add("-o", "--results", default="mine", metavar="DIR", help="where rows go; mine by default")
    add("-f", "--log-folder", default="logs/baselines", metavar="DIR", help="models and logs; logs/baselines by default")
    add("--datasets", type=Path, default=STUDIES / "baselines.yml", metavar="FILE", help="what the datasets are")
    add("--settings", type=Path, default=HERE / "settings.yml", metavar="FILE", help="the baselines' settings")
    for worker, folder in FOLDERS.items():
        add(f"--{worker}-python", default=f"{folder}/bin/python", metavar="PYTHON", help=f"of an environment with {worker}")
    options = parser.parse_args(argv)
    for name in ("minutes", "steps", "final_episodes", "n_eval_envs"):
        value = getattr(options, name)
        if value is not None and value <= 0:
            raise UsageError(f"--{name.replace('_', '-')}: must be more than 0, got {value}.")
    if options.hyperparams and not options.label:
        raise UsageError("-params: needs --label, or the rows would pass for the authors' settings.")
    options.hyperparams = key_values("-params", options.hyperparams)
    if min(options.seeds) < 0:
        raise UsageError(f"--seeds: must be 0 or more, got {min(options.seeds)}.")
    return options


def choose(names: Sequence[str] | None, known: Sequence[str], option: str) -> list[str]:
    """
    :param names: the user's, None for all
    :raises UsageError: one is not known
    """
    if unknown := [name for name in names or () if name not in known]:
        raise UsageError(f"{option}: unknown {', '.join(unknown)}; known are {', '.join(known)}.")
    return list(known if names is None else dict.fromkeys(names))


def ready(data: Data, named: bool) -> bool:
    """
    Return whether the task is installed and the data can be read.

    :param named: the user named it; otherwise it is left out, with a message, if its task's package is missing
    :raises UsageError: a package is missing, or the dataset
    """
    if data.kind not in KINDS:
        raise UsageError(f"{data.name}: kind is {data.kind!r}; accepted are {', '.join(KINDS)}.")
    try:
        import_packages(data.gym_packages)
    except UsageError as error:
        if named:
            raise
        print(f"{data.name}: left out. {error}")
        return False
    try:
        read_data(data.task, data.settings())
    except DatasetError as error:
        raise UsageError(
            f"{data.name}: {error} studies/baselines.yml says how to record it; --data chooses others."
        ) from error
    return True


def check_workers(baselines: Sequence[Baseline], options: argparse.Namespace) -> None:
    """
    :raises UsageError: a worker's environment is missing
    """
    for worker in sorted({baseline.worker for baseline in baselines}):
        if worker not in WORKERS:
            raise UsageError(f"{options.settings}: worker is {worker!r}; accepted are {', '.join(WORKERS)}.")
        python = Path(getattr(options, f"{worker}_python"))
        if not python.exists():
            raise UsageError(
                f"--{worker}-python: {python} does not exist; `make baselines` installs it, or --algo leaves it out."
            )


def run_ours(data: Data, algos: Sequence[str], seed: int, options: argparse.Namespace) -> int:
    """
    Run DT and DTFM as `sb3-dtfm benchmark` does.

    :return: how many of the runs are not finished: 0, or 1 for any number
    """
    label = "-".join(filter(None, (data.name, options.label)))
    asked = {"dataset": data.dataset, "target_return": data.target_return, "recorded_from": data.recorded_from}
    with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
        yaml.safe_dump({data.task: {name: value for name, value in asked.items() if value is not None}}, file)
        file.flush()
        command = ["--datasets", file.name, "--algo", *algos, "--fractions", str(data.fraction), "--seeds", str(seed)]
        command += ["--profile", data.profile, "--label", label, "--device", "cpu", "-o", options.results]
        command += ["-f", options.log_folder, "--final-episodes", str(options.final_episodes), "--eval-episodes", "10"]
        n_steps = str(options.steps or data.our_steps)
        command += ["--n-eval-envs", str(options.n_eval_envs), "-n", n_steps, "--eval-freq", n_steps]
        command += ["--gym-packages", *data.gym_packages] if data.gym_packages else []
        params = {**data.params, **options.hyperparams}
        command += ["-params", *(f"{key}:{value!r}" for key, value in params.items())] if params else []
        try:
            benchmark.main(command)
        except SystemExit as end:
            if end.code != 1:
                raise
            return 1
    return 0


def train_and_evaluate(data: Data, baseline: Baseline, seed: int, options: argparse.Namespace) -> int:
    """
    Train and evaluate a baseline, unless it is finished or another call of the command is at it.

    :return: 1 if it is not finished
    """
    key = baseline_key(data, baseline, seed, options.label)
    results, logs = Path(options.results), Path(options.log_folder)
    (results / ".locks").mkdir(parents=True, exist_ok=True)
    logs.mkdir(parents=True, exist_ok=True)
    rows, log = results / f"{key.file_name}.jsonl", logs / f"{key.file_name}.log"
    try:
        with FileLock(results / ".locks" / f"{key.file_name}.lock").acquire(timeout=0):
            if rows.exists():
                check_same(rows, row_settings(data, baseline, budget_of(data, baseline, options)))
                print(f"{key}: finished already", flush=True)
                return 0
            start = time.monotonic()
            with tqdm(desc=str(key), leave=False, mininterval=0.5 if sys.stderr.isatty() else 60.0) as bar:

                def say(done: int, n_steps: int, what: str) -> None:
                    bar.total = n_steps
                    bar.set_postfix_str(what, refresh=False)
                    bar.update(done - bar.n)

                row = run_baseline(data, baseline, seed, options, log, say)
            with replacing(rows) as beside:
                write_row(beside, row)
    except Timeout:
        print(f"{key}: another process is running it", flush=True)
        return 1
    except BaselineError as error:
        print(f"{key}: FAILED. {error}", flush=True)
        return 1
    minutes = row["wall_s"] / 60
    print(
        f"{key}: {row['step']:,} gradient steps in {minutes:.1f} minutes, done in {(time.monotonic() - start) / 60:.1f}",
        flush=True,
    )
    return 0


def main(argv: Sequence[str]) -> None:
    """
    Check everything that is asked for, and run what is missing of it.

    :raises SystemExit: with code 1 if a run is not finished, 130 if interrupted
    :raises UsageError: something does not fit; nothing was run
    """
    options = parse_arguments(argv)
    known_data, known_baseline = read_entries(options.datasets, Data), read_entries(options.settings, Baseline)
    algos = choose(options.algos, [*ALGORITHMS, *known_baseline], "--algo")
    ours, baselines = (
        [name for name in algos if name in ALGORITHMS],
        [known_baseline[name].changed(options.hyperparams) for name in algos if name in known_baseline],
    )
    check_workers(baselines, options)
    names = choose(options.data, list(known_data), "--data")
    chosen = [known_data[name] for name in names if ready(known_data[name], named=options.data is not None)]
    n_left = 0
    for seed in dict.fromkeys(options.seeds):  # outermost: a run that is cut short has seen all data
        for data in chosen:
            n_left += run_ours(data, ours, seed, options) if ours else 0
            n_left += sum(
                train_and_evaluate(data, baseline, seed, options) for baseline in baselines if data.kind in baseline.only
            )
    if n_left:
        print("Some runs failed, or are left to other processes; run the same command to continue.")
        raise SystemExit(1)
    print(f"All runs are finished: python studies/summary.py {options.results}")


def run() -> None:
    """
    The command.

    :raises SystemExit: as :func:`main`, and with a message for a mistake of the user's
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        main(sys.argv[1:])
    except KeyboardInterrupt:
        with contextlib.suppress(BrokenPipeError):
            print("Interrupted; run the same command to continue.", flush=True)
        raise SystemExit(130) from None
    except UsageError as error:
        raise SystemExit(f"baselines: {error}") from None
