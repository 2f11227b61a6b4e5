"""Recording scripted demonstrations of robosuite tasks into a robomimic hdf5 file."""

import functools
import itertools
import multiprocessing
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from tqdm import tqdm

from sb3_dtfm.envs.robosuite import TASKS, RobosuiteEnv
from sb3_dtfm.envs.robosuite.cameras import camera_args
from sb3_dtfm.envs.robosuite.demonstrators import Demonstrator
from sb3_dtfm.recording.episodes import EpisodeRecorder, RecordedEpisode, add_noise, check_recording, run_episodes
from sb3_dtfm.recording.robomimic import refuse_existing, write_robomimic

ATTEMPTS_PER_EPISODE = 5  # a demonstrator that fails more often than this is broken


def demonstrated_tasks() -> dict[str, tuple[str, type[Demonstrator]]]:
    """The robosuite tasks that a script can do, by their name in lower case: the name, and the script."""
    return {name.lower(): (name, row.demonstrator) for name, row in TASKS.items() if row.demonstrator is not None}


class RecordingSummary(NamedTuple):
    """
    Result of a recording.

    :param path: the file
    :param n_episodes: successful episodes recorded
    :param n_attempts: episodes tried up to the last one recorded
    :param mean_length: mean length of the recorded episodes, steps
    :param seconds: wall-clock time
    """

    path: Path
    n_episodes: int
    n_attempts: int
    mean_length: float
    seconds: float

    @property
    def success_rate(self) -> float:
        return self.n_episodes / self.n_attempts

    def __str__(self) -> str:
        return (
            f"{self.n_episodes} demonstrations in {self.path}: {100 * self.success_rate:.0f} % of {self.n_attempts} "
            f"episodes succeeded, mean length {self.mean_length:.0f} steps, {self.seconds:.0f} s"
        )


def record_demonstrations(
    task: str,
    n_episodes: int,
    output: str | os.PathLike[str],
    seed: int = 0,
    n_workers: int | None = None,
    overwrite: bool = False,
    progress: bool = True,
    noise: float = 0.0,
    pause: float = 0.0,
    cameras: Sequence[str] = (),
    camera_size: int = 84,
) -> RecordingSummary:
    """
    Let a scripted demonstrator do a task until it has succeeded `n_episodes` times, and write those episodes.

    The file depends on the task, the number of episodes, seed, noise and pause only: attempt i draws everything from
    (seed, i), and the first successes in the order of attempts are kept, whatever the number of workers.

    :param task: name of the task, one of :func:`demonstrated_tasks`
    :param n_episodes: successful episodes to record
    :param output: the hdf5 file; it appears under this name when it is complete
    :param seed: seed of initial states and demonstrators
    :param n_workers: processes to simulate in; the number of CPU cores by default, and 1 stays in this process
    :param overwrite: replace an existing file
    :param progress: show a progress bar with the success rate
    :param noise: standard deviation of Gaussian noise on the actions, as a share of the action range (2); the sum is
        clipped into the action space, and what is recorded is what was executed
    :param pause: steps that the hand rests before it closes, on average and after a first one; geometrically distributed,
        and 0 closes at once
    :param cameras: names of the cameras whose images are recorded beside the numbers, see
        :class:`~sb3_dtfm.envs.robosuite.RobosuiteEnv`
    :param camera_size: height and width of these images, pixels
    :raises FileExistsError: `output` exists and is not to be overwritten
    :raises ValueError: unknown task, numbers out of range, or fewer than one episode in 5 succeeds
    """
    if task not in demonstrated_tasks():
        raise ValueError(f"task must be one of {', '.join(map(repr, demonstrated_tasks()))}, got {task!r}.")
    check_recording(n_episodes, noise, seed)
    if n_workers is not None and n_workers < 1:
        raise ValueError(f"n_workers must be at least 1, got {n_workers}.")
    if not 0.0 <= pause < np.inf:
        raise ValueError(f"pause must be a number of steps, 0 or more, got {pause}.")
    refuse_existing(Path(output), overwrite)
    start = time.monotonic()
    n_workers = min(n_workers or _n_cores(), n_episodes)
    scene = (task, tuple(cameras), camera_size)
    # Before the workers fork, which then have the compiled scene too; but nothing to draw with, which would hang there.
    env_args = _environment(task, (), camera_size).env_args
    env_args["env_kwargs"] |= camera_args(cameras, camera_size)
    attempt = functools.partial(_attempt, scene, seed, noise, pause)
    lengths: list[int] = []
    n_attempts = 0

    def successes(attempts: Iterable[RecordedEpisode]) -> Iterator[RecordedEpisode]:
        nonlocal n_attempts
        with tqdm(total=n_episodes, desc=f"Recording {task}", unit="episode", disable=not progress) as bar:
            for n_attempts, episode in enumerate(attempts, start=1):
                if episode.terminated:
                    lengths.append(len(episode.actions))
                    yield episode
                bar.set_postfix(success=f"{100 * len(lengths) / n_attempts:.0f}%", refresh=False)
                bar.update(episode.terminated)
                if len(lengths) == n_episodes:
                    return
        raise ValueError(
            f"Only {len(lengths)} of {n_attempts} demonstrations of {task} succeeded with noise {noise:g} and pause "
            f"{pause:g}; nothing is written."
        )

    with closing(_run(attempt, n_workers, n_episodes)) as attempts:
        write_robomimic(output, successes(attempts), env_args, seed)
    if cameras and n_workers == 1:  # MuJoCo complains of what is still open when Python ends
        _environment(*scene).close()
        _environment.cache_clear()
    return RecordingSummary(Path(output), n_episodes, n_attempts, float(np.mean(lengths)), time.monotonic() - start)


def _n_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _run(
    attempt: Callable[[int], RecordedEpisode], n_workers: int, n_episodes: int
) -> Generator[RecordedEpisode, None, None]:
    """Return episodes in their order: `n_episodes`, and another for each failed one, so that none is simulated in vain."""
    numbers = iter(range(n_episodes * ATTEMPTS_PER_EPISODE + 10))
    if n_workers == 1:
        yield from map(attempt, numbers)
        return
    # Linux forks: the workers then share what is imported already, and scripts need no __main__ guard.
    executor = ProcessPoolExecutor(n_workers, multiprocessing.get_context("fork" if sys.platform == "linux" else None))
    try:
        futures = deque(executor.submit(attempt, number) for number in itertools.islice(numbers, n_episodes))
        while futures:
            episode = futures.popleft().result()
            if not episode.terminated and (number := next(numbers, None)) is not None:
                futures.append(executor.submit(attempt, number))
            yield episode
    finally:
        executor.shutdown(cancel_futures=True)


@functools.cache
def _environment(task: str, cameras: tuple[str, ...], camera_size: int) -> RobosuiteEnv:
    """One of each task per process: compiling the scene takes longer than an episode."""
    return RobosuiteEnv(demonstrated_tasks()[task][0], cameras=cameras, camera_size=camera_size, object_state=True)


def _attempt(scene: tuple[str, tuple[str, ...], int], seed: int, noise: float, pause: float, number: int) -> RecordedEpisode:
    """One episode, which has succeeded if it is terminated."""
    env = _environment(*scene)
    env_seed, demonstrator_seed, noise_seed = map(int, np.random.SeedSequence((seed, number)).generate_state(3))
    demonstrator = demonstrated_tasks()[scene[0]][1](demonstrator_seed, pause)

    def act(observations: Any, starts: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
        if isinstance(observations, dict):
            observations = np.concatenate([observations[key] for key in env.observation_keys], axis=1)
        return demonstrator.act(observations[0])[None]

    assert isinstance(env.action_space, spaces.Box)
    noisy = add_noise(act, env.action_space, noise, lambda _: np.random.default_rng(noise_seed))
    episode = next(run_episodes([EpisodeRecorder(env, simulation=True)], noisy, [env_seed]))
    if scene[1]:
        return episode
    widths = env.observation_keys
    ends = np.cumsum(list(widths.values()))[:-1]
    by_key = [dict(zip(widths, np.split(observation, ends), strict=True)) for observation in episode.observations]
    return replace(episode, observations=by_key)
