"""Extractors that differ from the packaged ones by one change: random crops while learning, the centre while acting."""

import numpy as np
import pytest
import torch as th
from extractors import CroppedNatureCNN, FlattenedExtractor
from gymnasium import spaces


@pytest.mark.parametrize(("extractor", "n_features"), [(CroppedNatureCNN, 512), (FlattenedExtractor, 64)])
def test_acting_sees_the_centre_and_learning_all(extractor, n_features):
    network = extractor(spaces.Box(0, 255, (3, 84, 84), np.uint8))
    images = th.rand(2, 3, 84, 84, requires_grad=True)
    for training, rows_seen in ((False, 76), (True, 84)):
        network.train(training)
        gradient = sum(th.autograd.grad(network(images).sum(), images)[0].abs() for _ in range(40 if training else 1))
        assert network(images).shape == (2, n_features)
        assert int((gradient.sum(dim=(1, 3)) > 0).any(dim=0).sum()) == rows_seen
