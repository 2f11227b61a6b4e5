"""The report on small committed rows, whose numbers can be worked out by hand."""

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from sb3_dtfm.benchmark.report.figures import X_AXES, plot_group
from sb3_dtfm.benchmark.report.runs import (
    OVER_EPISODES,
    OVER_SEEDS,
    Run,
    final_interval,
    group_runs,
    learning_curve,
    paired_scores,
    read_studies,
    spread,
    steps_to_success,
)
from sb3_dtfm.benchmark.results import summarize
from sb3_dtfm.benchmark.rows import Row, RunKey, write_row
from sb3_dtfm.cli.main import main
from tests.benchmark.conftest import make_row

ROWS = Path(__file__).parent / "rows"
LIFT, CHEETAH = "robosuite/Lift-v0", "HalfCheetah-v5"


@pytest.fixture(scope="module")
def groups():
    (study,) = read_studies([ROWS], [LIFT])
    return {group.title: group for group in study.groups}


def table_row(text: str, *start: str) -> list[list[str]]:
    """Cells of all table lines that begin like this."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return [line[len(start) :] for line in lines if line[: len(start)] == list(start)]


def test_labels_are_told_apart_and_unfinished_runs_left_out():
    (study,) = read_studies([ROWS])
    assert [group.title for group in study.groups] == ["small", "small, ema"]
    assert study.unfinished == [RunKey(CHEETAH, 1.0, "dt", 0, "small")]


def test_late_best_and_final_are_those_of_each_run(groups):
    runs = groups["small"].of(LIFT, 1.0, "dt")
    # With four episodes each, 0 1 2 3 2 2 and 0 2 2 2 4 2 succeed, then 3 at the end.
    assert [run.value("late") for run in runs] == [50.0, 60.0]
    assert [run.value("best") for run in runs] == [75.0, 100.0]
    assert [run.value("final") for run in runs] == [75.0, 75.0]
    assert spread(runs, "late") == pytest.approx((55.0, math.sqrt(50)))
    assert groups["small, ema"].of(CHEETAH, 0.5, "dtfm")[0].value("late") is None


def test_an_evaluation_before_training_is_drawn_and_counts_for_no_measure(groups):
    run = groups["small"].of(LIFT, 1.0, "dt")[0]
    untrained = {**run.evaluations[-1], "step": 0, "successes": 4, "mean_return": 1.0}
    for rows in (run.evaluations, run.evaluations[-2:], []):
        before = run._replace(evaluations=rows)
        (group,), _ = group_runs([untrained, *rows, run.final])
        (found,) = group.of(LIFT, 1.0, "dt")
        assert found.evaluations == [untrained, *rows]
        for measure in ("late", "best", "final"):
            assert found.value(measure) == before.value(measure)
        assert learning_curve([found]).mean.tolist() == [100.0, *learning_curve([before]).mean.tolist()]


def test_the_curve_is_the_mean_over_seeds_with_a_pooled_band(groups):
    curve = learning_curve(groups["small"].of(LIFT, 1.0, "dt"))
    assert curve.steps.tolist() == [10, 20, 30, 40, 50, 60]
    assert curve.minutes == pytest.approx(np.arange(1, 7) / 3)
    assert curve.mean.tolist() == [0.0, 37.5, 50.0, 62.5, 75.0, 50.0]
    assert (curve.low <= curve.mean).all()
    assert (curve.high >= curve.mean).all()
    # Half of 8 succeed: Wilson's interval of 4 in 8
    assert (curve.low[2], curve.high[2]) == pytest.approx((21.52, 78.48), abs=0.01)


def with_returns(run, *returns: list[float]):
    """The run with these returns at its evaluations, of a task without success."""
    results = [
        summarize(
            make_row(
                step=result["step"],
                wall_s=result["wall_s"],
                final=False,
                returns=values,
                lengths=[1] * len(values),
                successes=None,
            )
        )
        for result, values in zip(run.evaluations, returns, strict=False)
    ]
    return run._replace(evaluations=results, final={**run.final, "successes": None})


def test_the_band_of_returns_is_over_the_episodes_of_one_seed_and_the_range_of_several(groups):
    run = groups["small"].of(LIFT, 1.0, "dt")[0]
    first, second = with_returns(run, [1.0, 2.0, 3.0], [5.0, 7.0]), with_returns(run, [4.0, 4.0], [1.0, 2.0])
    alone = learning_curve([first])
    assert (alone.mean.tolist(), alone.band) == ([2.0, 6.0], OVER_EPISODES)
    assert alone.high[0] == pytest.approx(2.0 + 4.302653 / math.sqrt(3))
    both = learning_curve([first, second])
    assert (both.mean.tolist(), both.low.tolist(), both.high.tolist()) == ([3.0, 3.75], [2.0, 1.5], [4.0, 6.0])
    assert both.band == OVER_SEEDS


def test_all_that_is_drawn_lies_inside_the_axes_and_the_legend_names_the_bands(groups, tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    figures = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kwargs: figures.append(self) or save(self, *args, **kwargs))
    group = groups["small"]
    runs = {key: [with_returns(run, *([i, 3.0, 900.0] for i in range(6))) for run in of] for key, of in group.runs.items()}
    for each, x in product((group, group._replace(runs=runs)), X_AXES):
        plot_group(each, tmp_path / "curves.png", x)
        (figure,) = figures
        figures.clear()
        for axis in figure.axes:
            for band in axis.collections:
                for path in band.get_paths():
                    for (left, right), values in zip((axis.get_xlim(), axis.get_ylim()), path.vertices.T, strict=True):
                        assert left <= values.min()
                        assert values.max() <= right
        (legend,) = figure.legends
        named = {text.get_text() for text in legend.get_texts()}
        assert {"DT", "DTFM", OVER_EPISODES} <= named
        assert (OVER_SEEDS in named) == (each is not group)
        figure.canvas.draw()
        assert figure.bbox.x0 <= legend.get_window_extent().x0
        assert legend.get_window_extent().x1 <= figure.bbox.x1


def test_curves_by_minutes_have_each_seeds_own_clock_and_a_line_at_the_threshold(groups, tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kwargs: figures.append(self))
    run = groups["small"].of(LIFT, 1.0, "dt")[0]
    slow = run._replace(evaluations=[{**row, "wall_s": 3 * row["wall_s"]} for row in run.evaluations[1:]])
    recorded = {**run.final["data"], "mean_return": 200.0}
    returns = [with_returns(each, [3.0], [5.0]) for each in (run, slow)]
    returns = [each._replace(final={**each.final, "data": recorded}) for each in returns]
    for runs, level in (([run, slow], 95.0), (returns, 190.0)):
        plot_group(groups["small"]._replace(tasks=[LIFT], runs={(LIFT, 1.0, "dt"): runs}), tmp_path / "a.png", "minutes")
        curve, line = figures.pop().axes[0].lines
        # 20 s of the one and 60 s of the other for each ten steps, from the 20th step on
        assert curve.get_xdata() == pytest.approx(np.arange(2, 2 + len(curve.get_xdata())) * 40 / 60)
        assert line.get_ydata() == [level, level]


def test_minutes_to_the_threshold_are_those_of_the_first_evaluation_there(groups):
    run = groups["small"].of(LIFT, 1.0, "dt")[0]
    assert run.minutes_to_threshold == math.inf
    assert (
        run._replace(final={**run.final, "successes": run.final["n_episodes"], "wall_s": 90.0}).minutes_to_threshold == 1.5
    )
    # 1 of return was recorded: the mean is below 0.95, at it, above, below
    returns = with_returns(run, [1.0, 0.8], [1.0, 0.9], [2.0, 2.0], [0.0, 0.0])
    assert returns.minutes_to_threshold == pytest.approx(40 / 60)
    for recorded in ({}, {"mean_return": None}, {"mean_return": -3.0}):
        assert returns._replace(final={**returns.final, "data": recorded}).minutes_to_threshold is None


def test_the_interval_of_success_is_the_wider_one_of_seeds_and_episodes():
    def run(seed: int, n_successes: int) -> Run:
        successes = [i < n_successes for i in range(10)]
        row = make_row(seed=seed, returns=[0.0] * 10, lengths=[1] * 10, successes=successes)
        return Run(RunKey.of(row), [], summarize(row))

    apart, alike = ([run(seed, n) for seed, n in enumerate(each)] for each in ((2, 9), (5, 5)))
    assert final_interval(apart) == pytest.approx((55.0, 0.0, 100.0))  # Student's t: 55 +- 445
    wilsons = (50.0, 29.93, 70.07)  # of 10 in 20
    assert final_interval(alike) == pytest.approx(wilsons, abs=0.01)


def test_steps_to_success_are_those_of_all_seeds_and_failures_take_for_ever(groups):
    run = groups["small"].of(LIFT, 1.0, "dt")[0]
    other = run._replace(final={**run.final, "steps_to_success": [30, 50], "n_episodes": 2})
    assert steps_to_success([run, other]).tolist() == [30, 40, 40, 40, 50, math.inf]


def test_scores_are_shares_of_the_recorded_return(groups):
    keys, dt, dtfm = paired_scores(groups["small"], "dt", "dtfm", "final")
    assert keys == [(LIFT, 1.0), (CHEETAH, 0.5)]
    assert [scores.tolist() for scores in dt] == [[0.75, 0.75], [0.5]]
    assert [scores.tolist() for scores in dtfm] == [[1.0, 1.0, 1.0], [0.8]]


def test_the_report_shows_what_was_run_and_what_was_not(tmp_path, capsys):
    assert main(["report", str(ROWS), "-o", str(tmp_path), "--tasks", LIFT, "Ant-v5"]) == 0
    text = (tmp_path / "report.md").read_text()
    achieved, interval, steps, time = table_row(text, LIFT, "100%")
    assert achieved == ["55.0 ± 7.1", "88.3 ± 10.4", "87.5 ± 17.7", "100.0 ± 0.0", "75.0 ± 0.0", "100.0 ± 0.0", "2 / 3"]
    # Late averages 50 and 60 with t of one degree of freedom: 55 +- 12.706 * 7.07 / 2**0.5;
    # 80, 85 and 100 with two: 88.3 +- 4.303 * 10.41 / 3**0.5
    assert interval[:2] == ["55.0 [0.0, 100.0]", "88.3 [62.5, 100.0]"]
    assert interval[2:] == ["75.0 [40.9, 92.9] % of 8 episodes", "100.0 [75.8, 100.0] % of 12 episodes"]
    assert steps == ["40", "40"]
    # DT reaches it after 100 s with one seed, DTFM after 80, 40 and 120 s
    assert time == ["2.0", "2.0", "12.5", "12.5", "1.67 (1 of 2 seeds)", "1.33"]
    assert table_row(text, LIFT, "50%")[0] == ["*not run*"] * 6 + ["0 / 0"]
    assert len(table_row(text, "Ant-v5", "100%")) == 4
    achieved, interval, scores, time = table_row(text, CHEETAH, "50%")
    assert achieved[:2] == ["3,800", "6,050"]
    assert interval[0] == "3,800 (one seed, no interval)"
    assert interval[2:] == ["5,000 (one seed, no interval)", "8,000 (one seed, no interval)"]
    assert time[-2:] == ["not reached", "not reached"]
    assert scores == ["0.38", "0.60", "0.50", "0.80", "10,000 (TQC: sampled actions)"]
    # DTFM wins all 6 pairs on Lift, and the one on HalfCheetah, which has one run of each
    single = "(no interval: 1 combination has a single run)"
    assert table_row(text, "final evaluation")[0] == [f"0.67 {single}", f"1.00 {single}", f"1.00 {single}"]
    assert "2 combinations of task and share of the data, 2 tasks, 7 runs" in text
    assert "Left out, as they have no final evaluation: HalfCheetah-v5, 100% of the data, dt, seed 0, small." in text
    assert "`local/halfcheetah/expert-v0`, 100 episodes, recorded from TQC: sampled actions" in text
    for figure in ("curves-small.png", "minutes-small.png", "solved-small.png"):
        assert f"]({figure})" in text
        assert (tmp_path / figure).read_bytes().startswith(b"\x89PNG")


def test_nothing_is_said_of_scores_and_minutes_where_the_recorded_return_is_not_known(tmp_path):
    rows = (ROWS / "halfcheetah.jsonl").read_text()
    (tmp_path / "rows.jsonl").write_text(rows.replace(', "mean_return": 10000.0', ""))
    assert (tmp_path / "rows.jsonl").read_text() != rows
    assert main(["report", str(tmp_path / "rows.jsonl"), "-o", str(tmp_path)]) == 0
    _, _, scores, time = table_row((tmp_path / "report.md").read_text(), CHEETAH, "50%")
    assert scores == ["-"] * 5
    assert time[-2:] == ["-", "-"]


def test_a_label_stands_beside_the_same_run_without_it(tmp_path):
    assert main(["report", str(ROWS), "-o", str(tmp_path)]) == 0
    settings = (
        "`ema_decay: 0.99` (not 0.999), `kv_cache: True`, `target_return: 9000.0` (not 12000.0), no `warmup_steps` (not 5)"
    )
    (row,) = table_row((tmp_path / "report.md").read_text(), "ema")
    results, minutes = ["-", "6,050", "9,000", "8,000"], ["2.0", "2.0", "not reached", "not reached"]
    assert row == [settings, CHEETAH, "50%", "DTFM", *results, *minutes, "0123456", "0123456", "1"]
    assert not (tmp_path / "curves-small-ema.png").exists()


def test_a_label_of_another_commit_says_so_in_its_table(tmp_path):
    rows = [line for line in (ROWS / "halfcheetah.jsonl").read_text().splitlines() if '"label": "ema"' in line]
    again = [row.replace("0123456789abcdef", "fedcba9876543210-dirty").replace('"seed": 0', '"seed": 1') for row in rows]
    (tmp_path / "again.jsonl").write_text("\n".join(again) + "\n")
    assert main(["report", str(ROWS), str(tmp_path / "again.jsonl"), "-o", str(tmp_path)]) == 0
    (row,) = table_row((tmp_path / "report.md").read_text(), "ema")
    assert row[-3:] == ["0123456, fedcba9-dirty", "0123456", "2; 1 without"]


def test_a_folder_for_each_study_makes_a_part_for_each(tmp_path):
    lines = (ROWS / "halfcheetah.jsonl").read_text().splitlines()
    for study, labelled in (("ema", True), ("main", False)):
        (tmp_path / study).mkdir()
        (tmp_path / study / "rows.jsonl").write_text(
            "\n".join(row for row in lines if ('"label": "ema"' in row) == labelled)
        )
    assert main(["report", str(tmp_path), "-o", str(tmp_path / "docs")]) == 0
    text = (tmp_path / "docs" / "report.md").read_text()
    headings = [line for line in text.splitlines() if line.startswith("##")]
    assert headings == ["## Study: main", "### Settings: small", "## Study: ema", "### Changes to: small"]
    assert "](curves-small-main.png)" in text
    (row,) = table_row(text, "ema")
    assert row[4:8] == ["-", "6,050", "9,000", "8,000"], "beside the runs of another study"
    # Two folders that are named are put together
    assert main(["report", str(tmp_path / "ema"), str(tmp_path / "main"), "-o", str(tmp_path / "docs")]) == 0
    text = (tmp_path / "docs" / "report.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("##")] == ["## Settings: small", "## Changes to: small"]


def test_a_third_algorithm_has_its_columns_and_its_comparison(tmp_path):
    rows = (ROWS / "lift.jsonl").read_text()
    third = "\n".join(
        row.replace('"algo": "dtfm"', '"algo": "mean"') for row in rows.splitlines() if '"algo": "dtfm"' in row
    )
    (tmp_path / "rows.jsonl").write_text(f"{rows}{third}\n")
    assert main(["report", str(tmp_path / "rows.jsonl"), "-o", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert table_row(text, LIFT, "100%")[0][-1] == "2 / 3 / 3"
    assert "P(DTFM > DT)" in text
    assert "P(MEAN > DT)" in text


def cloned(task: str, algo: str, seed: int, value: float, **changes) -> Row:
    """A final evaluation: a return of `value`, which random actions and recordings surround, or successes."""
    data = {"mean_return": -100.0, "best_return": 100.0, "random_return": -300.0, "success_rate": None, **changes}
    successes = [i < value for i in range(4)] if task == "lift-10" else None
    ended = dict(returns=[value] * 4, lengths=[9] * 4, successes=successes)
    return make_row(task=task, env_id="Gym-v0", algo=algo, seed=seed, profile="default", data=data, **ended)


SUCCESSES = {"success_rate": 0.25, "best_success": 0.5}
SUITE = [
    *(cloned("hopper", algo, seed, 20.0 * i + 100.0 * seed) for i, algo in enumerate(("bc", "dtfm")) for seed in (0, 1)),
    cloned("hopper", "bc-best", 0, 100.0),
    *(cloned("lift-10", algo, 0, n, chosen_with=True, **SUCCESSES) for algo, n in (("bc", 1), ("dtfm", 2))),
]


def write_suite(folder: Path, rows: Sequence[Row]) -> None:
    for row in rows:
        write_row(folder / "rows.jsonl", row)


def test_a_score_goes_from_random_actions_to_the_best_tenth_of_what_was_recorded():
    (group,), _ = group_runs(map(summarize, SUITE))
    scores = {(run.key.task, run.key.algo, run.key.seed): run.score("final") for of in group.runs.values() for run in of}
    # From -300 to 100; of four episodes one and two succeed, and half of the best tenth did
    assert scores == {
        ("hopper", "bc", 0): 0.75,
        ("hopper", "bc", 1): 1.0,
        ("hopper", "dtfm", 0): 0.8,
        ("hopper", "dtfm", 1): 1.05,
        ("hopper", "bc-best", 0): 1.0,
        ("lift-10", "bc", 0): 0.5,
        ("lift-10", "dtfm", 0): 1.0,
    }
    (worse,) = group_runs([summarize(cloned("hopper", "bc", 0, 5.0, random_return=200.0))])[0][0].of("hopper", 1.0, "bc")
    assert worse.score("final") is None, "random actions are no worse than the recordings"


def test_behaviour_cloning_beside_it_is_shown_in_one_table_and_one_figure(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    figures = {}
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, to, **kwargs: figures.update({to.name: self}) or save(self, to, **kwargs)
    )
    write_suite(tmp_path, SUITE)
    assert main(["report", str(tmp_path), "-o", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert "| data set | recorded; best tenth | BC | BC of the best tenth | DT | DTFM | seeds |" in text
    # Student's t of two seeds that are 100 apart: 12.706 * 50
    hopper, lift = table_row(text, "hopper")[0], table_row(text, "lift-10*")[0]
    assert hopper == ["-100; 100", "50.00 [-585, 685]", "100", "*not run*", "70.00 [-565, 705]", "2; 1; 0; 2"]
    assert lift == ["25 %; 50 %", "25 [5, 70] %", "*not run*", "*not run*", "50 [15, 85] %", "1; 0; 0; 1"]
    assert "0 is the mean return of random actions, 1 is the mean return of the best tenth" in text
    assert "](scores-default.png)" in text
    (axis,) = figures["scores-default.png"].axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["hopper", "lift-10*"]
    marks = {(line.get_label(), round(float(np.mean(line.get_xdata())), 3)) for line in axis.lines[1:]}
    assert marks >= {("BC", 0.875), ("DTFM", 0.925), ("BC of the best tenth", 1.0), ("BC", 0.5), ("DTFM", 1.0)}
    (legend,) = figures["scores-default.png"].legends
    assert {text.get_text() for text in legend.get_texts()} > {"BC", "BC of the best tenth", "DTFM"}


def test_of_many_data_sets_no_learning_curves_are_drawn(tmp_path):
    rows = [cloned(f"task-{i}", algo, 0, 5.0) for i in range(20) for algo in ("bc", "dtfm")]
    write_suite(tmp_path, rows)
    assert main(["report", str(tmp_path), "-o", str(tmp_path)]) == 0
    assert [file.name for file in tmp_path.glob("*.png")] == ["scores-default.png"]
    text = (tmp_path / "report.md").read_text()
    assert "| task-0 |" in text
    assert "minutes" in text
    assert not [each for each in ("learning curves", "late average", "best evaluation") if each in text]


def test_a_label_alone_is_a_group_of_its_own(tmp_path):
    rows = [line for line in (ROWS / "halfcheetah.jsonl").read_text().splitlines() if '"label": "ema"' in line]
    (tmp_path / "ema.jsonl").write_text("\n".join(rows) + "\n")
    assert main(["report", str(tmp_path), "-o", str(tmp_path)]) == 0
    assert "## Settings: small, ema" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "curves-small-ema.png").exists()
    assert not (tmp_path / "solved-small-ema.png").exists()


def test_a_label_of_both_algorithms_is_a_comparison_of_its_own(tmp_path):
    rows = (ROWS / "lift.jsonl").read_text()
    few = rows.replace('"label": ""', '"label": "few"').replace('"data_share": 1.0', '"data_share": 0.1')
    assert rows != few
    (tmp_path / "rows.jsonl").write_text(rows + few)
    assert main(["report", str(tmp_path / "rows.jsonl"), "-o", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == [
        "## Settings: small",
        "## Settings: small, few",
    ]
    # Without the paper's full and half data, which are not what it is about
    assert len(table_row(text.split("small, few")[1], LIFT)) == len(table_row(text.split("small, few")[1], LIFT, "10%"))
    assert (tmp_path / "curves-small-few.png").exists()


def test_a_baseline_is_drawn(tmp_path, monkeypatch):
    from matplotlib.axes import Axes

    labels = []
    plot = Axes.plot
    monkeypatch.setattr(
        Axes, "plot", lambda self, *data, **kwargs: labels.append(kwargs["label"]) or plot(self, *data, **kwargs)
    )
    np.savez(tmp_path / "evaluations.npz", timesteps=[500, 1000], results=np.ones((2, 3)))
    baseline = f"{CHEETAH}:SAC={tmp_path / 'evaluations.npz'}"
    assert main(["report", str(ROWS), "-o", str(tmp_path), "--baseline", baseline]) == 0
    assert {"DT", "DTFM", "SAC (1,000 environment steps)"} == set(labels)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere does not exist"),
        (["."], "no finished run"),
        (["bad.jsonl"], "bad.jsonl, line 1: is not JSON"),
        ([str(ROWS), "--baseline", "SAC"], "expected NAME=FILE or TASK:NAME=FILE"),
        ([str(ROWS), "--baseline", "SAC=nowhere.npz"], "nowhere.npz does not exist"),
        ([str(ROWS), "--baseline", "SAC=a.npz"], "of which task? Write TASK:SAC=FILE"),
        ([str(ROWS), "--baseline", "Ant-v5:SAC=a.npz"], f"the results hold {CHEETAH}, {LIFT}"),
        ([str(ROWS), "--baseline", f"{LIFT}:SAC=a.npz"], "holds no successes"),
        ([str(ROWS), "--baseline", "SAC=b.npz"], "expected the arrays timesteps"),
    ],
)
def test_a_mistake_ends_in_one_clear_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", timesteps=[500], results=np.ones((1, 3)))
    np.savez("b.npz", other=[500])
    if "bad.jsonl" in arguments:
        Path("bad.jsonl").write_text("{\n")
    assert main(["report", *arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert message in error[0]
