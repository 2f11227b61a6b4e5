"""
Seconds from the command to 95 % of what the best tenth of the recorded episodes reached, on one core: docs/performance.md.

    PYTHONPATH=studies python studies/seconds.py run mine
    sb3-dtfm report mine --csv results/seconds.csv
    PYTHONPATH=studies python studies/seconds.py table results/seconds.csv --figure docs/seconds.png

Data sets are those of studies/suite.yml. `wall_s` of a row are processor seconds of the learning process since it was
started: imports, reading the data, and all gradient steps; neither environments nor evaluations. d3rlpy's algorithms need
`make .venv-baselines/installed`. A run that is finished is not started again, and two calls share the runs between them.
"""

import time

import numpy as np
import torch as th
from baselines.entries import PROFILE, WORKERS, Baseline, read_entries
from baselines.process import BaselineProcess
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.cloning import Cloning
from sb3_dtfm.benchmark.evaluation import TRAINING_STATES, Episodes, evaluate, make_seeded_envs
from sb3_dtfm.benchmark.grid import Job, plan
from sb3_dtfm.benchmark.results import read_results
from sb3_dtfm.benchmark.rows import BASELINES, Row, write_row
from sb3_dtfm.cli.benchmark import parse_arguments
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.envs import reader_options
from sb3_dtfm.files import replacing

IMPORTED = time.process_time()

import argparse  # noqa: E402 - what takes no time
import contextlib  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
from itertools import product  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import matplotlib.pyplot as plt  # noqa: E402
from filelock import FileLock, Timeout  # noqa: E402

HERE = Path(__file__).parent
DATA = ("hammer", "hopper", "hopper-mixed-quality", "inverted-double-pendulum", "mountain-car", "relocate")
OURS = (*BASELINES, *ALGORITHMS)
NAMES = {
    "bc": "BC",
    "bc-best": "BC of the best tenth",
    "dt": "DT",
    "dtfm": "DTFM",
    "d3rlpy-dt": "d3rlpy's DT",
    "td3-bc": "TD3+BC",
}
ENOUGH = 0.95
# Minutes of the other libraries, whose authors plan for hours; DT, DTFM and BC learn for the defaults' steps.
MINUTES, OUR_STEPS = 5.0, 5_000
N_EPISODES, N_ENVS = 20, 10


def points(n_steps: int) -> list[int]:
    """Gradient steps after which a model is evaluated: each 1.41 times the last, from 200 on, and the last step."""
    found = [round(200 * 2 ** (i / 2)) for i in range(40)]
    return [*(step for step in found if step < n_steps), n_steps]


class Training:
    """
    A training: its environments, and a row for each evaluation.

    :param job: of the grid
    :param algo: what the rows have for an algorithm
    """

    def __init__(self, job: Job, algo: str) -> None:
        self.job, self.algo = job, algo
        self.vec_env = make_seeded_envs(job.task.env_id, job.settings, N_ENVS)
        self.rows: list[Row] = []
        self.enough = enough(job.data)

    def buffer(self) -> TrajectoryBuffer:
        """The episodes, as `train` reads them."""
        settings = self.job.settings
        given = settings.get("dataset_kwargs") or {}
        return load_dataset(settings["dataset"], **{**reader_options(self.vec_env), **given})

    def evaluate(self, model: Any, step: int, seconds: float, **more: Any) -> bool:
        """
        Keep a row.

        :return: whether it has reached what is enough
        """
        episodes = evaluate(model, self.vec_env, range(TRAINING_STATES, TRAINING_STATES + N_EPISODES))
        described: Row = dict(
            commit=provenance.commit(), versions=provenance.versions(), flow_solver=None, flow_steps=None,
            hardware={**provenance.hardware(th.device("cpu")), "threads": 1},
        )  # fmt: skip
        identity = {**self.job.row, "algo": self.algo}
        measured = {"step": step, "final": False, "wall_s": round(seconds, 2), "steps_per_s": round(step / seconds, 2)}
        self.rows.append({**identity, **described, **measured, **episodes._asdict(), **more})
        return reached(episodes) >= self.enough

    def write(self, path: Path) -> None:
        """All rows at once, of which the last is the final one."""
        self.rows[-1]["final"] = True
        with replacing(path) as beside:
            for row in self.rows:
                write_row(beside, row)


def reached(episodes: Episodes) -> float:
    """Success in [0, 1], or mean return."""
    return float(np.mean(episodes.returns if episodes.successes is None else episodes.successes))


def enough(data: dict[str, Any]) -> float:
    """95 % of what the best tenth of the recorded episodes reached."""
    best = data["best_success"]
    return ENOUGH * (data["best_return"] if best is None else best)


class Reached(Exception):  # noqa: N818 - no error
    """Enough was learned."""


class Evaluations(BaseCallback):
    """Evaluates at :func:`points` and stops the clock for it."""

    def __init__(self, training: Training, n_steps: int) -> None:
        super().__init__()
        self.training, self.points = training, set(points(n_steps))
        self.started = time.process_time()

    def _on_step(self) -> bool:
        if self.num_timesteps in self.points:
            paused = time.process_time()
            if self.training.evaluate(self.model, self.num_timesteps, IMPORTED + paused - self.started):
                raise Reached
            self.started += time.process_time() - paused
        return True


def run_here(job: Job) -> Training:
    """DT, DTFM or behaviour cloning, in this process."""
    algo, settings = job.key.algo, dict(job.settings)
    training = Training(job, algo)
    n_steps = settings["n_timesteps"]
    callback = Evaluations(training, n_steps)
    with contextlib.suppress(Reached):
        if algo in BASELINES:
            buffer = training.buffer().best(best_share=settings["best_share"])
            model = Cloning(buffer, settings["hidden_sizes"], settings["learning_rate"], job.key.seed)
            model.learn(n_steps, settings["batch_size"], callback)
        else:
            apart = {"policy", "n_timesteps", "dataset", "dataset_kwargs"}
            own = {key: value for key, value in settings.items() if key not in {*apart, "env_wrapper", "env_kwargs"}}
            learner = ALGORITHMS[algo](
                settings["policy"], training.vec_env, dataset=training.buffer(), seed=job.key.seed, device="cpu", **own
            )
            learner.learn(n_steps, callback=callback, log_interval=None)
    return training


def run_baseline(job: Job, baseline: Baseline, python: Path, log: Path) -> Training:
    """One of d3rlpy's, in a process of its own."""
    training = Training(job, baseline.name)
    settings = {**baseline.settings, **baseline.kinds.get(kind(job), {})}
    with tempfile.TemporaryDirectory() as folder, BaselineProcess(python, WORKERS[baseline.worker], log) as process:
        path = Path(folder) / "episodes.npz"
        training.buffer().save(path)
        process.begin(path, settings, job.key.seed, baseline.n_timesteps, MINUTES)
        more: Row = {"profile": PROFILE, "settings": {**job.settings, "minutes": MINUTES, baseline.worker: settings}}
        done = 0
        for step in points(baseline.n_timesteps):
            seconds = process.learn(step - done)
            done = step
            versions = {f"baseline's {name}": number for name, number in process.versions.items()}
            if training.evaluate(process, step, seconds, versions={**provenance.versions(), **versions}, **more):
                break
            if seconds * 2**0.5 > 60.0 * MINUTES:
                break
    return training


def kind(job: Job) -> str:
    """Kind of data, by which the authors of baselines change their settings."""
    task = job.task.env_id
    return "manipulation" if task.startswith("robosuite") else "hand" if task.startswith("AdroitHand") else "locomotion"


def planned(options: argparse.Namespace, data: str, algo: str, seed: int) -> Job:
    """The grid's job of a run, whatever results there are."""
    arguments = f"--datasets {HERE / 'suite.yml'} --env {data} --algo {algo} --fractions 1 --seeds {seed}".split()
    changes = ["-params", *options.hyperparams] if options.hyperparams else []
    more = ["-n", str(options.steps), "--label", options.label, *changes, "-o", "nowhere"]
    (job,), _ = plan(parse_arguments([*arguments, *more]))
    return job


def run_one(options: argparse.Namespace, data: str, algo: str, seed: int, path: Path) -> None:
    """One run, in this process."""
    job = planned(options, data, algo if algo in OURS else "dt", seed)
    if algo in OURS:
        training = run_here(job)
    else:
        baselines = read_entries(HERE / "baselines" / "settings.yml", Baseline)
        training = run_baseline(job, baselines[algo], options.python, path.with_suffix(".log"))
    training.write(path)
    last = training.rows[-1]
    value = reached(Episodes(last["returns"], [], last["successes"]))
    print(
        f"{path.stem}: {value:,.2f} of {training.enough:,.2f} after {last['wall_s']:.0f} s, {last['step']:,} steps",
        flush=True,
    )


def run(options: argparse.Namespace) -> None:
    """The runs that are not finished, each in a process of its own."""
    locks = options.results / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    for seed, data, algo in product(options.seeds, options.data, options.algo):
        name = "_".join(filter(None, (data, algo, f"seed{seed}", options.label)))
        with contextlib.suppress(Timeout), FileLock(locks / name).acquire(timeout=0):
            path = options.results / f"{name}.jsonl"
            if not path.exists():
                one = ["--data", data, "--algo", algo, "--seeds", str(seed), "--write", str(path)]
                subprocess.run([sys.executable, __file__, *sys.argv[1:], *one], check=True)


def seconds_by_algorithm(results: Path) -> dict[tuple[str, str], list[tuple[float, bool]]]:
    """Return by data and algorithm, for each seed, the seconds, and whether it had reached what is enough by then."""
    found: dict[tuple[str, str], list[tuple[float, bool]]] = {}
    (rows,) = read_results([results]).values()
    for last in sorted((row for row in rows if row["final"]), key=lambda row: row["seed"]):
        value = last["mean_return"] if last["successes"] is None else last["successes"] / last["n_episodes"]
        algo = "@".join(filter(None, (last["algo"], last["label"])))
        found.setdefault((last["task"], algo), []).append((last["wall_s"], value >= enough(last["data"])))
    return found


def table(folder: Path) -> str:
    """Seconds of each seed; in brackets where it ended without enough."""
    seconds_of = seconds_by_algorithm(folder)
    algos = sorted({algo for _, algo in seconds_of}, key=lambda algo: (list(NAMES).index(algo.split("@")[0]), algo))
    lines = ["| data | " + " | ".join(NAMES.get(algo, algo) for algo in algos) + " |", "| --- " * (1 + len(algos)) + "|"]
    for data in dict.fromkeys(data for data, _ in seconds_of):
        texts = [
            ", ".join(
                f"{seconds:.0f}" if enough else f"({seconds:.0f})" for seconds, enough in seconds_of.get((data, algo), [])
            )
            for algo in algos
        ]
        lines.append(f"| {data} | " + " | ".join(text or "-" for text in texts) + " |")
    return "\n".join(lines)


def draw(folder: Path, path: Path) -> None:
    """A mark for each seed; a hollow one ended without enough."""
    seconds_of = seconds_by_algorithm(folder)
    algos = [algo for algo in NAMES if any(algo == each for _, each in seconds_of)]
    names = list(dict.fromkeys(data for data, _ in seconds_of))[::-1]
    figure, axes = plt.subplots(figsize=(8, 0.3 + 0.75 * len(names)), layout="constrained")
    for i, algo in enumerate(algos):
        for y, data in enumerate(names):
            for seconds, enough in seconds_of.get((data, algo), []):
                height = y + 0.7 * (0.5 - (i + 0.5) / len(algos))
                axes.plot(seconds, height, "o", color=f"C{i}", mfc=f"C{i}" if enough else "none", ms=5)
        axes.plot([], [], "o", color=f"C{i}", label=NAMES[algo])
    for y in range(len(names) - 1):
        axes.axhline(y + 0.5, color="0.9", zorder=0)
    axes.set(xscale="log", yticks=range(len(names)), yticklabels=names)
    figure.supxlabel(
        "seconds on one core to 95 % of the best tenth of the recorded episodes; hollow: not reached", fontsize="medium"
    )
    axes.xaxis.set_major_formatter("{x:g}")
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.savefig(path, dpi=120)


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("results", type=Path, help="folder of rows, or for `table` a CSV file")
    parser.add_argument("--data", nargs="+", default=list(DATA), help="of studies/suite.yml")
    parser.add_argument("--algo", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=OUR_STEPS, help="gradient steps of ours and of behaviour cloning")
    parser.add_argument("--label", default="", help="name of what -params and --steps change")
    parser.add_argument("-params", dest="hyperparams", nargs="+", default=[], metavar="KEY:VALUE")
    parser.add_argument("--python", type=Path, default=HERE.parent / ".venv-baselines/bin/python", help="that has d3rlpy")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--figure", type=Path, help="PNG file to draw")
    options = parser.parse_args()
    if options.write:
        run_one(options, *options.data, *options.algo, *options.seeds, options.write)
    elif options.what == "run":
        run(options)
    else:
        print(table(options.results))
        if options.figure:
            draw(options.results, options.figure)


if __name__ == "__main__":
    main()
