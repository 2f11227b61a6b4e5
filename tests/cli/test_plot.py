"""The learning curve of a run: what is drawn, and that the picture says what it shows."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from sb3_dtfm.cli.plot import load_evaluations, plot_learning_curve


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that are saved, to look into."""
    saved: list[Figure] = []
    save = Figure.savefig

    def savefig(figure: Figure, *args, **kwargs) -> None:
        saved.append(figure)
        save(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return saved


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
    assert (load_evaluations(tmp_path).successes is None) == (successes is None)
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
