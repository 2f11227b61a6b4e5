"""The files that docs/limits.py counts are all that runs between recorded steps and the loss."""

import sys
from pathlib import Path

import pytest
import torch as th

import sb3_dtfm
from docs.limits import TRAINING_PATH
from sb3_dtfm import DT, DTFM
from tests.algorithms.small import make_model

PACKAGE = Path(sb3_dtfm.__file__).parent


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_no_other_file_takes_part(algorithm, cheetah_buffer):
    model = make_model(algorithm, cheetah_buffer, policy_kwargs={DT: {}, DTFM: {"one_step_policy": False}}[algorithm])
    files = set()

    def note(frame, event, argument):
        path = Path(frame.f_code.co_filename)
        if event == "call" and PACKAGE in path.parents:
            files.add(path.relative_to(PACKAGE).as_posix())

    batches = cheetah_buffer.batches(16, 5, th.Generator())
    sys.setprofile(note)
    try:
        batch = next(batches)
        model.compute_loss(batch, *model.policy.network.draw_noise(batch, th.Generator()))
    finally:
        sys.setprofile(None)
    assert {"data/drawing.py", "networks/trunk.py"} < files <= set(TRAINING_PATH)
