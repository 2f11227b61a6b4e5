"""Observation spaces: images apart, and all else as the one vector that a sequence policy sees."""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecTransposeImage

OBSERVATION = "observation"
RETURN_TO_GO = "return_to_go"
TIMESTEP = "timestep"
# The camera of an environment that observes nothing but an image.
IMAGE = "image"
# Numbers of channels that images have.
CHANNELS = (1, 3, 4)
# Length of both sides from which on a matrix may be a picture, pixels.
SMALLEST_PICTURE = 16
# Names of what ReturnToGoWrapper shows and of a step's arrays, which no image may have.
RESERVED = {OBSERVATION, RETURN_TO_GO, TIMESTEP, "observations", "actions", "rewards", "returns_to_go"}


def image_spaces(space: spaces.Space) -> dict[str, spaces.Box]:
    """
    The images that an environment shows, by camera.

    :param space: observation space: an image itself, which is called `image`, or a Dict of images and others
    :return: Box of uint8, as the environment has them
    """
    parts = space.spaces if isinstance(space, spaces.Dict) else {IMAGE: space}
    return {str(key): part for key, part in parts.items() if isinstance(part, spaces.Box) and _is_image(part)}


def _is_image(space: spaces.Box) -> bool:
    return space.dtype == np.uint8 and len(space.shape) == 3


def check_image_shape(shape: tuple[int, ...], name: str) -> None:
    """
    Refuse an image whose channels cannot be told from height and width.

    :param shape: (height, width, channels), or channels first
    :param name: name of the image, for the message
    :raises ValueError: 1, 3 or 4 neither at the first nor at the last place, or at both
    """
    if (shape[0] in CHANNELS) == (shape[2] in CHANNELS):
        raise ValueError(f"{name} has shape {shape}, expected 1, 3 or 4 channels, either first or last.")


def looks_like_images(shape: tuple[int, ...]) -> bool:
    """
    Return whether numbers other than bytes have the shape of an image, or of several.

    :param shape: shape of the numbers at a step
    """
    if len(shape) < 3:
        return False
    *several, first, second, third = shape
    smallest = SMALLEST_PICTURE if several else 0
    return (third in CHANNELS and min(first, second) >= smallest) or (first in CHANNELS and min(second, third) >= smallest)


def warn_if_a_picture(shape: tuple[int, ...]) -> None:
    """
    Say that a matrix as large as a picture becomes a vector.

    :param shape: shape of the numbers at a step
    """
    if len(shape) == 2 and min(shape) >= SMALLEST_PICTURE:
        warnings.warn(
            f"A part of the observation has the shape {shape} and becomes a vector of {math.prod(shape)} numbers. If it is "
            "an image, give it as uint8 of (height, width, 1).",
            stacklevel=3,
        )


def channels_first(space: spaces.Box) -> spaces.Box:
    """The space of images as a network takes them, (channels, height, width)."""
    return space if is_image_space_channels_first(space) else VecTransposeImage.transpose_space(space)


def without_images(space: spaces.Space) -> spaces.Space:
    """The space of what is no image; of images alone, a number that is always 0."""
    if not image_spaces(space):
        return space
    others = (
        {key: part for key, part in space.spaces.items() if key not in image_spaces(space)}
        if isinstance(space, spaces.Dict)
        else {}
    )
    return spaces.Dict(others) if others else spaces.Box(0.0, 0.0, (1,), np.float32)


def sort_observation_space(space: spaces.Space) -> spaces.Space:
    """
    The same space with the keys of every Dict in sorted order, at any depth.

    A Dict space may keep the order it was built with, and that order is lost on the way through a dataset's file.
    Sorted, an environment and its recordings flatten alike.

    :raises ValueError: a part of the space is an image or has no fixed number of entries
    """
    if isinstance(space, spaces.Dict) and len(space) > 0:
        return spaces.Dict({key: sort_observation_space(part) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Tuple) and len(space) > 0:
        return spaces.Tuple([sort_observation_space(part) for part in space.spaces])
    if isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) > 1:
        raise ValueError(
            f"Observation space {space} is no image that can be used: height, width and channels of uint8 are expected, "
            "as a space of its own or as an entry of the Dict that the environment observes."
        )
    if isinstance(space, spaces.Box) and looks_like_images(space.shape):
        raise ValueError(
            f"Observation space {space} looks like an image of {space.dtype}; images are uint8, 0 to 255. Scale them in a "
            "wrapper, or flatten what is none: gymnasium.wrappers.FlattenObservation."
        )
    if not isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise ValueError(
            f"Observation space {space} cannot be flattened to a Box; "
            "accepted are Box, Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of some of these."
        )
    return space


def flatten_observation_space(space: spaces.Space) -> spaces.Box:
    """
    The vector that observations of a space become: Dict entries one after the other by sorted key.

    :param space: an environment's observation space
    :return: Box (O,) float32 with the bounds of `space`
    :raises ValueError: the space holds an image or has no fixed number of entries
    """
    flat = spaces.flatten_space(sort_observation_space(space))
    assert isinstance(flat, spaces.Box)
    with np.errstate(over="ignore"):
        return spaces.Box(flat.low.astype(np.float32), flat.high.astype(np.float32), dtype=np.float32)


def check_cameras(images: Iterable[str]) -> None:
    """
    Refuse images whose names stand for something else.

    :param images: names of the images
    :raises ValueError: a name of what ReturnToGoWrapper shows, or of a step's arrays
    """
    if taken := sorted(RESERVED.intersection(images)):
        reserved = ", ".join(sorted(RESERVED))
        raise ValueError(f"An image is called {', '.join(taken)}; other names than {reserved} are expected.")


def _boxes(space: spaces.Space) -> Iterator[spaces.Box]:
    """All Box parts of a space."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        for part in space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces:
            yield from _boxes(part)
    elif isinstance(space, spaces.Box):
        yield space


def return_to_go_space(observation_space: spaces.Space, images: Mapping[str, spaces.Box] | None = None) -> spaces.Dict:
    """
    Observation space of a sequence policy, for an environment or for a dataset.

    :param observation_space: observation space of the bare environment, or the flat one of a dataset's buffer
    :param images: image spaces of a dataset's buffer, by camera; those in `observation_space` by default
    :return: Dict of `observation` (O,) float32, `return_to_go` (1,) float32, `timestep` (1,) int64, and images by camera
    :raises ValueError: `observation_space` cannot be flattened, or an image cannot be used
    """
    images = image_spaces(observation_space) if images is None else images
    for part in _boxes(without_images(observation_space)):
        warn_if_a_picture(part.shape)
    check_cameras(images)
    for camera, space in images.items():
        check_image_shape(space.shape, f"The image {camera!r}")
        if not is_image_space(space, check_channels=False):
            raise ValueError(f"The image {camera!r} is {space}; bounds of 0 and 255 are expected.")
    return spaces.Dict(
        {
            OBSERVATION: flatten_observation_space(without_images(observation_space)),
            RETURN_TO_GO: spaces.Box(-np.inf, np.inf, (1,), np.float32),
            # Box.sample adds one to the bound, which overflows at the largest int64.
            TIMESTEP: spaces.Box(0, np.iinfo(np.int32).max, (1,), np.int64),
            **images,
        }
    )
