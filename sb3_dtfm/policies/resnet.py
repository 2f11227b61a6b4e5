"""torchvision's ResNet-18 as an extractor of features; torchvision is imported with the first one."""

from os import PathLike

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

# Mean and standard deviation of ImageNet's channels, by which torchvision's published weights expect them normalised.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
CHANNELS_PER_GROUP = 16
# Buffers of batch normalisation.
STATISTICS = ("running_mean", "running_var", "num_batches_tracked")


class GroupNorm(nn.GroupNorm):
    """
    Group normalisation (Wu and He, 2018). On a CPU it is computed in the weights' precision: where channels lie last in
    memory, PyTorch's takes three to four times as long in bfloat16.
    """

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """Map (N, channels, height, width) to the same shape, on a CPU also the same precision."""
        if maps.device.type != "cpu":
            return super().forward(maps)
        return super().forward(maps.to(self.weight.dtype)).to(maps.dtype)


class ResNet18(BaseFeaturesExtractor):
    """
    ResNet-18 (He et al., 2016) with group instead of batch normalisation, whose running means a moving average of weights
    does not know, as in Diffusion Policy (Chi et al., 2023).

    :param observation_space: Box (3, height, width)
    :param features_dim: number of features of an image
    :param weights: file of torchvision's weights, as `torch.save(resnet18(...).state_dict(), weights)` writes it; not saved
        with a model, which holds the weights that it has learned. Random weights if not given
    :raises ImportError: torchvision is not installed, or was built for another torch
    :raises ValueError: other than three channels, or a file of other weights
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(
        self, observation_space: spaces.Box, features_dim: int = 64, weights: str | PathLike[str] | None = None
    ) -> None:
        super().__init__(observation_space, features_dim)
        try:
            from torchvision.models import resnet18
        except ModuleNotFoundError as error:
            raise ImportError("ResNet18 needs torchvision: pip install torchvision") from error
        except (ImportError, RuntimeError) as error:  # such as PyPI's, which needs CUDA, beside a torch for CPUs
            raise ImportError(
                f"ResNet18 needs a torchvision that was built for torch {th.__version__}; importing it fails: {error}. "
                "Install both from the same package index."
            ) from error
        if observation_space.shape[0] != 3:
            raise ValueError(f"ResNet18 needs images of 3 channels, got {observation_space.shape[0]}.")
        self.network = resnet18(norm_layer=lambda n_channels: GroupNorm(n_channels // CHANNELS_PER_GROUP, n_channels))
        if weights is not None:
            self._load(weights)
        self.network.fc = nn.Linear(self.network.fc.in_features, features_dim)
        self.register_buffer("mean", th.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", th.tensor(STD).view(3, 1, 1), persistent=False)

    def _load(self, weights: str | PathLike[str]) -> None:
        """Take all but the last layer, which is replaced, and the statistics of batch normalisation, which is not used."""
        stored = {name: each for name, each in th.load(weights, weights_only=True).items() if not name.startswith("fc.")}
        try:
            found = self.network.load_state_dict(stored, strict=False)
        except RuntimeError as error:
            raise ValueError(f"{weights} holds no weights of ResNet-18: {error}") from error
        missing = [name for name in found.missing_keys if not name.startswith("fc.")]
        unknown = [name for name in found.unexpected_keys if name.rpartition(".")[2] not in STATISTICS]
        if missing or unknown:
            fault = f"{missing[0]} is missing" if missing else f"{unknown[0]} belongs to another network"
            raise ValueError(f"{weights} holds no weights of ResNet-18: {fault}.")

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Map (N, 3, height, width) to (N, features_dim)."""
        features: th.Tensor = self.network((observations - self.mean) / self.std)
        return features
