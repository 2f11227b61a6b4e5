"""RL-Zoo's plots: what ours and its own algorithms trained, in one figure."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from sb3_dtfm.cli.main import main
from tests.recorded import DATASET_ID, tiny_training

EVALUATED = ["--env-kwargs", "max_episode_steps:20", "--eval-episodes", "2", "--verbose", "0"]
RUNS = ["-e", "HalfCheetah-v5", "-f", "logs"]


@pytest.fixture(scope="module")
def logs(minari_folder, tmp_path_factory) -> Path:
    """Two runs of dtfm and of sac each, with what they have left in their folders."""
    place = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setenv("MINARI_DATASETS_PATH", str(minari_folder))
        ours = tiny_training("dtfm", "--dataset", DATASET_ID, "--eval-freq", "2", *EVALUATED)
        assert main(ours) == 0
        sac = ["train", "--algo", "sac", "--env", "HalfCheetah-v5", "-n", "60", "--eval-freq", "30", *EVALUATED]
        assert main([*sac, "-params", "learning_starts:100"]) == 0
    for algo in ("dtfm", "sac"):
        shutil.copytree(place / "logs" / algo / "HalfCheetah-v5_1", place / "logs" / algo / "HalfCheetah-v5_2")
    return place


@pytest.fixture(autouse=True)
def beside_the_runs(logs, monkeypatch) -> None:
    monkeypatch.chdir(logs)


def curves(figure: Figure) -> dict[str, tuple[list[float], list[float]]]:
    return {str(line.get_label()): (list(line.get_xdata()), list(line.get_ydata())) for line in figure.axes[0].lines}


def test_all_plots_and_plot_from_file_show_ours_beside_others(figures, capsys):
    command = ["plot", "all_plots", "-a", "dtfm", "sac", *RUNS, "-l", "here", "--no-million", "-o", "results"]
    assert main([*command, "--figures", "pictures"]) == 0
    output = capsys.readouterr().out
    assert re.search(r"^\| Environments \| +DTFM +\| +SAC +\|$", output, re.MULTILINE)
    assert "Figure: pictures/all_plots-Results-HalfCheetah-v5.png" in output
    drawn = curves(figures[0])
    for algo in ("dtfm", "sac"):
        evaluations = np.load(f"logs/{algo}/HalfCheetah-v5_1/evaluations.npz")
        steps, means = drawn[f"{algo.upper()}-here"]
        assert steps == evaluations["timesteps"].tolist()
        assert means == pytest.approx(evaluations["results"].mean(axis=1))

    assert main(["plot", "plot_from_file", "-i", "results.pkl", "--figures", "pictures"]) == 0
    assert "Figure: pictures/plot_from_file-Sensitivity-plot.png" in capsys.readouterr().out
    (axis,) = figures[-1].axes
    assert {text.get_text() for text in axis.get_legend().get_texts()} == {"DTFM-here", "SAC-here"}


def test_without_a_screen_the_figures_are_files(figures, monkeypatch, tmp_path):
    monkeypatch.setattr("matplotlib.pyplot.get_backend", lambda: "agg")
    assert main(["plot", "plot_train", "-a", "sac", *RUNS, "-w", "1"]) == 0
    assert Path("plot_train-Training-Episodic-Reward.png").is_file()
    assert set(curves(figures[0])) == {"HalfCheetah-v5_1", "HalfCheetah-v5_2"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plot_train", "-a", "DTFM", *RUNS], "--algo DTFM (did you mean dtfm?)"),
        (["plot_train", "-a", "dtfm", *RUNS], "there are no episodes of its training to draw; `sb3-dtfm plot RUN`"),
        (["plot_from_file", "-i", "one.pkl"], "draws nothing of which there is one run alone"),
        (["all_plots", "-a", "tqc", *RUNS], "nothing to draw in the folders of these algorithms and tasks"),
    ],
)
def test_what_cannot_be_drawn_is_said(arguments, message, logs, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(logs / "logs" / "dtfm" / "HalfCheetah-v5_1", "logs/dtfm/HalfCheetah-v5_1")
    assert main(["plot", "all_plots", "-a", "dtfm", *RUNS, "-o", "one", "--no-display", "--figures", "x"]) == 0
    assert main(["plot", *arguments, "--figures", "pictures"]) == 2
    assert message in capsys.readouterr().err
    assert not Path("pictures").exists()


def test_rl_zoos_own_command_starts():
    """It imports all of its plots before anything else."""
    import rl_zoo3.cli

    assert callable(rl_zoo3.cli.main)
