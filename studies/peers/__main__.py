"""See :mod:`peers.command`."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before PyTorch counts the cores

from peers.command import run

run()
