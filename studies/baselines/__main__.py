"""See :mod:`baselines.command`."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before PyTorch counts the cores

from baselines.command import run

run()
