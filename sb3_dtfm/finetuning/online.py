"""Fine-tuning of a DTFM by rounds of filtered imitation."""

import time
from collections.abc import Iterator, Sequence
from os import PathLike
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_dtfm.algorithms import DTFM
from sb3_dtfm.algorithms.loading import SAVED
from sb3_dtfm.arguments import POSITIVE, Rule, check_arguments, whole_timesteps
from sb3_dtfm.data import Trajectory, TrajectoryBuffer, load_dataset
from sb3_dtfm.data.buffer import with_npz
from sb3_dtfm.distributed import DataParallel, n_processes
from sb3_dtfm.envs import OBSERVATION, return_to_go_space
from sb3_dtfm.envs.success import reported_success
from sb3_dtfm.optimization import OWN_BATCHES, RunningMeans
from sb3_dtfm.policies.context import Context
from sb3_dtfm.transitions import Transitions
from sb3_dtfm.windows import Windows

SelfOnlineDTFM = TypeVar("SelfOnlineDTFM", bound="OnlineDTFM")

ACCEPTED: dict[str, Rule] = {
    "n_episodes": SAVED["n_episodes"],
    "gradient_steps": SAVED["gradient_steps"],
}


def joined(batches: Sequence[Any]) -> Any:
    """Windows, or transitions, of several batches one after the other."""

    def join(parts: tuple[Any, ...]) -> Any:
        if not isinstance(parts[0], dict):
            return th.cat(parts)
        return {name: th.cat([part[name] for part in parts]) for name in parts[0]}

    return type(batches[0])(*map(join, zip(*batches, strict=True)))


class Step(NamedTuple):
    """
    A step of all environments.

    :param observations: (B, O), as the environments gave them
    :param actions: (B, A) in the environments' range, or choices (B,)
    :param rewards: rewards (B,), environment reward units
    :param images: images by camera, (B, channels, height, width) or channels last
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    images: dict[str, np.ndarray]


class OnlineDTFM(DTFM):
    """
    A DTFM that is fine-tuned by filtered imitation: of its dataset, and of its own episodes that succeeded.

    It acts from fresh noise, so that no two rollouts are alike; successes are imitated, and become more frequent.
    If the environment tells of no success, an episode is imitated that returned at least as much as the average of
    dataset and own episodes so far. With a critic (`critic_steps` among the `policy_kwargs`) all episodes teach the critic,
    failures too, and the critic chooses among `n_action_samples` draws.

    `learn(total_timesteps)` counts the environments' steps, as online algorithms do. The model stays a DTFM and is saved as
    one: `OnlineDTFM.load("can.zip", env, dataset="can.hdf5")` goes on from a DTFM, and `DTFM.load` reads what it saves.

    :param n_episodes: number of own episodes in a round, of all environments together
    :param gradient_steps: number of gradient steps in a round, over which `learning_rate_schedule` and `warmup_steps` go
    :ivar replay_buffer: all own episodes, None before the first ones
    """

    progress_bar_class = ProgressBarCallback

    def __init__(self, *args: Any, n_episodes: int = 10, gradient_steps: int = 100, **kwargs: Any) -> None:
        self.n_episodes = n_episodes
        self.gradient_steps = gradient_steps
        self.replay_buffer: TrajectoryBuffer | None = None
        self._running: list[Step] = []  # steps of the episodes that have not ended
        self._began: list[int] = []  # step in them at which each environment's episode begins
        self._state: tuple[np.ndarray, ...] | None = None  # the policy's state while acting
        self._n_left = 0  # gradient steps left of a round
        super().__init__(*args, **kwargs)

    def _check_arguments(self, learning_rate: Rule) -> None:
        super()._check_arguments(learning_rate)
        vars(self).update(check_arguments(vars(self), ACCEPTED))

    def _excluded_save_params(self) -> list[str]:
        """Add the attributes that have a file of their own, or belong to the environments."""
        return [*super()._excluded_save_params(), "replay_buffer", "_running", "_began", "_state"]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        """Set up as SB3 does, since the environments' steps count here."""
        self._check_arguments(learning_rate=POSITIVE)
        before = self._last_obs
        self._training_seconds, self._timed_steps = 0.0, 0
        total_timesteps, callback = BaseAlgorithm._setup_learn(self, *args, **kwargs)
        if self._num_timesteps_at_start == 0:
            self._means = RunningMeans()
        if self._last_obs is not before:  # they have been reset
            self._running, self._began, self._state = [], [0] * self.n_envs, None
        return total_timesteps, callback

    def _schedule_position(self) -> tuple[int, float]:
        """Each round has the whole schedule: its changes settle before the next episodes."""
        n_learned = self.gradient_steps - self._n_left
        return n_learned, n_learned / self.gradient_steps

    def learn(
        self: SelfOnlineDTFM,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOnlineDTFM:
        """
        Act and learn in rounds; callbacks run once after each step of the environments.

        :param total_timesteps: number of steps of all environments together
        :param callback: SB3 callback or list of callbacks
        :param log_interval: number of rounds between two logs, None for no logs
        :param tb_log_name: name of the run in TensorBoard, the algorithm's by default
        :param reset_num_timesteps: whether timesteps are counted from zero; otherwise they continue
        :param progress_bar: whether to show a progress bar
        :return: the model
        :raises ValueError: no dataset, no environment, or an argument out of range
        :raises FloatingPointError: the loss or its gradient is no longer finite; such a step changes no weight
        """
        total_timesteps = whole_timesteps(total_timesteps, reset_num_timesteps)
        if self.env is None:
            raise ValueError("OnlineDTFM has no environment to act in: load(path, env, dataset=...) or set_env().")
        self._check_online(self.env)
        if self.buffer is None:
            self._load_buffer()
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        parallel = DataParallel(self.policy, self._loss_function(), self.batch_size)
        self._training_seed = self._choose_training_seed()
        callback.on_training_start(locals(), globals())
        if self._n_left and self.replay_buffer is not None:  # the rest of a round that was interrupted
            self._imitate(parallel, min(self._n_left, self.gradient_steps))
        n_rounds = 0
        while self.num_timesteps < total_timesteps:
            # Before a round: rounds end with an episode, so the last one goes beyond the steps that were asked for.
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            if not self._collect(callback):
                break
            self._imitate(parallel, self.gradient_steps)
            n_rounds += 1
            if log_interval and n_rounds % log_interval == 0:
                self.dump_logs()
        self._check_finite(self._means.sums(), self._means.n_values)
        callback.on_training_end()
        return self

    @staticmethod
    def _check_online(env: VecEnv) -> None:
        """
        :raises ValueError: several processes, or rewards that are not the environment's
        """
        if n_processes() > 1:
            raise ValueError(
                f"OnlineDTFM learns in one process, not in {n_processes()}; its environments may have their own."
            )
        vec_normalize = unwrap_vec_normalize(env)
        if vec_normalize is not None and vec_normalize.norm_reward:
            raise ValueError(
                "VecNormalize(norm_reward=True) would change the returns of own episodes; use norm_reward=False."
            )

    def _collect(self, callback: BaseCallback) -> bool:
        """
        Act until `n_episodes` have ended; those that run then go on the next time.

        :return: False where a callback ends the training
        """
        assert self.env is not None
        n_ended, goes_on = 0, True
        callback.on_rollout_start()
        while goes_on and n_ended < self.n_episodes:
            observations: Any = self._last_obs
            actions, self._state = self.policy.predict(observations, self._state, self._last_episode_starts)
            self._last_obs, rewards, dones, infos = self.env.step(actions)  # type: ignore[assignment]
            self._last_episode_starts = dones
            images = {camera: observations[camera] for camera in self.policy.image_spaces}
            self._running.append(Step(observations[OBSERVATION], actions, rewards, images))
            self._update_info_buffer(infos, dones)
            if dones.any():  # at once, so that a checkpoint has all
                self._keep([self._take(row, infos[row]) for row in np.flatnonzero(dones)])
                n_ended += int(dones.sum())
            self.num_timesteps += self.n_envs
            callback.update_locals(locals())
            goes_on = callback.on_step()
        callback.on_rollout_end()
        n_past = min(self._began)
        self._running, self._began = self._running[n_past:], [began - n_past for began in self._began]
        return goes_on

    def _take(self, row: int, info: dict[str, Any]) -> Trajectory:
        """The episode that an environment has just ended."""
        steps = self._running[self._began[row] :]
        self._began[row] = len(self._running)
        truncated = bool(info.get("TimeLimit.truncated", False))
        return Trajectory(
            observations=np.stack([step.observations[row] for step in steps]),
            actions=np.stack([step.actions[row] for step in steps]),
            rewards=np.stack([step.rewards[row] for step in steps]),
            terminated=not truncated,
            truncated=truncated,
            success=reported_success(info),
            images={camera: np.stack([step.images[camera][row] for step in steps]) for camera in self.policy.image_spaces},
        )

    def _keep(self, episodes: list[Trajectory]) -> None:
        """Put own episodes behind the earlier ones."""
        assert self.buffer is not None
        known = (self.action_space, self.buffer.observation_space)
        new = TrajectoryBuffer.from_trajectories(episodes, *known, source="own episodes", env_id=self.buffer.env_id)
        if self.replay_buffer is not None:
            new = TrajectoryBuffer.join([self.replay_buffer, new], [1.0, 1.0])
        self.replay_buffer = new.to(self.device)

    def save_replay_buffer(self, path: str | PathLike[str]) -> None:
        """
        Write the own episodes as flat arrays, which `dataset=` takes, too.

        :param path: path of the file; `.npz` is added if it is missing
        :raises ValueError: there are none yet
        :raises OSError: it cannot be written
        """
        if self.replay_buffer is None:
            raise ValueError("There are no own episodes to save yet.")
        self.replay_buffer.save(path)

    def load_replay_buffer(self, path: str | PathLike[str], truncate_last_traj: bool = True) -> None:
        """
        Take up own episodes of an earlier run.

        :param path: path that :meth:`save_replay_buffer` was given
        :param truncate_last_traj: SB3's argument, which changes nothing: episodes that had not ended are not in the file
        :raises DatasetError: it cannot be read, or does not fit the model
        """
        path = with_npz(path)
        own = load_dataset(path, action_space=self.action_space)
        observed = return_to_go_space(own.observation_space, own.image_spaces)
        self._check_spaces(observed, own.action_space, f"{path} holds", "the model's are")
        self.replay_buffer = own.to(self.device)

    def _imitate(self, parallel: DataParallel, n_steps: int) -> None:
        """
        Take the gradient steps of a round, and drop the keys and values that acting has cached with the old weights.

        :param n_steps: number of gradient steps, less than `gradient_steps` where some were taken before an interrupt
        """
        batches = self._imitated()
        self._n_left = n_steps
        while self._n_left:
            self.train(batches, parallel)
            self._n_left -= 1
        if self._state is not None:
            context = Context(*self._state)
            self._state = tuple(context._replace(keys_values=np.zeros((len(context.mask), 0), np.float32)))

    def _imitated(self) -> Iterator[Windows]:
        """Batches of the dataset and of the own episodes that are worth imitating."""
        assert self.buffer is not None
        assert self.replay_buffer is not None
        average = np.concatenate([self.buffer.episode_returns, self.replay_buffer.episode_returns]).mean()
        successes, returns = self.replay_buffer.successes, self.replay_buffer.episode_returns
        worthy = np.flatnonzero(np.where(np.isnan(successes), returns >= average, successes == 1.0))
        imitated = self.replay_buffer.select(worthy) if len(worthy) else None
        n_expected = self.policy.options.expected_return_steps
        if imitated is not None and n_expected:
            imitated = imitated.to("cpu").with_expected_returns(n_expected).to(self.device)
        n_own = self._n_own(imitated, self.batch_size) if imitated is not None else 0
        streams = [self._batches(self.buffer, self.batch_size - n_own)] if n_own < self.batch_size else []
        if imitated is not None:
            streams.append(self._batches(imitated, n_own, OWN_BATCHES))
        return (joined(batches) for batches in zip(*streams, strict=True))

    def _n_own(self, own: TrajectoryBuffer, batch_size: int) -> int:
        """Return how many of a batch are from own episodes, so that their steps count as much as the dataset's."""
        assert self.buffer is not None
        share = len(own) / (len(own) + len(self.buffer))
        return max(round(share * batch_size), 1)

    def _sample_transitions(self, batch_size: int, generator: th.Generator) -> Transitions:
        """Draw steps of all episodes, as many of own ones as are imitated."""
        if self.replay_buffer is None:
            return super()._sample_transitions(batch_size, generator)
        n_own = self._n_own(self.replay_buffer, batch_size)
        own = self.replay_buffer.sample_transitions(n_own, self.policy.critic_horizon, self.policy.options.gamma, generator)
        if n_own == batch_size:
            return own
        others = super()._sample_transitions(batch_size - n_own, generator)
        return joined((others, own))

    def _name_steps(self, n_steps: int) -> str:
        return (
            f"within {n_steps} steps to gradient step {self._n_updates} of this model, on its dataset and its own episodes"
        )

    def dump_logs(self) -> None:
        """Log what SB3's online algorithms do, and the means since the last call."""
        seconds = max((time.time_ns() - self.start_time) / 1e9, 1e-9)
        self.logger.record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / seconds))
        if self.ep_info_buffer:
            self.logger.record("rollout/ep_rew_mean", safe_mean([each["r"] for each in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([each["l"] for each in self.ep_info_buffer]))
        if self.ep_success_buffer:
            self.logger.record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        super().dump_logs()
