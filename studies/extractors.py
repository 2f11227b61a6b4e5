"""
Extractors between ResidualExtractor and NatureCNN, one change each: docs/ablations.md.

    PYTHONPATH=studies MUJOCO_GL=egl sb3-dtfm benchmark --profile studies/images.yml --env robosuite/Lift-v0 --algo dtfm \\
        --fractions 0.1 --seeds 0 --final-episodes 100 -o mine --gym-packages extractors --label CroppedNatureCNN \\
        -params "policy_kwargs:dict(flow_draws=8, features_extractor_class='CroppedNatureCNN')"

The packaged one's changes are features_extractor_kwargs=dict(crop=1.0) and dict(features_dim=512) there.
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
            maps = self.blocks(self.stem(th.zeros(1, observation_space.shape[0], *self.size)))
        self.linear = nn.Linear(maps.numel(), features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Map (N, channels, height, width) to (N, features_dim)."""
        return self.linear(self.blocks(F.relu(self.stem(self._crop(observations)))).flatten(1))


EXTRACTORS |= {each.__name__: each for each in (CroppedNatureCNN, FlattenedExtractor)}
