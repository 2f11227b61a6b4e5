"""README quotes the committed results as the report computes them."""

import csv
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
from baselines import table

from sb3_dtfm.benchmark import grid
from sb3_dtfm.benchmark.grid import read_tasks
from sb3_dtfm.benchmark.report.runs import read_studies
from sb3_dtfm.benchmark.report.statistics import student_t
from sb3_dtfm.benchmark.report.tables import make_report
from sb3_dtfm.cli.benchmark import parse_arguments

ROOT = Path(__file__).parents[2]
# README's name of a data set of the suite, and the report's.
IN_README = {
    "Hopper, one agent *": "hopper*",
    "HalfCheetah, five agents *": "halfcheetah-mixed-quality*",
    "Walker2d, three noisy agents *": "walker2d-mediocre-noisy*",
    "Swimmer, one agent": "swimmer",
    "Robosuite Stack, 50 scripted demonstrations": "stack-50",
    "Robosuite Can, half of 100 dropped *": "can-dropped*",
    "Adroit door, human demonstrations *": "door-human*",
}
# README's names of algorithms that learn from the same data.
BASELINES = {
    "bc": "BC",
    "bc-best": "BC of the best tenth",
    "d3rlpy-dt": "d3rlpy's DT",
    "iql": "IQL",
    "td3-bc": "TD3+BC",
    "rebrac": "ReBRAC",
    "bc-rnn-gmm": "BC-RNN-GMM",
}


def test_the_suite_of_data_sets_is_what_the_benchmark_reads(monkeypatch):
    monkeypatch.setattr(grid, "import_packages", lambda *_: None)  # which not everybody has
    monkeypatch.setattr(grid.gym, "spec", lambda _: None)
    tasks = read_tasks(parse_arguments(["--datasets", str(ROOT / "studies" / "suite.yml")]))
    assert len(tasks) > 30
    assert all(task.task and task.dataset for task in tasks)
    assert 0 < sum(task.chosen_with for task in tasks) < len(tasks) / 2


def number(cell: str) -> float:
    """Mean in a cell of a table."""
    return float(cell.split()[0].replace(",", ""))


def others(data_set: str) -> dict[str, str]:
    """Results of the other libraries, by algorithm."""
    grouped, _, _ = table.compared(ROOT / "results" / "baselines.csv", ROOT / "results" / "suite.csv")
    found = {algo: table.result(runs) for (name, algo), runs in grouped.items() if name == data_set and algo in BASELINES}
    return {algo: re.sub(r"^(\S+) %(.*)$", r"\1\2 %", cell) for algo, cell in found.items()}


def test_readme_says_what_the_rows_say_and_names_the_best_baseline():
    studies = read_studies([ROOT / "results" / "suite.csv"])
    report, readme = make_report(studies, defaultdict(dict)), (ROOT / "README.md").read_text().splitlines()
    for name, data_set in IN_README.items():
        (line,) = (each for each in report.splitlines() if each.startswith(f"| {data_set} | ") and ";" in each)
        _, recorded, bc, bc_best, dt, dtfm, _ = line.strip("| ").split(" | ")
        cells = [("bc", bc), ("bc-best", bc_best), *others(data_set.rstrip("*")).items()]
        best, result = max(cells, key=lambda cell: number(cell[1]))
        assert f"| {name} | {recorded} | {BASELINES[best]} {result} | {dt} | {dtfm} |" in readme


def test_readme_says_what_the_rows_of_ogbench_say():
    solved: dict[tuple[str, str, int], list[float]] = defaultdict(list)
    for study in read_studies([ROOT / "results" / "ogbench.csv"]):
        for group in study.groups:
            for (task, _, algo), runs in group.runs.items():
                for run in runs:
                    solved[task.partition("-singletask")[0], algo, run.key.seed].append(run.value("final"))
    assert {len(tasks) for (_, algo, _), tasks in solved.items() if algo in ("dt", "dtfm")} == {5, 8}  # scene: two lengths
    by_seed = [float(np.mean(tasks)) for (data, algo, _), tasks in solved.items() if (data, algo) == ("cube-single", "dtfm")]
    (plain,) = (float(np.mean(tasks)) for (_, algo, _), tasks in solved.items() if algo == "dt")
    with open(ROOT / "results" / "ogbench.csv", newline="") as file:
        short = [row for row in csv.DictReader(file) if row["final"] == "true" and row["label"].endswith(" 12000")]
    assert [row["label"] for row in short] == [f"scene-task{number} 12000" for number in range(1, 6)]
    scene = 100 * sum(int(row["successes"]) for row in short) / sum(int(row["episodes"]) for row in short)
    found = student_t(by_seed)
    ours = (
        f"{plain:.0f} % (one seed); - | {found.estimate:.0f} [{found.low:.0f}, {found.high:.0f}]; {scene:.0f} % (one seed)"
    )
    readme, page = (ROOT / "README.md").read_text(), (ROOT / "docs" / "studies" / "ogbench.md").read_text()
    cube, harder = (
        page.split(f"| {names} |")[1].split("\n")[0].strip("| ").split(";")[0]
        for names in ("FQL; IDQL; IFQL", "`scene`, FQL; IDQL; ReBRAC")
    )
    assert f"| FQL, as published, {cube}; {harder} % | {ours}, with a critic |\n" in readme
