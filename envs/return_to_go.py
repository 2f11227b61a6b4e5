"""The wrapper that shows a sequence policy its target return and its time step."""

import math
import re
import time
import warnings
from typing import Any, NamedTuple, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    is_vecenv_wrapped,
    unwrap_vec_normalize,
)

from sb3_dtfm.envs.observation_spaces import (
    IMAGE,
    OBSERVATION,
    RETURN_TO_GO,
    TIMESTEP,
    image_spaces,
    return_to_go_space,
    sort_observation_space,
    without_images,
)
from sb3_dtfm.envs.robotics import warn_of_reward
from sb3_dtfm.envs.success import reported_success

# Wrappers whose order decides whether an evaluation sees an episode's end.
WRAPPERS = ("TimeLimit", "Monitor", "ReturnToGoWrapper")
# In `info` after several actions: what was observed between them.
BETWEEN = "observations_between"
# Episodes in a row without an end, after which a warning says so.
MOST_UNFINISHED = 100


def check_target_return(target_return: float) -> float:
    """
    The target as a float.

    :param target_return: target return, environment reward units
    :raises ValueError: not a finite number, or one that float32 cannot hold
    """
    try:
        value = math.nan if isinstance(target_return, bool | str | bytes) else float(target_return)
    except (TypeError, OverflowError):
        value = math.nan
    if not abs(value) <= np.finfo(np.float32).max:
        raise ValueError(f"target_return must be a finite number of float32, got {target_return!r}.")
    return value


class Task(NamedTuple):
    """
    A registered task.

    :param env_id: Gymnasium id
    :param max_episode_steps: number of steps after which Gymnasium ends an episode; None where it does not
    """

    env_id: str
    max_episode_steps: int | None


class ReturnToGoWrapper(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """
    Adds to each observation the return still to reach and the time step.

    The return-to-go starts at the target and loses each reward: g(0) = target, g(t+1) = g(t) - r(t). It is counted in
    float64 and shown as float32, in environment reward units; scaling is the policy's business. A Dict observation
    (goal-conditioned tasks, for example) is flattened to one vector, see :func:`flatten_observation_space`; its images stay
    as they are, each by its key.

    In an environment with a time limit of T steps the return-to-go is at least target (1 - t / T). Without this bound an
    episode that is ahead of its target gets ever lower returns-to-go: a policy that leaves out its recordings' noise, and
    so returns more, then acts as a worse agent did.

    `step` also takes several actions, (N, A): they are carried out one after the other until the episode ends, rewards are
    added up, and `info` has the observations between them, stacked by key, under `BETWEEN`. So whoever decides once for
    several steps does so in each of many parallel environments at its own place in its episode.

    An episode that a wrapper between this one and a `Monitor` ends, such as a `TimeLimit`, has the `info["episode"]` that
    the Monitor would have given, for which SB3's evaluations wait; the first one does not if it was terminated, which may be
    the loss of a life. Evaluations wait for ever for episodes that a wrapper outside of this one ends: a warning says so.

    A task that tells of success by another name, as Adroit's hands do, tells it as `is_success` too, which SB3's
    `EvalCallback` and logs know.

    :param env: the environment to wrap
    :param target_return: target return of each episode, environment reward units; None takes the model's
    :param bound_return_to_go: whether to keep that bound; without it the target less the rewards is shown, as Decision
        Transformer does
    :raises ValueError: `target_return` is not a finite number, or the observation space cannot be flattened
    """

    passes_images = True  # see :func:`~sb3_dtfm.envs.cameras.images_on_demand`

    def __init__(self, env: gym.Env, target_return: float | None = None, bound_return_to_go: bool = True) -> None:
        RecordConstructorArgs.__init__(self, target_return=target_return, bound_return_to_go=bound_return_to_go)
        super().__init__(env)
        warn_of_reward(env)
        self._time_limit = env.spec.max_episode_steps if bound_return_to_go and env.spec is not None else None
        self.target_return = None if target_return is None else check_target_return(target_return)
        self.observation_space = return_to_go_space(env.observation_space)
        self._monitor: Any = unwrap_wrapper(env, Monitor)
        self._cameras = list(image_spaces(env.observation_space))
        self._vector_space = sort_observation_space(without_images(env.observation_space))
        self._episode_target = self._return_to_go = math.nan
        self._timestep = 0
        self._ended = False
        self._ends_between = False  # whether a wrapper between this one and the Monitor terminates episodes
        self._n_unfinished = 0  # episodes since the last end, or the first one

    @property
    def known_task(self) -> Task | None:
        """Gymnasium's id and time limit of the task, which pass between processes, where the whole `spec` may not."""
        return None if self.spec is None else Task(self.spec.id, self.spec.max_episode_steps)

    @property
    def env_args(self) -> dict[str, Any] | None:
        """The environment's description of itself in the words of robomimic's files; None where it has none."""
        found = getattr(self.unwrapped, "env_args", None)
        return found if isinstance(found, dict) else None

    @property
    def reader_options(self) -> dict[str, Any]:
        """
        Arguments of `load_dataset` that the environment decides: its own observation space with sorted keys, `env_args`,
        and, if it has a Gymnasium id, the time limit.
        """
        task, space = self.known_task, self.env.observation_space if self._cameras else self._vector_space
        limit = {} if task is None else {"max_episode_steps": task.max_episode_steps}
        return {"observation_space": space, "env_args": self.env_args, **limit}

    def set_target_return(self, target_return: float) -> None:
        """
        Set the target return from the next reset on; also through ``VecEnv.env_method("set_target_return", value)``.

        :param target_return: target return, environment reward units
        :raises ValueError: not a finite number
        """
        self.target_return = check_target_return(target_return)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """
        :raises ValueError: there is no target return yet
        """
        if self.target_return is None:
            raise ValueError(
                "ReturnToGoWrapper(env) has no target return yet: give it to a model, DTFM(..., env=env) or "
                "model.set_env(env), or write ReturnToGoWrapper(env, target_return=model.target_return)."
            )
        self._count_unfinished()
        unseen = self._ended and self._monitor is not None and not self._monitor.needs_reset
        observation, info = self.env.reset(seed=seed, options=options)
        if unseen and not self._monitor.rewards:  # a lost life resets nothing
            self._ends_between = True
        self._ended = False
        self._episode_target = self._return_to_go = self.target_return
        self._timestep = 0
        return self._observe(observation), info

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        if np.ndim(action) > len(self.env.action_space.shape or ()):
            return self._step_through(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._return_to_go -= float(reward)
        self._timestep += 1
        success = reported_success(info)
        if success is not None and "is_success" not in info:  # by which SB3 counts
            info = {**info, "is_success": success}
        self._ended = terminated or truncated
        counts = truncated if not terminated else self._ends_between
        if counts and self._monitor is not None and "episode" not in info:
            total, seconds = round(sum(self._monitor.rewards), 6), round(time.time() - self._monitor.t_start, 6)
            info = {**info, "episode": {"r": total, "l": len(self._monitor.rewards), "t": seconds}}
        return self._observe(observation), reward, terminated, truncated, info

    def _count_unfinished(self) -> None:
        """Warn of episodes that end outside."""
        if self._ended or self._monitor is None:
            self._n_unfinished = 0
        elif self._timestep > 0:
            self._n_unfinished += 1
            if self._n_unfinished == MOST_UNFINISHED:
                warnings.warn(
                    f"{MOST_UNFINISHED} episodes in a row were reset before ReturnToGoWrapper and Monitor saw their ends, "
                    "for which SB3's evaluations wait. If a wrapper outside ends them, put it inside: write "
                    "ReturnToGoWrapper(ItsWrapper(env)).",
                    stacklevel=3,
                )

    def _step_through(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        """:param actions: (N, A)"""
        observations, total, terminated, truncated = [], 0.0, False, False
        info: dict[str, Any] = {}
        for action in actions:
            observation, reward, terminated, truncated, info = self.step(action)
            observations.append(observation)
            total += float(reward)
            if terminated or truncated:
                break
        *between, last = observations
        info = {**info, BETWEEN: {key: np.array([each[key] for each in between]) for key in last}}
        return last, total, terminated, truncated, info

    def _observe(self, observation: Any) -> dict[str, np.ndarray]:
        return_to_go = self._return_to_go
        if self._time_limit is not None:
            return_to_go = max(return_to_go, self._episode_target * (1.0 - self._timestep / self._time_limit))
        images: dict[str, np.ndarray] = {}
        if self._cameras and isinstance(self.env.observation_space, spaces.Dict):
            images = {camera: observation[camera] for camera in self._cameras}
            observation = {key: part for key, part in observation.items() if key not in images} or np.zeros(1, np.float32)
        elif self._cameras:
            images, observation = {IMAGE: observation}, np.zeros(1, np.float32)
        return {
            **images,
            OBSERVATION: np.asarray(spaces.flatten(self._vector_space, observation)).astype(np.float32),
            RETURN_TO_GO: np.array([return_to_go], dtype=np.float32),
            TIMESTEP: np.array([self._timestep], dtype=np.int64),
        }


def check_vec_env(
    env: VecEnv,
    name: str = "The environment",
    remedy: str = "make_vec_env(env_id, n_envs, wrapper_class=ReturnToGoWrapper)",
) -> None:
    """
    Make sure that return-to-go and time step reach the policy unharmed.

    :param env: the environment
    :param name: name of the environment, for messages
    :param remedy: the line that wraps it, for messages
    :raises ValueError: no :class:`ReturnToGoWrapper` inside, or normalised or stacked observations
    """
    if not isinstance(env, VecEnv):
        raise ValueError(f"{name} is {env!r}, no vectorised environment: write {remedy}.")
    vec_normalize = unwrap_vec_normalize(env)
    if vec_normalize is not None and vec_normalize.norm_obs:
        raise ValueError(
            "VecNormalize(norm_obs=True) would rescale return_to_go and timestep; the policy normalises observations "
            "itself. Use norm_obs=False, or `normalize: false` in RL-Zoo's YAML."
        )
    if is_vecenv_wrapped(env, VecFrameStack):
        raise ValueError("VecFrameStack would mix up return_to_go and timestep; set context_length instead.")
    if not {OBSERVATION, RETURN_TO_GO, TIMESTEP} <= set(getattr(env.observation_space, "spaces", {})):
        raise ValueError(
            f"{name} must be wrapped in sb3_dtfm.envs.ReturnToGoWrapper, inside any vectorised environment: write {remedy}. "
            f"Its observation space is {env.observation_space}."
        )
    if any(kinds[:1] == ["TimeLimit"] and "Monitor" in kinds for kinds in _wrappers(env)):
        raise ValueError(
            f"{name} has its TimeLimit outside ReturnToGoWrapper and Monitor, where no evaluation sees its ends: "
            "write ReturnToGoWrapper(TimeLimit(env, max_episode_steps=N))."
        )


def _wrappers(env: VecEnv) -> list[list[str]]:
    """
    Wrappers of :data:`WRAPPERS` around each environment, from the outermost one in.

    By the names of classes: RL-Zoo replaces Gymnasium's TimeLimit by a child of it, and an environment in a process of its
    own only tells how it describes itself.
    """
    if isinstance(env.unwrapped, SubprocVecEnv):
        return [re.findall(rf"<\w*?({'|'.join(WRAPPERS)})(?=<)", each) for each in env.env_method("__str__")]
    found: list[list[str]] = []
    for each in getattr(env.unwrapped, "envs", ()):
        found.append([])
        while isinstance(each, gym.Wrapper):
            found[-1] += [base.__name__ for base in type(each).__mro__ if base.__name__ in WRAPPERS][:1]
            each = each.env
    return found


def known_task(env: VecEnv) -> Task | None:
    """Return id and time limit of the registered task behind a :class:`ReturnToGoWrapper`, else None."""
    (task,) = env.get_attr("known_task", indices=0)
    return task


def reader_options(env: VecEnv) -> dict[str, Any]:
    """
    Arguments of `load_dataset` that an environment decides: the `reader_options` of its :class:`ReturnToGoWrapper`, which
    may lack the time limit, and its action space.
    """
    (options,) = env.get_attr("reader_options", indices=0)
    return {"action_space": env.action_space, **options}


def share_target_return(env: VecEnv, target_return: float | None) -> float | None:
    """
    Set the target return of each :class:`ReturnToGoWrapper` that has none.

    :param env: vectorised environment, wrapped inside
    :param target_return: target return, environment reward units; None takes the first target that there is
    :return: the target return, None where none is known
    """
    targets = env.get_attr("target_return")
    if target_return is None:
        target_return = next((each for each in targets if each is not None), None)
    if target_return is not None:
        env.env_method("set_target_return", target_return, indices=[i for i, each in enumerate(targets) if each is None])
    return target_return
