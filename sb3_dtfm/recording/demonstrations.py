"""Records scripted demonstrations of robosuite tasks into a robomimic hdf5 file."""

import multiprocessing
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from tqdm import tqdm

from sb3_dtfm.data.robomimic import DEFAULT_OBSERVATION_KEYS, RecordedEpisode, RobomimicWriter, refuse_existing
from sb3_dtfm.envs.robosuite import TASKS as ROBOSUITE_TASKS
from sb3_dtfm.envs.robosuite import RobosuiteEnv
from sb3_dtfm.recording.episodes import check_recording

TASKS = {name.lower(): name for name, row in ROBOSUITE_TASKS.items() if row.demonstrator is not None}
ROBOT_COLUMNS = (3, 4, 2)  # widths of the observation keys before the object's
ATTEMPTS_PER_EPISODE = 5  # a demonstrator that fails more often than this is broken


class RecordingSummary(NamedTuple):
    """
    What a recording has come to.

    :param path: the file
    :param n_episodes: successful episodes recorded
    :param n_attempts: episodes tried up to the last one recorded
    :param mean_length: of the recorded episodes, steps
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
            f"attempts succeeded, mean length {self.mean_length:.0f} steps, {self.seconds:.0f} s"
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
) -> RecordingSummary:
    """
    Let a scripted demonstrator do a task until it has succeeded `n_episodes` times, and write those episodes.

    The file depends on the task, the number of episodes, seed, noise and pause only: attempt i draws everything from
    (seed, i), and the first successes in the order of attempts are kept, whatever the number of workers.

    :param task: "lift" or "can"
    :param n_episodes: successful episodes to record
    :param output: the hdf5 file; it appears under this name when it is complete
    :param seed: of starts and demonstrators
    :param n_workers: processes to simulate in; the number of CPU cores by default, and 1 stays in this process
    :param overwrite: replace an existing file
    :param progress: show a progress bar with the success rate
    :param noise: standard deviation of Gaussian noise on the actions, as a share of the action range (2); the sum is
        clipped into the action space, and what is recorded is what was executed
    :param pause: steps that the hand rests before it closes, on average and after a first one; geometrically distributed,
        and 0 closes at once
    :raises FileExistsError: `output` exists and is not to be overwritten
    """
    if task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(map(repr, TASKS))}, got {task!r}.")
    check_recording(n_episodes, noise)
    if not 0.0 <= pause < np.inf:
        raise ValueError(f"pause must be a number of steps, 0 or more, got {pause}.")
    refuse_existing(Path(output), overwrite)
    start = time.monotonic()
    n_workers = min(n_workers or _n_cores(), n_episodes)
    env = _environment(task)
    lengths: list[int] = []
    n_attempts = 0
    limit = n_episodes * ATTEMPTS_PER_EPISODE + 10
    with (
        RobomimicWriter(output, env.env_args, overwrite, seed) as writer,
        closing(_attempts(partial(_attempt, task, seed, noise, pause), n_workers, limit)) as attempts,
    ):
        with tqdm(total=n_episodes, desc=f"Recording {task}", unit="episode", disable=not progress) as bar:
            for episode in attempts:
                n_attempts += 1
                if episode is not None:
                    writer.add(episode)
                    lengths.append(len(episode.actions))
                bar.set_postfix(success=f"{100 * len(lengths) / n_attempts:.0f}%", refresh=False)
                bar.update(episode is not None)
                if len(lengths) == n_episodes:
                    break
        if len(lengths) < n_episodes:
            raise RuntimeError(
                f"Only {len(lengths)} of {n_attempts} demonstrations of {task} succeeded; nothing is written."
            )
    return RecordingSummary(Path(output), n_episodes, n_attempts, float(np.mean(lengths)), time.monotonic() - start)


def _n_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _attempts(
    attempt: Callable[[int], RecordedEpisode | None], n_workers: int, limit: int
) -> Generator[RecordedEpisode | None, None, None]:
    """Episodes in the order of attempts, None for a failed one."""
    if n_workers == 1:
        yield from map(attempt, range(limit))
        return
    # Linux forks: the workers then share what is imported already, and scripts need no __main__ guard.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else None)
    executor = ProcessPoolExecutor(n_workers, mp_context=context)
    pending: deque[Future[RecordedEpisode | None]] = deque()
    try:
        for number in range(limit):
            pending.append(executor.submit(attempt, number))
            if len(pending) > 2 * n_workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        executor.shutdown(cancel_futures=True)


_environments: dict[str, RobosuiteEnv] = {}  # one of each task per process: compiling the scene takes longer than an episode


def _environment(task: str) -> RobosuiteEnv:
    if task not in _environments:
        _environments[task] = RobosuiteEnv(TASKS[task])
    return _environments[task]


def _attempt(task: str, seed: int, noise: float, pause: float, attempt: int) -> RecordedEpisode | None:
    """One episode, None if it does not succeed."""
    env = _environment(task)
    env_seed, demonstrator_seed, noise_seed = np.random.SeedSequence((seed, attempt)).generate_state(3)
    space, noise_rng = env.action_space, np.random.default_rng(int(noise_seed))
    assert isinstance(space, spaces.Box)
    scale = noise * (space.high - space.low)
    demonstrator_class = ROBOSUITE_TASKS[TASKS[task]].demonstrator
    assert demonstrator_class is not None
    demonstrator = demonstrator_class(int(demonstrator_seed), pause)
    observation, _ = env.reset(seed=int(env_seed))
    observations, actions, states = [observation], [], []
    terminated = truncated = False
    while not (terminated or truncated):
        action = demonstrator.act(observation) + scale * noise_rng.standard_normal(space.shape)
        actions.append(np.clip(action, space.low, space.high).astype(space.dtype))
        states.append(env.state)
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        observations.append(observation)
    if not terminated:
        return None
    columns = np.split(np.stack(observations), np.cumsum(ROBOT_COLUMNS), axis=1)
    rewards = np.zeros(len(actions))
    rewards[-1] = 1.0
    return RecordedEpisode(
        observations=dict(zip(DEFAULT_OBSERVATION_KEYS, columns, strict=True)),
        actions=np.stack(actions),
        rewards=rewards,
        states=np.stack(states),
        model_file=env.model_file,
    )
