"""Observations of any structure as the vectors that :class:`~sb3_dtfm.envs.ReturnToGoWrapper` makes of them."""

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from gymnasium import spaces

from sb3_dtfm.data.trajectories import DatasetError, check_real
from sb3_dtfm.envs.observation_spaces import (
    IMAGE,
    flatten_observation_space,
    image_spaces,
    looks_like_images,
    sort_observation_space,
    warn_if_a_picture,
    without_images,
)

# First bytes of a JPEG image.
JPEG = b"\xff\xd8\xff"
# Function that returns an episode's array by its name and the keys of the parts of a Dict or Tuple that lead to it.
ReadArray: TypeAlias = Callable[..., np.ndarray]


STORED_AS_JPEG = (
    "hold JPEG images, as which Minari stores arrays of bytes; they are not read. Record vectors as another type than uint8."
)


class Observed(NamedTuple):
    """
    :param vectors: (T, O)
    :param images: (T, height, width, channels) uint8, or channels first, by camera
    """

    vectors: np.ndarray
    images: dict[str, np.ndarray]

    def first(self, n_steps: int) -> "Observed":
        """Return what was observed in the first steps."""
        return Observed(self.vectors[:n_steps], {camera: images[:n_steps] for camera, images in self.images.items()})


def observed(observations: Any, keys: Sequence[str] | None, space: spaces.Space | None, where: str) -> Observed:
    """
    Observations with their images apart.

    :param observations: (T, ...), or a dictionary of such
    :param keys: entries of the dictionary, cameras too, that make up the observation, in this order; None for all
    :param space: the environment's observation space; None if it is unknown
    :param where: origin of the observations, for messages
    :return: vectors and images; without vectors a single number that is always 0
    :raises DatasetError: as :func:`in_space` and :func:`chosen`
    """
    if isinstance(observations, Mapping):
        entries = {name: _array(each, f"{where}, {name}") for name, each in observations.items()}
        observations = entries
    else:
        observations = _array(observations, where)
        entries = {IMAGE: observations}
    names = list(entries) if keys is None else keys
    images = {str(name): np.asarray(entries[name]) for name in names if name in entries and is_images(entries[name])}
    if not images:
        vectors = in_space(observations, space, where) if keys is None else chosen(observations, keys, space, where)
        return Observed(vectors, {})
    others = [name for name in names if name not in images]
    space = None if space is None else without_images(space)
    if not others:
        return Observed(np.zeros((len(next(iter(images.values()))), 1), np.float32), images)
    if keys is None:
        return Observed(in_space({name: entries[name] for name in others}, space, where), images)
    return Observed(chosen(entries, others, space, where), images)


def _array(entry: Any, where: str) -> Any:
    """An array of what is a list of arrays; anything else as it is."""
    is_list = isinstance(entry, list | tuple) and len(entry) > 0 and isinstance(entry[0], np.ndarray)
    return stacked(entry, where) if is_list else entry


def stacked(steps: Sequence[Any], where: str) -> np.ndarray:
    """
    One array after the other.

    :param steps: an array for each step
    :param where: origin of the arrays, for messages
    :return: (T, ...)
    :raises DatasetError: a step has another shape than the first
    """
    arrays = [np.asarray(step) for step in steps]
    other = next((number for number, array in enumerate(arrays) if array.shape != arrays[0].shape), None)
    if other is not None:
        raise DatasetError(
            f"{where}: step {other} has the shape {arrays[other].shape}, expected {arrays[0].shape} as in step 0."
        )
    return np.stack(arrays)


def is_images(array: Any) -> bool:
    """Return whether this is an image a step: bytes with three axes each."""
    return not isinstance(array, Mapping) and np.asarray(array).dtype == np.uint8 and np.ndim(array) == 4


def as_vectors(observations: Any, where: str) -> np.ndarray:
    """
    Observations of an unknown space.

    :param observations: (T, ...), or a dictionary of such, of any depth
    :param where: origin of the observations, for messages
    :return: (T, O), the entries of a dictionary side by side in the order of their keys
    :raises DatasetError: parts of different lengths, or without steps
    """
    if not isinstance(observations, Mapping):
        array = np.asarray(observations)
        check_real(array.dtype, where)
        if array.ndim == 0 or array.size == 0:
            raise DatasetError(f"{where} has shape {array.shape}; one entry a step is expected, for at least one step.")
        check_no_images(array, where)
        return array.reshape(len(array), -1)
    if not observations:
        raise DatasetError(f"{where} is an empty dictionary.")
    parts = {key: as_vectors(observations[key], f"{where}, {key}") for key in sorted(observations)}
    lengths = {key: len(part) for key, part in parts.items()}
    if len(set(lengths.values())) > 1:
        raise DatasetError(f"{where} has entries of different lengths: {lengths}.")
    return np.concatenate(list(parts.values()), axis=1)


def in_space(observations: Any, space: spaces.Space | None, where: str) -> np.ndarray:
    """
    Observations as the vectors that the wrapper makes of them in an environment, which knows what is a choice.

    :param observations: see :func:`as_vectors`
    :param space: the environment's observation space; None if it is unknown
    :param where: origin of the observations, for messages
    :return: (T, O), with a one-hot vector for each Discrete number
    :raises DatasetError: as :func:`as_vectors`, or not in the space
    """
    if isinstance(space, spaces.Dict | spaces.Tuple):
        if isinstance(space, spaces.Tuple) and np.shape(observations)[1:] == (len(space),):  # a number for each part
            observations = dict(enumerate(np.asarray(observations).T))
        if not isinstance(observations, Mapping):
            return as_vectors(observations, where)
        parts: dict[Any, spaces.Space] = dict(space.spaces if isinstance(space, spaces.Dict) else enumerate(space.spaces))
        missing = sorted(str(key) for key in parts if key not in observations)
        if missing:
            there = ", ".join(map(str, observations))
            raise DatasetError(f"{where} has no {', '.join(missing)}, which the environment observes, only {there}.")
        return np.concatenate([in_space(observations[key], parts[key], f"{where}, {key}") for key in sorted(parts)], axis=1)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary) and not isinstance(
        observations, Mapping
    ):
        array = np.asarray(observations)
        if array.shape[1:] in (space.shape, (math.prod(space.shape or ()),)):
            return flatten_observations(lambda *_: array, (), space, where)[0]
    return as_vectors(observations, where)


def chosen(observations: Any, keys: Sequence[str], space: spaces.Space | None, where: str) -> np.ndarray:
    """
    Some entries of dictionary observations side by side, in the order of their keys.

    :param observations: dictionary of observations, see :func:`in_space`
    :param keys: names of the entries
    :param space: the environment's observation space, or None
    :param where: origin of the observations, for messages
    :return: (T, O)
    :raises DatasetError: as :func:`in_space`, or there is no such entry
    """
    if not isinstance(observations, Mapping):
        raise DatasetError(f"{where}: observation_keys needs a dictionary, got an array; leave it out.")
    parts = []
    for key in keys:
        if key not in observations:
            raise DatasetError(f"{where} has no {key!r}, only {', '.join(map(str, observations))}.")
        parts.append(in_space(observations[key], part_of(space, key), f"{where}, {key}"))
    return np.concatenate(parts, axis=1)


def part_of(space: spaces.Space | None, key: str) -> spaces.Space | None:
    """The space of an entry of dictionary observations, where it is known."""
    return space.spaces.get(key) if isinstance(space, spaces.Dict) else None


def check_order(
    keys: Sequence[str] | Mapping[str, str] | None, cameras: Collection[str], space: spaces.Space | None, source: str
) -> None:
    """
    Compare the entries that were chosen with those of an environment, which shows all of its own, sorted by name.

    :param keys: `observation_keys`; only a mapping has to have the environment's names
    :param cameras: names of the images among them
    :param space: the environment's observation space, None if it is unknown
    :param source: name of the dataset, for messages
    :raises DatasetError: they have another order than the environment's, or a mapping names what it does not observe
    """
    if keys is None or not isinstance(space, spaces.Dict):
        return
    shown = [key for key in sorted(space.spaces) if key not in image_spaces(space)]
    unknown = [key for key in keys if key not in cameras and key not in shown]
    if isinstance(keys, Mapping) and unknown:
        raise DatasetError(
            f"{source}: observation_keys has {', '.join(unknown)}; the environment's names are {', '.join(shown)}."
        )
    known = [key for key in keys if key in shown]
    if not isinstance(keys, Mapping) and known != sorted(known):
        there = iter(sorted(known))
        cure = [next(there) if key in shown else key for key in keys]
        raise DatasetError(
            f"{source}: observation_keys has {', '.join(known)} in this order, and the environment shows its entries "
            f"sorted by name: write observation_keys={cure}."
        )


class Chosen(NamedTuple):
    """
    The entries of a dataset's observation space that are observed.

    :param cameras: image spaces by camera
    :param keys: names of the other entries of a Dict, in this order; None for all
    :param vectors: space of these entries, with sorted keys; None for images alone
    :param alone: whether the dataset's space is no Dict, so that an image is the whole observation
    """

    cameras: dict[str, spaces.Box]
    keys: list[str] | None
    vectors: spaces.Space | None
    alone: bool

    @property
    def flat(self) -> spaces.Box:
        """The space of the vector that they become: without vectors a single number that is always 0."""
        return flatten_observation_space(self.vectors or without_images(spaces.Dict(dict(self.cameras))))


def chosen_space(space: spaces.Space, keys: Sequence[str] | None, source: str) -> Chosen:
    """
    Choose entries of a dataset's observation space.

    :param space: observation space of the dataset
    :param keys: names of a Dict's entries, cameras too, in this order; None for the whole space
    :param source: name of the dataset, for messages
    :raises DatasetError: no Dict, or no such entry, or none that can be used
    """
    cameras = image_spaces(space)
    there: Mapping[str, spaces.Space] = space.spaces if isinstance(space, spaces.Dict) else cameras
    if keys is not None and (not keys or set(keys) - set(there)):
        found = f"entries {', '.join(sorted(there))}" if there else f"no entries, but {space}"
        raise DatasetError(f"{source}: observation_keys is {list(keys)}; the observations have {found}.")
    alone = not isinstance(space, spaces.Dict)
    try:
        if keys is None:
            vectors = None if len(cameras) == len(there) > 0 else sort_observation_space(without_images(space))
            return Chosen(cameras, None, vectors, alone)
        others = [key for key in keys if key not in cameras]
        vectors = sort_observation_space(spaces.Tuple([there[key] for key in others])) if others else None
        return Chosen({key: cameras[key] for key in keys if key in cameras}, others, vectors, alone)
    except ValueError as error:
        raise DatasetError(f"{source}: {error}") from error


def flatten_chosen(read: ReadArray, chosen: Chosen, where: str) -> list[np.ndarray]:
    """
    Flatten the chosen vectors, as :func:`flatten_observations` does.

    :param chosen: chosen entries of the dataset's space
    """
    if chosen.vectors is None:
        return []
    if chosen.keys is None:
        return flatten_observations(read, ("observations",), chosen.vectors, where)
    assert isinstance(chosen.vectors, spaces.Tuple)
    parts = zip(chosen.keys, chosen.vectors.spaces, strict=True)
    columns = (flatten_observations(read, ("observations", key), part, where) for key, part in parts)
    return list(itertools.chain.from_iterable(columns))


def check_no_images(array: np.ndarray, where: str) -> None:
    """
    Refuse what the wrapper refuses in an environment, and warn of what it warns of.

    :param array: (T, ...)
    :param where: origin of the array, for messages
    :raises DatasetError: bytes with more than one axis a step, or other numbers in the shape of images
    """
    if array.dtype == np.uint8 and array.ndim == 4:
        raise DatasetError(
            f"{where} holds images of shape {array.shape[1:]} inside of another entry; move them to an entry of the "
            "observation itself."
        )
    if (array.dtype == np.uint8 and array.ndim > 2) or looks_like_images(array.shape[1:]):
        raise DatasetError(
            f"{where} is {array.dtype} of shape {array.shape}, expected images as uint8 of (steps, height, width, "
            "channels), 0 to 255, or vectors of numbers; for floats from 0 to 1 write (255 * images).astype(np.uint8), and "
            "flatten what is no image."
        )
    warn_if_a_picture(array.shape[1:])


def flatten_observations(read: ReadArray, path: tuple[str | int, ...], space: spaces.Space, where: str) -> list[np.ndarray]:
    """
    A whole episode's observations as columns of the vector that the wrapper makes of one observation.

    :param read: function that returns one of its arrays by its name and the keys that lead to a part
    :param path: keys that lead to the part of the observations that `space` describes
    :param space: observation space with sorted keys
    :param where: the file and the episode, for messages
    :return: arrays (T + 1, .) to be joined along the second axis
    :raises DatasetError: entries of another shape than the space's, or none of its own
    """
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        columns = [flatten_observations(read, (*path, key), part, where) for key, part in parts]
        return list(itertools.chain.from_iterable(columns))
    values, name = read(*path), "/".join(map(str, path))
    check_real(values.dtype, f"{where}: {name}")
    size = math.prod(space.shape or ())
    if values.dtype == np.uint8 and values.ndim == 2 and values[:1, :3].tobytes() == JPEG and size != values.shape[1]:
        raise DatasetError(f"{where}: {name} {STORED_AS_JPEG}")
    if values.shape[1:] not in (space.shape, (size,)):
        raise DatasetError(
            f"{where}: {name} have shape {values.shape}, expected (steps, {', '.join(map(str, space.shape or ()))})."
        )
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        values = values.reshape(len(values), *(space.shape or ()))
        return [np.stack([_one_hot(space, value, f"{where}: {name}") for value in values])]
    return [values.reshape(len(values), size)]


def _one_hot(space: spaces.Space, value: Any, where: str) -> np.ndarray:
    if not space.contains(value):  # NumPy would count a negative one from the end
        raise DatasetError(f"{where} hold {value}, which is not in {space}.")
    return np.asarray(spaces.flatten(space, value))
