"""Evaluation on fixed initial states: before, during and after training."""

import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from rl_zoo3.utils import create_test_env
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.rows import Row, RowError, RunKey, read_rows, write_row
from sb3_dtfm.envs.cameras import images_on_demand
from sb3_dtfm.envs.seeding import warn_of_seeds
from sb3_dtfm.envs.success import reported_success
from sb3_dtfm.files import replacing
from sb3_dtfm.zoo.comparison import RandomActions

# First seeds of the two sets of initial states: apart from each other, and from those of recordings, which count from 0.
TRAINING_STATES = 1_000_000
FINAL_STATES = 2_000_000
# A run prints these for the grid that reads its output: steps done, steps in all, what it is doing.
PROGRESS = re.compile(r"step (\d+) of (\d+): (.*)\n")
PROGRESS_INTERVAL = 0.5  # seconds
TIMED_BLOCKS, TIMED_ACTIONS = 8, 16
FIRST_KEY = '{"task"'  # begins each line of rows
N_RANDOM_EPISODES = 10  # their mean return scores 0


class Episodes(NamedTuple):
    """
    Results of n episodes, in the order of their seeds.

    :param returns: returns in environment reward units
    :param lengths: lengths in environment steps
    :param successes: whether each episode succeeded; None where the task does not tell
    """

    returns: list[float]
    lengths: list[int]
    successes: list[bool] | None


class SeededEpisodes(gym.Wrapper):
    """
    Each episode starts from the seed that was set for it, and after the last one of these the environment rests.

    A vector environment resets by itself and without a seed; the start of an episode would then depend on those before it.
    It also steps all of its environments, even those that are done. One that rests stands at a start.

    The first environment of its kind is reset twice, and a warning says so if it does not start from its seed.
    """

    passes_images = True  # see :func:`~sb3_dtfm.envs.cameras.images_on_demand`
    _checked: ClassVar[set[type]] = set()

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._seeds: list[int] | None = None  # none set yet
        self._start: tuple[Any, dict[str, Any]] | None = None
        self._rests = False

    def set_episode_seeds(self, seeds: Sequence[int]) -> None:
        """
        :param seeds: seeds of the next episodes
        """
        self._seeds = list(seeds)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._rests = self._seeds == []
        if not self._rests or self._start is None:
            seed = self._seeds.pop(0) if self._seeds else seed
            if seed is not None and type(self.unwrapped) not in self._checked:
                self._checked.add(type(self.unwrapped))
                warn_of_seeds(self.env, "models are compared from different states", seed)
            self._start = self.env.reset(seed=seed, options=options)
        return self._start

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self._rests:
            assert self._start is not None
            return self._start[0], 0.0, False, False, {}
        return self.env.step(action)


def make_seeded_envs(env_id: str, settings: dict[str, Any], n_envs: int, subprocesses: bool = False) -> VecEnv:
    """
    Environments as RL-Zoo makes them for a training run, in :class:`SeededEpisodes`.

    :param env_id: Gymnasium id
    :param settings: settings of the run; `env_wrapper`, `vec_env_wrapper` and `env_kwargs` count
    :param n_envs: number of environments side by side
    :param subprocesses: whether each environment has a process of its own
    """
    wrappers = settings.get("env_wrapper") or []
    wrappers = [*(wrappers if isinstance(wrappers, list) else [wrappers]), SeededEpisodes]
    hyperparams = {key: settings[key] for key in ("vec_env_wrapper",) if settings.get(key)}
    return create_test_env(
        env_id,
        n_envs=n_envs,
        should_render=False,
        hyperparams={**hyperparams, "env_wrapper": wrappers},
        env_kwargs=settings.get("env_kwargs"),
        vec_env_cls=SubprocVecEnv if subprocesses else DummyVecEnv,
    )


def evaluate(
    model: BaseAlgorithm, vec_env: VecEnv, seeds: Sequence[int], after_step: Callable[[int], None] | None = None
) -> Episodes:
    """
    Play one episode from each seed, acting deterministically.

    Environment i plays the episodes i, i + n, i + 2n, ... to their ends: each counts once, however long it is.

    :param model: model that acts
    :param vec_env: environments in :class:`SeededEpisodes`
    :param seeds: seed of each episode
    :param after_step: function called with the number of finished episodes after each step
    """
    n_envs, n_episodes = vec_env.num_envs, len(seeds)
    playing = np.arange(n_envs)  # which episode each environment is in
    for i in range(n_envs):
        vec_env.env_method("set_episode_seeds", list(seeds[i::n_envs]), indices=i)
    observations, state, starts = vec_env.reset(), None, np.ones(n_envs, bool)
    returns, lengths = np.zeros(n_envs), np.zeros(n_envs, int)
    results: dict[int, tuple[float, int, Any]] = {}
    looks_next = getattr(getattr(model, "policy", None), "looks_next", None)
    with images_on_demand(vec_env) as draw:
        while len(results) < n_episodes:
            actions, state = model.predict(observations, state, starts, deterministic=True)  # type: ignore[arg-type]
            if looks_next is not None:
                draw(looks_next(state))
            observations, rewards, starts, infos = vec_env.step(actions)
            returns, lengths = returns + rewards, lengths + 1
            for i in np.flatnonzero(starts):
                if playing[i] < n_episodes:
                    results[int(playing[i])] = (round(float(returns[i]), 4), int(lengths[i]), reported_success(infos[i]))
                playing[i] += n_envs
            returns[starts], lengths[starts] = 0.0, 0
            if after_step is not None:
                after_step(len(results))
    all_returns, all_lengths, successes = map(list, zip(*(results[episode] for episode in range(n_episodes)), strict=True))
    return Episodes(all_returns, all_lengths, None if None in successes else successes)


def action_ms(model: BaseAlgorithm, vec_env: VecEnv, seed: int) -> float:
    """
    Milliseconds of an action in one environment: the median of the means over blocks of actions, from an episode's start on.

    Only the first action of an executed chunk takes time, hence the means; other jobs interrupt, hence the median.

    :param model: model that acts, deterministically
    :param vec_env: environments in :class:`SeededEpisodes`, the first of which acts
    :param seed: seed of the episode
    """
    for i in range(vec_env.num_envs):
        vec_env.env_method("set_episode_seeds", [seed] * (TIMED_BLOCKS * TIMED_ACTIONS if i == 0 else 0), indices=i)
    observations, state, starts = vec_env.reset(), None, np.ones(1, bool)
    times = []
    for _ in range(TIMED_BLOCKS * TIMED_ACTIONS):
        seen: Any = observations
        first = seen[:1] if isinstance(seen, np.ndarray) else {key: value[:1] for key, value in seen.items()}
        start = time.perf_counter()
        actions, state = model.predict(first, state, starts, deterministic=True)
        times.append(time.perf_counter() - start)
        observations, _, dones, _ = vec_env.step(np.repeat(actions, vec_env.num_envs, axis=0))
        starts = dones[:1]
    return 1e3 * float(np.median(np.reshape(times, (TIMED_BLOCKS, TIMED_ACTIONS)).mean(axis=1)))


class EvaluationCallback(BaseCallback):
    """
    Evaluate before the first gradient step, every `eval_freq` of them and after the last one, and write a row each time;
    after the last one also on initial states of its own, by which no model was chosen, beside random actions.

    A YAML file of RL-Zoo may name it under `callback:`; all arguments are plain data.

    :param rows: JSONL file to append to
    :param row: content that all rows share: the run, `settings` and `data`, see :mod:`~sb3_dtfm.benchmark.rows`
    :param eval_freq: number of gradient steps between two evaluations
    :param n_episodes: number of episodes of each
    :param n_final_episodes: number of episodes of the last one, on the other initial states
    :param n_envs: number of environments side by side
    :param subprocesses: whether each environment has a process of its own
    :ivar on_evaluation_step: function called after each step of an evaluation but the first two; an exception of it ends the
        evaluation, which a resumed run repeats
    """

    def __init__(
        self,
        rows: str,
        row: Row,
        eval_freq: int,
        n_episodes: int,
        n_final_episodes: int,
        n_envs: int = 1,
        subprocesses: bool = False,
    ) -> None:
        super().__init__()
        self.rows = Path(rows)
        self.row = {**row, "commit": provenance.commit(), "versions": provenance.versions()}
        self.eval_freq = eval_freq
        self.n_episodes = n_episodes
        self.n_final_episodes = n_final_episodes
        self.n_envs = n_envs
        self.subprocesses = subprocesses
        self.on_evaluation_step: Callable[[], None] = lambda: None
        self._is_timed = False
        self._resumed, self._training_seconds, self._reported = 0.0, 0.0, 0.0

    def _init_callback(self) -> None:
        env_id = self.row.get("env_id", self.row["task"])
        self.vec_env = make_seeded_envs(env_id, self.row["settings"], self.n_envs, self.subprocesses)

    def _on_training_start(self) -> None:
        self._resumed = time.perf_counter()
        if self.num_timesteps == 0:
            self._own_rows()  # rows of an attempt that was killed before its first checkpoint, and nothing else
            self.rows.unlink(missing_ok=True)
            self._evaluate(final=False)
        else:
            self._evaluate_missing(self._restore_rows())

    def _restore_rows(self) -> list[Row]:
        """Keep an interrupted run's rows up to its checkpoint; steps behind the last row took as long as those before it."""
        rows = [row for row in self._own_rows() if row["step"] <= self.num_timesteps]
        with replacing(self.rows) as beside:
            for row in rows:
                write_row(beside, row)
        timed = next((row for row in reversed(rows) if row["step"] > 0), None)
        self._is_timed = timed is not None
        self._training_seconds = timed["wall_s"] * self.num_timesteps / timed["step"] if timed else 0.0
        return rows

    def _own_rows(self) -> list[Row]:
        """
        The rows that are there.

        :raises RowError: a file that holds something else
        """
        if not self.rows.exists():
            return []
        if not self.rows.is_file():
            raise RowError(f"{self.rows}: is no file; expected rows of this run.")
        rows = read_rows(self.rows, torn_end=True)
        torn = not rows and self.rows.stat().st_size > 0
        with self.rows.open(errors="replace") as file:
            begins_as_row = file.read(len(FIRST_KEY)) == FIRST_KEY
        if any(RunKey.of(row) != RunKey.of(self.row) for row in rows) or (torn and not begins_as_row):
            raise RowError(f"{self.rows}: holds something else; expected rows of this run.")
        return rows

    def _on_step(self) -> bool:
        self._report("training")
        self._evaluate_missing([])
        return True

    def _evaluate_missing(self, rows: Sequence[Row]) -> None:
        """:param rows: rows of evaluations that need no repetition"""
        last = self.num_timesteps == self.model._total_timesteps
        there = {row["final"] for row in rows if row["step"] == self.num_timesteps}
        if (last or self.num_timesteps % self.eval_freq == 0) and False not in there:
            self._evaluate(final=False)
        if last and True not in there:
            self._evaluate(final=True)

    def _on_training_end(self) -> None:
        self.vec_env.close()

    def _evaluate(self, final: bool) -> None:
        self._training_seconds += time.perf_counter() - self._resumed
        first, n_episodes = (FINAL_STATES, self.n_final_episodes) if final else (TRAINING_STATES, self.n_episodes)
        what = f"{'final ' if final else ''}evaluation"
        seeds = range(first, first + n_episodes)

        def after_step(n_done: int) -> None:
            if self._is_timed:  # or a resumed run would not know how long its steps took
                self.on_evaluation_step()
            self._report(f"{what} {n_done}/{n_episodes}")

        episodes = evaluate(self.model, self.vec_env, seeds, after_step)
        acting: Row = getattr(self.model.policy, "acting_settings", dict)()  # SB3's algorithms have none
        evaluation: Row = dict(
            step=self.num_timesteps,
            final=final,
            **episodes._asdict(),
            flow_solver=acting.get("flow_solver"),
            flow_steps=acting.get("flow_steps"),
            wall_s=round(self._training_seconds, 3),
            steps_per_s=round(self.num_timesteps / self._training_seconds, 3),
            hardware=provenance.hardware(self.model.device),
        )
        if final:
            evaluation["action_ms"] = round(action_ms(self.model, self.vec_env, first), 3)
            if episodes.successes is None:
                evaluation["data"] = {**self.row["data"], "random_return": self._random_return()}
        write_row(self.rows, {**self.row, **evaluation})
        self._is_timed = self.num_timesteps > 0
        self._resumed = time.perf_counter()

    def _random_return(self) -> float:
        """Mean return of random actions, which scores 0 where the task does not report success."""
        random: Any = RandomActions(self.vec_env, seed=0)
        seeds = range(FINAL_STATES, FINAL_STATES + N_RANDOM_EPISODES)
        return round(float(np.mean(evaluate(random, self.vec_env, seeds).returns)), 4)

    def _report(self, what: str) -> None:
        """
        Say how far the run is. If the grid that reads it is gone, the pipe is broken, and the run ends.

        :raises BrokenPipeError: the grid is gone
        """
        if time.monotonic() - self._reported >= PROGRESS_INTERVAL:
            self._reported = time.monotonic()
            print(f"step {self.num_timesteps} of {self.model._total_timesteps}: {what}", flush=True)
