"""
Extractors between ResidualExtractor and NatureCNN, one change each: docs/ablations.md.

    PYTHONPATH=studies sb3-dtfm benchmark ... --gym-packages extractors \\
        -params "policy_kwargs:dict(flow_draws=8, features_extractor_class='CroppedNatureCNN')"
"""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.policies.images import EXTRACTORS, ResidualExtractor


class CroppedNatureCNN(NatureCNN):
    """
    NatureCNN that learns on random crops, as ResidualExtractor does.

    :param observation_space: Box (channels, height, width)
    :param features_dim: numbers that an image becomes
    :param crop: kept share of height and width
    """

    _crop = ResidualExtractor._crop
    shift = 0

    def __init__(self, observation_space: spaces.Box, features_dim: int = 512, crop: float = 0.9) -> None:
        channels, height, width = observation_space.shape
        size = (round(crop * height), round(crop * width))
        super().__init__(spaces.Box(0, 255, (channels, *size), np.uint8), features_dim)
        self.size = size

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Map (N, channels, height, width) to (N, features_dim)."""
        return super().forward(self._crop(observations))


class FlattenedExtractor(ResidualExtractor):
    """ResidualExtractor that sees all of its last map, as NatureCNN does, instead of where each channel is largest."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 64, **kwargs: Any) -> None:
        super().__init__(observation_space, features_dim, **kwargs)
        with th.no_grad():
            maps = self._maps(th.zeros(1, *observation_space.shape))
        self.linear = nn.Linear(maps.flatten(1).shape[1], features_dim)

    def _maps(self, observations: th.Tensor) -> th.Tensor:
        maps: th.Tensor = self.blocks(F.relu(self.stem(self._crop(observations))))
        return maps

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Map (N, channels, height, width) to (N, features_dim)."""
        return self.linear(self._maps(observations).flatten(1))


EXTRACTORS |= {each.__name__: each for each in (CroppedNatureCNN, FlattenedExtractor)}
