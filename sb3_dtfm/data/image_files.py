"""Images as files hold them, JPEG or PNG, become arrays of bytes."""

import io
from typing import Any

import numpy as np
from PIL import Image

from sb3_dtfm.data.trajectories import DatasetError, wrap_dataset_errors
from sb3_dtfm.envs.cameras import resize_image

# Accepted formats; the decoders of others are less reviewed.
FORMATS = ("JPEG", "PNG")
# Channels by Pillow's names of what has eight bits each.
CHANNELS = {"L": 1, "RGB": 3, "RGBA": 4}


def decode_images(
    encoded: Any, n_steps: int, shape: tuple[int, ...], where: str, size: tuple[int, int] | None = None
) -> np.ndarray:
    """
    :param encoded: sequence of at least T images, each the bytes of a JPEG or PNG file
    :param n_steps: T
    :param shape: (height, width, channels) that each must have
    :param where: the file, the episode and the camera
    :param size: (height, width) that all images are resized to; None keeps their size
    :return: (T, height, width, channels) uint8
    :raises DatasetError: names the first step whose image is damaged or has another shape
    """
    images = np.empty((n_steps, *(size or shape[:2]), shape[2]), np.uint8)
    for step in range(n_steps):
        with wrap_dataset_errors(f"{where}, step {step}", "the image is no JPEG or PNG, or damaged"):
            images[step] = resize_image(_decode(bytes(encoded[step]), shape, f"{where}, step {step}"), size)
    return images


def _decode(encoded: bytes, shape: tuple[int, ...], where: str) -> np.ndarray:
    with Image.open(io.BytesIO(encoded), formats=FORMATS) as image:
        found = image.height, image.width, CHANNELS.get(image.mode)
        if found != shape:
            raise DatasetError(f"{where}: the image is {image.mode} of {found[0]} x {found[1]} pixels, expected {shape}.")
        return np.asarray(image).reshape(shape)
