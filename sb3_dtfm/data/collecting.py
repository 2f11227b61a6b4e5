"""Recorded episodes become the flat arrays of a buffer, each checked on the way."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dtfm.actions import ActionSpace, to_vectors, vector_space
from sb3_dtfm.data.episodes import EpisodeTable, moments
from sb3_dtfm.data.short_episodes import ShortEpisodes
from sb3_dtfm.data.storage import FileStorage, MemoryStorage
from sb3_dtfm.data.trajectories import (
    DatasetError,
    Trajectory,
    check_action_space,
    check_finite,
    check_size,
    check_trajectory,
)

# Ways to treat an invalid episode.
ON_INVALID = ("raise", "drop")
# Result of checking episodes: their rows of the table, and the returns-to-go of their steps.
Checked = tuple[EpisodeTable, np.ndarray]


def collect(
    trajectories: Iterable[Trajectory | ShortEpisodes],
    action_space: ActionSpace,
    observation_space: spaces.Box | None,
    n_steps: int | None,
    source: str,
    storage: MemoryStorage | FileStorage,
    on_invalid: str,
    n_stored: int | None,
) -> tuple[dict[str, th.Tensor], EpisodeTable, spaces.Box, dict[str, spaces.Box], tuple[int, str] | None]:
    """
    Arguments are those of :meth:`TrajectoryBuffer.from_trajectories`.

    :param trajectories: episodes, or many short ones together
    :return: the flat tensors, a row for each episode, the observation space, those of images by camera, and what the buffer
        tells of dropped episodes
    :raises DatasetError: see there
    """
    if on_invalid not in ON_INVALID:
        raise DatasetError(f"on_invalid must be one of {', '.join(ON_INVALID)}, got {on_invalid!r}.")
    action_space = check_action_space(action_space, source)
    n_action_numbers = vector_space(action_space).shape[0]
    if n_steps is None and isinstance(trajectories, Sequence):
        n_steps = sum(map(len, trajectories))
    storage.reserve(n_steps or 0)
    tables: list[EpisodeTable] = []
    dropped: list[DatasetError] = []
    image_spaces: dict[str, spaces.Box] | None = None
    start = 0

    def check(episodes: Trajectory | ShortEpisodes) -> tuple[EpisodeTable, np.ndarray]:
        nonlocal observation_space, image_spaces
        trajectory = episodes.steps if isinstance(episodes, ShortEpisodes) else episodes
        space = observation_space or spaces.Box(-np.inf, np.inf, np.shape(trajectory.observations)[1:], np.float32)
        to_go = check_trajectory(trajectory, space, action_space, source, image_spaces)
        if n_stored is not None:
            n_rows, n_columns = max(n_steps or 0, start + len(trajectory)), space.shape[0] + n_action_numbers + 2
            check_size(4 * n_rows * n_columns, n_stored, f"{source}: {n_rows} steps")
        observation_space = space
        if image_spaces is None:
            shapes = {camera: array.shape[1:] for camera, array in trajectory.images.items()}
            image_spaces = {camera: spaces.Box(0, 255, shape, np.uint8) for camera, shape in shapes.items()}
        if isinstance(episodes, Trajectory):
            return _table_of_one(episodes, start, to_go), to_go
        table, to_go = episodes.table(start)
        check_finite(to_go, "returns-to-go, sums of rewards,", source)
        return table, to_go

    for episodes, (table, to_go) in _checked(trajectories, check, dropped, on_invalid):
        steps = episodes.steps if isinstance(episodes, ShortEpisodes) else episodes
        storage.append(
            {
                "observations": steps.observations,
                "actions": to_vectors(steps.actions, action_space),
                "rewards": steps.rewards,
                "returns_to_go": to_go,
                **steps.images,
            }
        )
        tables.append(table)
        start += len(steps)
    if observation_space is None or not tables:
        left = f" that could be kept of {len(dropped)} (the first: {dropped[0]})" if dropped else ""
        raise DatasetError(f"{source}: holds no episode{left}; at least one is needed.")
    tensors = storage.finish()
    table = EpisodeTable(*map(np.concatenate, zip(*tables, strict=True)))
    return tensors, table, observation_space, image_spaces or {}, (len(dropped), str(dropped[0])) if dropped else None


def _checked(
    trajectories: Iterable[Trajectory | ShortEpisodes],
    check: Callable[[Trajectory | ShortEpisodes], Checked],
    dropped: list[DatasetError],
    on_invalid: str,
) -> Iterator[tuple[Trajectory | ShortEpisodes, Checked]]:
    """
    Episodes that pass a check, each with what the check made of it; short ones together, or one by one where they do not
    pass together.

    :param dropped: list that receives the error of each other episode, where `on_invalid` is "drop"
    """
    iterator = iter(trajectories)
    while True:
        trajectory: Trajectory | ShortEpisodes | None = None  # as long as it cannot be read
        try:
            trajectory = next(iterator)
            checked = check(trajectory)
        except StopIteration:
            return
        except DatasetError as error:
            if isinstance(trajectory, ShortEpisodes):
                iterator = itertools.chain(trajectory.one_by_one(), iterator)
            elif on_invalid == "raise":
                raise
            else:
                dropped.append(error)
        else:
            yield trajectory, checked


def _table_of_one(trajectory: Trajectory, start: int, to_go: np.ndarray) -> EpisodeTable:
    """Make the table of a single episode."""
    row = (
        start,
        len(trajectory),
        to_go[0],  # the return: the sum of all rewards in float64
        trajectory.terminated,
        trajectory.truncated,
        np.nan if trajectory.success is None else float(trajectory.success),
        *moments(trajectory.observations),
        max(to_go.max(), -to_go.min()),
    )
    return EpisodeTable(*(np.array([value]) for value in row))
