"""Images become features: one extractor of Stable-Baselines3 for each camera, a small residual network by default."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, NatureCNN
from torch import nn
from torch.nn import functional as F

from sb3_dtfm.policies.resnet import GroupNorm, ResNet18

CHANNELS_PER_GROUP = 8
# Random crops in a batch on a CPU: slices, since indices for each image take as long as a convolution.
N_CROPS = 16


class ResidualExtractor(BaseFeaturesExtractor):
    """
    A residual network with group normalisation and spatial softmax (Levine et al., 2016), which learns where things are on
    random crops, as in robomimic (Mandlekar et al., 2021) and Diffusion Policy (Chi et al., 2023). Acting crops the centre.

    The first convolution strides by 4, as NatureCNN's, since a stride of 2 learned less in the same seconds on a CPU (one
    run each).

    :param observation_space: Box (channels, height, width)
    :param features_dim: number of features of an image
    :param channels: channels of the first convolution and of each residual block; all but the last block halve height
        and width
    :param crop: kept share of height and width, in (0, 1]
    :param shift: pixels by which the edges are repeated before a random crop; 4 with `crop=1.0` is the random shift of DrQ
        (Kostrikov et al., 2021)
    :raises ValueError: another `crop`, a negative `shift`, fewer than two channels, or images too small for their number
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 64,
        channels: tuple[int, ...] = (32, 64, 64),
        crop: float = 0.9,
        shift: int = 0,
    ) -> None:
        super().__init__(observation_space, features_dim)
        if not 0.0 < crop <= 1.0 or len(channels) < 2:
            raise ValueError(f"crop must be a number in (0, 1] and channels two or more, got {crop!r} and {channels!r}.")
        if shift < 0:
            raise ValueError(f"shift must be a number of pixels, 0 or more, got {shift!r}.")
        self.shift = shift
        n_channels, height, width = observation_space.shape
        self.size = (round(crop * height), round(crop * width))
        # Sides of the last map: the stem and all blocks but the last stride.
        left = [-(-((side - 4) // 4 + 1) // 2 ** (len(channels) - 2)) for side in self.size]
        if min(left) < 1 or max(left) < 2:
            raise ValueError(
                f"of images of {height} x {width} a map of {max(0, left[0])} x {max(0, left[1])} is left, in which no place "
                "differs; larger images or fewer channels are expected."
            )
        self.stem = nn.Conv2d(n_channels, channels[0], kernel_size=8, stride=4, padding=2)
        *pairs, last = itertools.pairwise(channels)
        blocks = [ResidualBlock(*pair, stride=2) for pair in pairs]
        self.blocks = nn.Sequential(*blocks, ResidualBlock(*last, stride=1))
        self.linear = nn.Linear(2 * channels[-1], features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Map (N, channels, height, width) to (N, features_dim)."""
        maps = self.blocks(F.relu(self.stem(self._crop(observations))))
        return self.linear(spatial_softmax(maps))

    def _crop(self, images: th.Tensor) -> th.Tensor:
        """A random part of each image while training, on a CPU of a sixteenth of them; the centre of all otherwise."""
        if self.training and self.shift:
            images = F.pad(images, (self.shift,) * 4, mode="replicate")
        (height, width), room = self.size, (images.shape[2] - self.size[0], images.shape[3] - self.size[1])
        if not self.training:
            first, second = room[0] // 2, room[1] // 2
            return images[:, :, first : first + height, second : second + width]
        n_crops = min(N_CROPS, len(images)) if images.device.type == "cpu" else len(images)
        top, left = (th.randint(each + 1, (n_crops,), device=images.device) for each in room)
        if n_crops < len(images):
            corners = zip(images.tensor_split(n_crops), top.tolist(), left.tolist(), strict=True)
            return th.cat([part[:, :, y : y + height, x : x + width] for part, y, x in corners])
        rows, columns = (first[:, None] + th.arange(n, device=first.device) for first, n in ((top, height), (left, width)))
        numbers = th.arange(len(images), device=images.device)[:, None, None]
        return images[numbers, :, rows[:, :, None], columns[:, None, :]].movedim(3, 1)


class ResidualBlock(nn.Module):
    """
    Two convolutions beside a shortcut (He et al., 2016), with group normalisation (Wu and He, 2018).

    :param n_in: number of input channels
    :param n_out: number of output channels
    :param stride: stride of the first convolution, and of the shortcut
    """

    def __init__(self, n_in: int, n_out: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(n_in, n_out, kernel_size=3, stride=stride, padding=1, bias=False)
        n_groups = max(1, n_out // CHANNELS_PER_GROUP)
        self.first_norm = GroupNorm(n_groups, n_out)
        self.second = nn.Conv2d(n_out, n_out, kernel_size=3, padding=1, bias=False)
        self.second_norm = GroupNorm(n_groups, n_out)
        same = n_in == n_out and stride == 1
        self.shortcut = nn.Identity() if same else nn.Conv2d(n_in, n_out, kernel_size=1, stride=stride, bias=False)

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """Map (N, n_in, height, width) to (N, n_out, height / stride, width / stride)."""
        inner = F.relu(self.first_norm(self.first(maps)))
        return F.relu(self.shortcut(maps) + self.second_norm(self.second(inner)))


def spatial_softmax(maps: th.Tensor) -> th.Tensor:
    """
    Return where each channel is largest: the mean position under its softmax.

    Channels lie last here, as they mostly do in maps and in their gradients on a CPU, so that neither is copied.

    :param maps: (N, C, height, width)
    :return: (N, 2 C) in [-1, 1], the rows of all channels, then the columns
    """
    height, width = maps.shape[2:]
    weights = maps.permute(0, 2, 3, 1).flatten(1, 2).softmax(dim=1).unflatten(1, (height, width))
    rows, columns = (th.linspace(-1.0, 1.0, n, device=maps.device)[:, None] for n in (height, width))
    return th.cat(((weights.sum(dim=2) * rows).sum(dim=1), (weights.sum(dim=1) * columns).sum(dim=1)), dim=1)


# Extractors by their name in `features_extractor_class` and saved models; a user's own is entered here before loading.
EXTRACTORS: dict[str, type[BaseFeaturesExtractor]] = {
    each.__name__: each for each in (ResidualExtractor, NatureCNN, ResNet18)
}
PACKAGED = dict(EXTRACTORS)


def extractor_name(given: Any) -> Any:
    """
    The name of an extractor, which a file can hold; a class of a user's own is entered in `EXTRACTORS`.

    :param given: a class, or its name
    :raises ValueError: no extractor of SB3's kind, one of several spaces, or one with the name of a packaged one
    """
    if not isinstance(given, type):
        return given
    name = given.__name__
    if not issubclass(given, BaseFeaturesExtractor):
        raise ValueError(f"features_extractor_class: {name} is no subclass of SB3's BaseFeaturesExtractor.")
    if issubclass(given, CombinedExtractor):
        raise ValueError(
            f"features_extractor_class: {name} takes a Dict; expected is a class that takes one camera's image, a Box of "
            "(channels, height, width), such as NatureCNN. Each camera gets one, and vectors none."
        )
    if PACKAGED.get(name, given) is not given:
        raise ValueError(f"features_extractor_class: {name} is the name of a packaged class; call yours something else.")
    EXTRACTORS[name] = given
    return name


class ImageEncoder(nn.Module):
    """
    The features of all cameras side by side, each normalised over its own (Ba et al., 2016).

    :param image_spaces: Box (channels, height, width) uint8 by camera
    :param extractor: a key of `EXTRACTORS`
    :param extractor_kwargs: arguments of that class, by name
    :param normalize_images: whether images are divided by 255, as in SB3; otherwise the extractors get numbers from 0 to 255
    :param shared: whether one extractor serves all cameras, whose images then have the same shape
    :ivar features_dim: number F of features of all cameras
    :raises ValueError: an extractor that cannot take the images
    """

    def __init__(
        self,
        image_spaces: Mapping[str, spaces.Box],
        extractor: str,
        extractor_kwargs: Mapping[str, Any],
        normalize_images: bool,
        shared: bool,
    ) -> None:
        super().__init__()
        self.cameras = sorted(image_spaces)
        self.normalize_images = normalize_images
        shapes = {space.shape for space in image_spaces.values()}
        if shared and len(shapes) > 1:
            found = f"got {sorted(shapes)}; resize them or leave it out"
            raise ValueError(f"share_features_extractor=True needs images of one shape, {found}.")
        made = self.cameras[:1] if shared else self.cameras
        if extractor == ResNet18.__name__ and not normalize_images:
            raise ValueError("ResNet18 expects images from 0 to 1: leave normalize_images=True.")
        self.extractors = nn.ModuleList(_made(extractor, extractor_kwargs, each, image_spaces[each]) for each in made)
        self.norms = nn.ModuleList(nn.LayerNorm(self._extractor(i).features_dim) for i in range(len(self.cameras)))
        self.features_dim = sum(self._extractor(i).features_dim for i in range(len(self.cameras)))

    def _extractor(self, number: int) -> Any:
        return self.extractors[min(number, len(self.extractors) - 1)]

    def forward(self, images: Mapping[str, th.Tensor]) -> th.Tensor:
        """
        :param images: (..., channels, height, width) uint8 by camera
        :return: (..., F)
        """
        features = []
        for number, (camera, norm) in enumerate(zip(self.cameras, self.norms, strict=True)):
            flat = images[camera].flatten(end_dim=-4)
            pixels = flat.float().div_(255.0) if self.normalize_images else flat.float()
            found = norm(self._extractor(number)(pixels))
            features.append(found.unflatten(0, images[camera].shape[:-3]))
        return th.cat(features, dim=-1)


def _made(extractor: str, kwargs: Mapping[str, Any], camera: str, space: spaces.Box) -> BaseFeaturesExtractor:
    try:
        return EXTRACTORS[extractor](space, **kwargs)
    except (ArithmeticError, AssertionError, RuntimeError, TypeError, ValueError) as error:
        arguments = ", ".join(f"{name}={value!r}" for name, value in kwargs.items())
        raise ValueError(
            f"features_extractor_class {extractor}({arguments}) cannot be made for the camera {camera!r}, whose images have "
            f"the shape {space.shape} (channels, height, width): {error}"
        ) from error


def image_spaces(observation_space: spaces.Dict) -> dict[str, spaces.Box]:
    """The images among observations, by camera."""
    found = {}
    for name, space in observation_space.spaces.items():
        if isinstance(space, spaces.Box) and is_image_space(space, check_channels=False):
            found[name] = space
    return found


def unpack_images(observation: Mapping[str, Any], expected: Mapping[str, spaces.Box], n_rows: int) -> dict[str, np.ndarray]:
    """
    The images of an observation, channels first.

    :param observation: observation of a `ReturnToGoWrapper`, with images (B, ...), or one image for each camera
    :param expected: Box (channels, height, width) by camera
    :param n_rows: number B of rows
    :return: (B, channels, height, width) uint8 by camera
    :raises ValueError: a missing camera, or an image of another type or shape than the model's
    """
    images = {}
    for camera, space in expected.items():
        if camera not in observation:
            raise ValueError(f"observation has no image {camera!r}, which the model sees; got {', '.join(observation)}.")
        image = np.asarray(observation[camera])
        image = image[None] if image.ndim == 3 else image
        channels, height, width = space.shape
        if image.shape[1:] == (height, width, channels) and image.shape[1:] != space.shape:
            image = np.moveaxis(image, 3, 1)
        if image.dtype != np.uint8 or image.shape != (n_rows, *space.shape):
            raise ValueError(
                f"observation[{camera!r}] is {image.dtype} of shape {image.shape}; uint8 of "
                f"({n_rows}, {channels}, {height}, {width}) or ({n_rows}, {height}, {width}, {channels}) is expected."
            )
        images[camera] = np.ascontiguousarray(image)  # PyTorch takes no reversed axes
    return images
