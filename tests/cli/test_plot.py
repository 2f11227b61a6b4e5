"""The learning curve of a run: what is drawn, and that the picture says what it shows."""

import pickle

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from sb3_dtfm.cli.main import main
from sb3_dtfm.cli.plot import load_evaluations, plot_learning_curve


@pytest.mark.parametrize("n_logged", [1, 2])
def test_the_loss_is_drawn_however_often_it_was_logged(n_logged, tmp_path, figures):
    np.savez(tmp_path / "evaluations.npz", timesteps=[0, 10], results=np.ones((2, 3)))
    with SummaryWriter(str(tmp_path / "tb")) as writer:
        for step in range(n_logged):
            writer.add_scalar("train/loss", 0.5, 10 * step)
    plot_learning_curve(tmp_path, tmp_path / "curve.png", tmp_path / "tb")
    (line,) = figures[0].axes[1].lines
    assert line.get_ydata().tolist() == [0.5] * n_logged
    assert n_logged > 1 or line.get_marker() == "o", "one point makes no line"


def test_a_folder_without_tensorboards_events_is_refused(tmp_path):
    np.savez(tmp_path / "evaluations.npz", timesteps=[0, 10], results=np.ones((2, 3)))
    SummaryWriter(str(tmp_path / "tb" / "DTFM_1")).close()
    for folder in ("tb", "nowhere"):
        with pytest.raises(FileNotFoundError, match=f"{folder} holds no TensorBoard events; expected"):
            plot_learning_curve(tmp_path, tmp_path / "curve.png", tmp_path / folder)
    assert not (tmp_path / "curve.png").exists()


@pytest.mark.parametrize(
    "content",
    [
        dict(results=np.ones((2, 3))),
        dict(timesteps=[0, 10], results=np.ones((3, 3))),
        dict(timesteps=[0, 10], results=np.array([{}, {}])),
        dict(timesteps=[0, 10], results=np.ones((2, 3)), successes=np.ones(2)),
        b"",
        b"text",
        b"PK\3\4",
        pickle.dumps(0),
    ],
    ids=["no steps", "another number", "objects", "successes of another shape", "empty", "text", "cut off", "pickled"],
)
def test_damaged_evaluations_are_named(content, tmp_path, capsys):
    path = tmp_path / "evaluations.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)
    assert main(["plot", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"{path} is damaged, or no file of SB3's EvalCallback" in line
    assert "expected the arrays timesteps (E,) and results (E, n)" in line


@pytest.mark.parametrize(
    ("successes", "band", "means", "widest"),
    [
        ([[False] * 4, [True, False, False, False], [True] * 4], "95 % Wilson interval", [0, 25, 100], (0, 100)),
        (None, "± standard deviation", [1.0, 3.0, 5.0], (-1.0, 7.0)),
    ],
)
def test_a_run_is_drawn_with_a_band_that_is_explained_and_stays_in_the_axes(
    successes, band, means, widest, tmp_path, figures
):
    returns = np.array([[1.0, 1, 1, 1], [1.0, 5, 1, 5], [3.0, 7, 3, 7]])
    arrays = {} if successes is None else {"successes": np.array(successes)}
    np.savez(tmp_path / "evaluations.npz", timesteps=[0, 10, 20], results=returns, ep_lengths=np.ones((3, 4)), **arrays)
    assert ("successes" in load_evaluations(tmp_path)) == (successes is not None)
    picture = plot_learning_curve(tmp_path, tmp_path / "new" / "curve.png")
    assert picture.read_bytes().startswith(b"\x89PNG")

    (axis,) = figures[0].axes
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["mean of 4 episodes", band]
    steps, drawn = axis.lines[0].get_data()
    assert steps.tolist() == [0, 10, 20]
    assert drawn.tolist() == pytest.approx(means)
    limits, (bottom, top) = axis.collections[0].get_datalim(axis.transData), axis.get_ylim()
    assert bottom <= limits.y0 < limits.y1 <= top
    assert widest[0] <= limits.y0
    assert limits.y1 <= widest[1]
    assert axis.get_xlim()[0] == 0
