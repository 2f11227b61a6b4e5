"""
What fine-tuning brought: runs of `sb3-dtfm finetune` as rows, a table and curves.

    python studies/finetuning.py measure logs/dtfm/robosuite-Can-v0_2 --before logs/dtfm/robosuite-Can-v0_1 \\
        --output results/finetuning/can-few_seed0.json
    python studies/finetuning.py report results/finetuning --figure docs/studies/finetuning.png

`measure` plays 100 episodes, from initial states of their own, with the model before and with the last one
after. The curve is from the run's evaluations.npz, minutes and steps from its monitors.
"""

import argparse
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.benchmark.provenance import commit, hardware, versions
from sb3_dtfm.benchmark.report.statistics import student_t
from sb3_dtfm.files import read_run
from sb3_dtfm.finetuning import SteeredDTFM
from sb3_dtfm.recording.loading import load_agent

N_EPISODES, N_ENVS = 100, 10
NAME = re.compile(r"(?P<study>.+)_(?P<kind>[a-z]+)_seed(?P<seed>\d+)")


def measure(run: Path, before: Path) -> dict[str, Any]:
    """
    A row: what a run was, what its model reaches before and after, and the curve between.

    :param run: folder of a run of `finetune`
    :param before: folder of the run that it went on from
    """
    (folder,) = (path.parent for path in run.glob("*/config.yml"))
    settings, env_id = read_run(folder), re.sub(r"^robosuite-", "robosuite/", folder.name)
    envs = make_seeded_envs(env_id, settings, N_ENVS)
    seeds = range(FINAL_STATES, FINAL_STATES + N_EPISODES)
    episodes = {}
    for name, path in {"before": before, "after": run}.items():
        algo = path.parent.name
        file = path / f"{folder.name}.zip"
        model = SteeredDTFM.load(file, device="cpu") if algo == "steered" else load_agent(algo, file, "cpu")
        with tqdm(total=N_EPISODES, desc=name) as bar:
            found = evaluate(model, envs, seeds, lambda n, bar=bar: bar.update(n - bar.n))
        episodes[name] = found._asdict()
    curve = np.load(run / "evaluations.npz")
    scores = curve["successes"] if "successes" in curve else curve["results"]
    return {
        "task": env_id,
        "settings": {key: value for key, value in settings.items() if key != "callback"},
        **episodes,
        "timesteps": curve["timesteps"].tolist(),
        "scores": scores.astype(float).tolist(),
        "own": own_episodes(run),
        "commit": commit(),
        "versions": versions(),
        "hardware": hardware(th.device("cpu")),
    }


def own_episodes(run: Path) -> list[tuple[float, float, int]]:
    """Of the environments that it learned in: minutes since the start, return, length; in the order of their ends."""
    lines = [line for path in sorted(run.glob("*.monitor.csv")) for line in path.read_text().splitlines()[2:]]
    rows = [[float(number) for number in line.split(",")[:3]] for line in lines]
    return sorted((round(seconds / 60, 2), round(value, 3), int(length)) for value, length, seconds in rows)


def report(folder: Path, figure: Path) -> None:
    """Print a table, and draw the curves: each seed thin, their mean thick."""
    groups: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for path in sorted(folder.glob("*_seed*.json")):
        named = NAME.fullmatch(path.stem)
        assert named is not None, path
        groups.setdefault((named["study"], named["kind"]), {})[int(named["seed"])] = json.loads(path.read_text())
    print("| study | what learned | seeds | before, of 100 | after, of 100 | environment steps | minutes | commits |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for (study, kind), rows in groups.items():
        cells = [study, kind, ", ".join(map(str, rows))]
        for name in ("before", "after"):
            values = [score(row[name]) for row in rows.values()]
            cells.append(", ".join(f"{value:,.0f}" for value in values) + interval(values))
        cells.append(f"{np.mean([sum(length for *_, length in row['own']) for row in rows.values()]):,.0f}")
        cells.append(f"{np.mean([row['own'][-1][0] for row in rows.values()]):.0f}")
        print("|", " | ".join([*cells, ", ".join(sorted({row["commit"][:7] for row in rows.values()}))]), "|")
    draw(groups, figure)


def score(episodes: dict[str, Any]) -> float:
    """Successes of a hundred, or the mean return."""
    successes = episodes["successes"]
    return float(np.mean(episodes["returns"]) if successes is None else 100 * np.mean(successes))


def interval(values: list[float]) -> str:
    """Student's t over seeds, where there are some."""
    if len(values) < 3:
        return ""
    found = student_t(values)
    return f" [{found.low:,.0f}, {found.high:,.0f}]"


def draw(groups: dict[tuple[str, str], dict[int, dict[str, Any]]], path: Path) -> None:
    """
    :param groups: rows by seed, by study and what learned
    :param path: of the PNG
    """
    studies = list(dict.fromkeys(study for study, _ in groups))
    figure = Figure(figsize=(5.5 * len(studies), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, study in zip(np.atleast_1d(figure.subplots(1, len(studies))), studies, strict=True):
        kinds = {kind: rows for (name, kind), rows in groups.items() if name == study}
        for number, (kind, rows) in enumerate(kinds.items()):
            for row in rows.values():
                values = (
                    100 * np.mean(row["scores"], axis=1) if row["after"]["successes"] else np.mean(row["scores"], axis=1)
                )
                axes.plot(row["timesteps"], values, color=f"C{number}", alpha=0.4, linewidth=1)
            for name, place in (("before", 0.0), ("after", 1.0)):
                last = max(row["timesteps"][-1] for row in rows.values())
                mean = np.mean([score(row[name]) for row in rows.values()])
                axes.plot(place * last, mean, "o", color=f"C{number}", label=kind if name == "after" else None)
        axes.set(
            title=study, xlabel="environment steps", ylabel="solved, %" if "can" in study or "lift" in study else "return"
        )
        axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure")
    measuring.add_argument("run", type=Path)
    measuring.add_argument("--before", type=Path, required=True)
    measuring.add_argument("--output", type=Path, required=True)
    reporting = commands.add_parser("report")
    reporting.add_argument("folder", type=Path)
    reporting.add_argument("--figure", type=Path, required=True)
    options = parser.parse_args()
    if options.command == "report":
        report(options.folder, options.figure)
    else:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(measure(options.run, options.before)) + "\n")


if __name__ == "__main__":
    main()
