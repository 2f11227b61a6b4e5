"""TensorBoard's page of a training, in a browser."""

import shutil
import subprocess
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image
from tensorboard import program

from sb3_dtfm.cli.main import main
from tests.recorded import DATASET_ID, tiny_training

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
TRAINING = "?tagFilter=train#timeseries"
N_LOOKS = 10
N_PIXELS = 1_000  # of lines; the dots of the legend have fewer
# Without WebGL, whose pictures come when they come, TensorBoard draws as SVG.
HEADLESS = ["--headless=new", "--no-sandbox", "--disable-3d-apis", "--hide-scrollbars", "--window-size=1400,2400"]
LINE = np.array([0x42, 0x50, 0x66])  # the colour of the first run
TIME = "--virtual-time-budget=60000"  # milliseconds of the page's own clock


def browse(address: str, *options: str) -> str:
    assert BROWSER is not None
    command = [BROWSER, *HEADLESS, TIME, *options, address]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout


def wait_for(look: Callable[[], bool]) -> bool:
    """Whether a look shows it, of several: the browser's clock does not wait for what the server has to send."""
    return any(look() for _ in range(N_LOOKS))


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs chromium")
def test_the_page_shows_the_curves_of_a_training(workplace):
    arguments = ["--dataset", DATASET_ID, "--eval-freq", "2", "--eval-episodes", "1", "-tb", "tb"]
    assert main([*tiny_training("dtfm", *arguments), "--log-interval", "1"]) == 0
    server = program.TensorBoard()
    server.configure(argv=["tensorboard", "--logdir", "tb", "--port", "0"])
    address = server.launch()

    def has(where: str, *curves: str) -> bool:
        page = browse(f"{address}{where}", "--dump-dom")
        return all(curve in page for curve in curves)

    def lines() -> bool:
        browse(f"{address}{TRAINING}", f"--screenshot={workplace / 'page.png'}")
        picture = np.asarray(Image.open("page.png").convert("RGB")).reshape(-1, 3).astype(int)
        assert (picture.min(axis=1) > 200).mean() > 0.5, "a light page"
        return int((np.abs(picture - LINE).max(axis=1) < 10).sum()) > N_PIXELS

    assert wait_for(lambda: has("#timeseries", "eval/mean_reward", "eval/mean_ep_length", "time/steps_per_second"))
    training = ("loss", "flow_loss", "action_mse", "grad_norm", "learning_rate")
    assert wait_for(lambda: has(TRAINING, *(f"train/{curve}" for curve in training)))
    assert wait_for(lines)
