"""The offline learn loop."""

import io
import math
import time
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import minari
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import parse_env_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import configure_logger, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.arguments import (
    BOOLEAN,
    COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    PROBABILITY_BELOW_1,
    Choice,
    Number,
    Rule,
    check_arguments,
)
from sb3_dtfm.callbacks import GradientStepProgressBar, NormalizedScoreCallback, find_eval_callbacks
from sb3_dtfm.data import DatasetError, ScoreReference, TrajectoryBuffer, check_action_space, load_dataset
from sb3_dtfm.distributed import (
    DataParallel,
    LossFunction,
    check_batch_size,
    first_of_each_machine_first,
    is_first_process,
)
from sb3_dtfm.envs import check_vec_env, return_to_go_space
from sb3_dtfm.optimization import LEARNING_RATE_SCHEDULES, PRECISIONS, RunningMeans, autocast, learning_rate_factor
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.windows import Windows

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineSequenceAlgorithm")
Dataset: TypeAlias = str | PathLike[str] | minari.MinariDataset | TrajectoryBuffer

ACCEPTED: dict[str, Rule] = {
    "batch_size": COUNT,
    "weight_decay": NOT_NEGATIVE,
    "context_length": COUNT,
    "dataset_fraction": Number(low=0, high=1, above_low=True),
    "dataset_seed": Number(low=0, whole=True),
    "timestep_exponent": POSITIVE,
    "max_grad_norm": NOT_NEGATIVE._replace(optional=True),
    "warmup_steps": Number(low=0, whole=True),
    "learning_rate_schedule": Choice(LEARNING_RATE_SCHEDULES),
    "ema_decay": PROBABILITY_BELOW_1,
    "precision": Choice(PRECISIONS),
    "compile": Choice((None, *BOOLEAN.values)),
    "seed": Number(low=0, whole=True, optional=True),
}


class OfflineSequenceAlgorithm(BaseAlgorithm):
    """
    Learn a sequence policy from recorded episodes: `learn(total_timesteps)` counts gradient steps.

    Where `torch.distributed` is initialised, its processes train one model together; callbacks, logs and `save` are those
    of process 0.

    :param policy: "MultiInputPolicy" or a policy class
    :param env: environment wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`; optional, never used for learning
    :param dataset: Minari id or dataset, path to a robomimic hdf5 file, or a :class:`~sb3_dtfm.data.TrajectoryBuffer`
    :param learning_rate: AdamW's, a number or a function of the progress remaining (from 1 to 0)
    :param batch_size: windows in a gradient step, of all processes together
    :param weight_decay: AdamW's, on weight matrices only
    :param context_length: K, steps the policy sees
    :param dataset_fraction: share of the episodes to learn from, randomly drawn
    :param dataset_seed: seed of that draw alone, so that different runs learn from the same episodes
    :param timestep_exponent: e of the time step T u^e at which windows end in an episode of T steps, for u uniform in
        [0, 1]: above 1 an episode's start, of which there is little in long episodes, is learned from more often
    :param dataset_kwargs: further arguments of :func:`~sb3_dtfm.data.load_dataset`: `{"cache_dir": folder}` for datasets
        larger than memory, `{"env_id": id}` for data that were recorded under another environment's name, and the
        reader's own, for example `{"filter_key": "train"}` for robomimic
    :param max_grad_norm: clip the gradient's norm to this; None and 0 do not clip
    :param warmup_steps: gradient steps over which the learning rate rises linearly from zero; 0 for none
    :param learning_rate_schedule: factor on the learning rate: "constant", or "linear" or "cosine" down to zero
    :param ema_decay: decay of the exponential moving average of weights that acts; 0 acts with the trained weights
    :param precision: "float32", "bfloat16" (autocast), or "auto": bfloat16 where the hardware multiplies in it
    :param compile: compile the loss with `torch.compile`; None does so on a GPU. It takes a minute, and a C++ compiler
    :param policy_kwargs: arguments of the policy, for example `embed_dim`, `n_layers`, `n_heads`, `dropout`, `kv_cache`
    :param stats_window_size: as in SB3; offline learning collects no episodes
    :param tensorboard_log: folder of the TensorBoard log, None for no log
    :param verbose: 0 silent, 1 prints the log
    :param seed: seed of weights, batches and acting
    :param device: "auto", "cpu" or "cuda"
    :param _init_setup_model: build the network at once
    :raises ValueError: no dataset, or an argument out of range
    :raises DatasetError: the dataset cannot be read, or does not fit the environment
    """

    policy: SequencePolicy
    action_space: spaces.Box

    def __init__(
        self,
        policy: str | type[SequencePolicy],
        env: GymEnv | str | None = None,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 1e-4,
        batch_size: int = 256,
        weight_decay: float = 1e-3,
        context_length: int = 20,
        dataset_fraction: float = 1.0,
        dataset_seed: int = 0,
        timestep_exponent: float = 1.0,
        dataset_kwargs: dict[str, Any] | None = None,
        max_grad_norm: float | None = None,
        warmup_steps: int = 0,
        learning_rate_schedule: str = "constant",
        ema_decay: float = 0.0,
        precision: str = "auto",
        compile: bool | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            supported_action_spaces=(spaces.Box,),
        )
        self.dataset = dataset
        self.batch_size = batch_size
        self.weight_decay = weight_decay
        self.context_length = context_length
        self.dataset_fraction = dataset_fraction
        self.dataset_seed = dataset_seed
        self.timestep_exponent = timestep_exponent
        self.dataset_kwargs = dataset_kwargs
        self.max_grad_norm = max_grad_norm
        self.warmup_steps = warmup_steps
        self.learning_rate_schedule = learning_rate_schedule
        self.ema_decay = ema_decay
        self.precision = precision
        self.compile = compile
        self.max_timestep = 1000
        self.score_reference: ScoreReference | None = None
        self.buffer: TrajectoryBuffer | None = None
        self._means = RunningMeans()
        self._training_seconds = 0.0
        if _init_setup_model:
            self._check_arguments(learning_rate=POSITIVE)
            buffer = self._load_buffer()
            self.max_timestep = int(buffer.episode_lengths.max())
            self.score_reference = buffer.score_reference
            self._setup_model()
            normalization = self.policy.normalization
            normalization.set_statistics(*buffer.statistics())
            if normalization.return_to_go_range is not None:
                normalization.set_return_to_go_range(buffer.return_to_go_range())

    def _check_arguments(self, learning_rate: Rule) -> None:
        """
        :param learning_rate: what a number may be that is given as such: 0 is for those who load a model to act with it
        """
        accepted = ACCEPTED if callable(self.learning_rate) else {**ACCEPTED, "learning_rate": learning_rate}
        vars(self).update(check_arguments(vars(self), accepted))
        check_batch_size(self.batch_size)

    def set_dataset(self, dataset: Dataset) -> None:
        """
        Learn from another dataset from now on; normalisation and spaces stay those of the model.

        :param dataset: as in the constructor
        :raises DatasetError: it cannot be read, or does not fit the model
        """
        self.dataset = dataset
        self._load_buffer()

    def _load_buffer(self) -> TrajectoryBuffer:
        """Read the dataset and check it against the spaces, which it defines where there is no environment."""
        if self.dataset is None:
            name = type(self).__name__
            raise ValueError(
                f"{name} has no dataset to learn from: give one to the constructor, or to a loaded model by "
                f"{name}.load(path, dataset=...) or model.set_dataset(...)."
            )
        with first_of_each_machine_first():
            buffer = load_dataset(self.dataset, **(self.dataset_kwargs or {}))
        observation_space = return_to_go_space(buffer.observation_space)
        if getattr(self, "observation_space", None) is None:
            self.observation_space, self.action_space, self.n_envs = observation_space, buffer.action_space, 1
        self._check_spaces(observation_space, buffer.action_space, f"{buffer.source} holds", "the environment's are")
        if self.env is not None:
            self._check_task(buffer, self.env)
        self.buffer = buffer.random_fraction(self.dataset_fraction, self.dataset_seed).to(self.device)
        return self.buffer

    def _check_spaces(self, observation_space: spaces.Space, action_space: spaces.Box, found: str, expected: str) -> None:
        """
        Compare with the model's spaces what the policy depends on: sizes, and the range of actions.

        :raises DatasetError: they do not fit
        """
        ours, theirs = self.observation_space["observation"], observation_space["observation"]  # type: ignore[index]
        if ours.shape != theirs.shape:
            raise DatasetError(f"{found} observations of {theirs}, {expected} {ours}.")
        same_bounds = self.action_space.shape == action_space.shape and (
            np.allclose(self.action_space.low, action_space.low) and np.allclose(self.action_space.high, action_space.high)
        )
        if not same_bounds:
            raise DatasetError(f"{found} actions of {action_space}, {expected} {self.action_space}.")

    @staticmethod
    def _check_task(buffer: TrajectoryBuffer, env: VecEnv) -> None:
        """
        :raises DatasetError: the data were recorded in another environment; versions may differ
        """
        (spec,) = env.get_attr("spec", indices=0)
        if spec is None or buffer.env_id is None or parse_env_id(spec.id)[:2] == parse_env_id(buffer.env_id)[:2]:
            return
        raise DatasetError(
            f"{buffer.source} was recorded in {buffer.env_id}, and the environment is {spec.id}. If the data are meant for "
            f"it, say so with dataset_kwargs={{'env_id': {spec.id!r}}}."
        )

    def _setup_model(self) -> None:
        self._check_arguments(learning_rate=NOT_NEGATIVE)
        if self.score_reference is not None:  # a list in a saved file
            self.score_reference = ScoreReference(*self.score_reference)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            context_length=self.context_length,
            max_timestep=self.max_timestep,
            weight_decay=self.weight_decay,
            ema=self.ema_decay > 0,
            seed=self.seed,
            **self.policy_kwargs,
        ).to(self.device)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Seed everything random, the noise of `predict(deterministic=False)` included.

        :param seed: None changes nothing
        """
        super().set_random_seed(seed)
        if seed is not None and hasattr(self, "policy"):
            self.policy.seed_noise(seed)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """
        SB3's wrapping, then a check that return-to-go arrives unharmed and that actions can be learned.

        :raises ValueError: no return-to-go in the observation, normalised or stacked observations, or unbounded actions
        """
        vec_env = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        check_vec_env(vec_env)
        check_action_space(vec_env.action_space, "the environment")
        return vec_env

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Act in another environment from now on.

        :param env: of the model's sizes and range of actions; the bounds of observations may differ, since the policy
            normalises them itself
        :param force_reset: as in SB3
        :raises ValueError: it does not fit
        """
        vec_env = self._wrap_env(env, self.verbose)
        action_space = check_action_space(vec_env.action_space, "the environment")
        self._check_spaces(vec_env.observation_space, action_space, "The environment has", "the model's are")
        if self.buffer is not None:
            self._check_task(self.buffer, vec_env)
        self.observation_space, self.action_space = vec_env.observation_space, action_space
        self.n_envs = vec_env.num_envs
        super().set_env(vec_env, force_reset)

    @classmethod
    def load(
        cls: type[SelfAlgorithm],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfAlgorithm:
        """
        SB3's loading; arguments are SB3's.

        :param path: file to load
        :param env: see :meth:`set_env`
        :param device: "auto", "cpu" or "cuda"
        :param custom_objects: objects to use in place of those in the file
        :param print_system_info: print what the file was saved with
        :param force_reset: as in SB3
        :param kwargs: attributes to change, `dataset` for example
        :raises ValueError: an attribute out of range, or an environment that does not fit
        """
        model = super().load(path, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        model.policy.set_weight_decay(model.weight_decay)  # the optimiser's state in the file brings that of its own
        if env is not None:
            model.set_env(env, force_reset)
        return model

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        if not is_first_process():
            callback, progress_bar = None, False
        if isinstance(callback, list):
            callback = CallbackList(callback)
        evaluations = find_eval_callbacks(callback) if isinstance(callback, BaseCallback) else []
        if self.env is None and evaluations:  # SB3's callbacks ask the model for an environment
            self.n_envs = evaluations[0].eval_env.num_envs
            self.set_env(evaluations[0].eval_env)
        children = [callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)]
        if self.score_reference is not None:
            children.append(NormalizedScoreCallback(self.score_reference, evaluations))
        if progress_bar:
            children.append(GradientStepProgressBar())
        combined = CallbackList(children)
        combined.init_callback(self)
        return combined

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        """SB3's set-up without the environment's first reset, which offline learning does not need."""
        self._check_arguments(learning_rate=POSITIVE)
        self.start_time = time.time_ns()
        if reset_num_timesteps:
            self.num_timesteps = 0
        else:
            total_timesteps += self.num_timesteps
        self._total_timesteps = total_timesteps
        self._num_timesteps_at_start = self.num_timesteps
        self._means, self._training_seconds = RunningMeans(), 0.0
        if not self._custom_logger:
            verbose, folder = (self.verbose, self.tensorboard_log) if is_first_process() else (0, None)
            self._logger = configure_logger(verbose, folder, tb_log_name, reset_num_timesteps)
        return total_timesteps, self._init_callback(callback, progress_bar)

    def learn(
        self: SelfAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 100,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfAlgorithm:
        """
        Train for `total_timesteps` gradient steps; callbacks run once after each.

        Of several processes, all call this alike, and the callbacks run on process 0; it stops all when they stop it.

        :param total_timesteps: gradient steps
        :param callback: SB3 callback or list of callbacks
        :param log_interval: gradient steps between two logs, None for none
        :param tb_log_name: name of the run in TensorBoard, the algorithm's by default
        :param reset_num_timesteps: count from zero, otherwise go on counting
        :param progress_bar: show one
        :return: the model
        :raises ValueError: no dataset, or an argument out of range
        :raises FloatingPointError: the loss or its gradient is no longer finite; the weights are those from before
        """
        buffer = self.buffer or self._load_buffer()
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        parallel = DataParallel(self.policy, self._loss_function(), self.batch_size)
        batch_generator, noise_generator = self._training_generators(parallel)
        batches = buffer.batches(self.batch_size, self.context_length, batch_generator, self.timestep_exponent)
        callback.on_training_start(locals(), globals())
        parallel.from_first(True)  # which may evaluate for longer than a gradient step's messages wait
        while self.num_timesteps < total_timesteps:
            step_start = time.perf_counter()
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self._gradient_step(next(batches), noise_generator, parallel)
            self.num_timesteps += 1
            self._training_seconds += time.perf_counter() - step_start
            if log_interval and (self.num_timesteps % log_interval == 0 or self.num_timesteps == total_timesteps):
                self.dump_logs()
            callback.update_locals(locals())
            if not parallel.from_first(callback.on_step()):
                break
        self._check_finite(self._pop_means())
        callback.on_training_end()
        parallel.close()
        return self

    def _loss_function(self) -> LossFunction:
        """The policy's loss in the precision asked for, compiled where that pays."""
        compile_it = self.device.type == "cuda" if self.compile is None else self.compile
        compute_loss = th.compile(self.policy.compute_loss) if compile_it else self.policy.compute_loss
        return autocast(self.precision, self.device)(compute_loss)

    def _gradient_step(self, batch: Windows, generator: th.Generator, parallel: DataParallel) -> None:
        """Learn from a batch; a loss or gradient that is not finite changes nothing."""
        self.policy.set_training_mode(True)  # an evaluation in between leaves evaluation mode on
        optimizer: Any = self.policy.optimizer
        self._update_learning_rate(optimizer)
        optimizer.zero_grad(set_to_none=True)  # before the loss, which has the most in memory
        loss, parts = parallel.compute_loss(batch, *self.policy.draw_noise(batch, generator))
        loss.backward()
        grad_norm = th.nn.utils.clip_grad_norm_(self.policy.clipped_parameters(), self.max_grad_norm or math.inf)
        means = parallel.mean({"loss": loss, "grad_norm": grad_norm, **parts})
        self._means.add(means)
        # The fused optimiser leaves the weights alone where this is 1, and no host has to wait for a GPU to tell.
        optimizer.found_inf = (~th.isfinite(means["loss"] + means["grad_norm"])).float().detach()
        optimizer.step()
        self._n_updates += 1
        if self.device.type == "cpu":
            self._check_finite({name: float(means[name].detach()) for name in ("loss", "grad_norm")})
        if self.ema_decay > 0:
            # A young average follows more closely, or the random start would stay in it for long.
            self.policy.update_ema(min(self.ema_decay, (1 + self._n_updates) / (10 + self._n_updates)))

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        remaining = self._current_progress_remaining
        factor = learning_rate_factor(self.learning_rate_schedule, self.num_timesteps, 1.0 - remaining, self.warmup_steps)
        self._current_learning_rate = factor * self.lr_schedule(remaining)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            update_learning_rate(optimizer, self._current_learning_rate)

    def _training_generators(self, parallel: DataParallel) -> tuple[th.Generator, th.Generator]:
        """Randomness of batches and of losses: the run's own, and other streams where training is continued."""
        seed = parallel.seed(th.Generator().seed() if self.seed is None else self.seed)
        states = np.random.SeedSequence([seed, self._n_updates]).generate_state(2, np.uint64)
        batches, noise = (th.Generator(self.device).manual_seed(int(state)) for state in states)
        return batches, noise

    def dump_logs(self) -> None:
        """
        Log the means since the last call.

        :raises FloatingPointError: the loss or its gradient is no longer finite
        """
        n_steps = self._means.n_values
        if n_steps == 0:
            return
        means = self._pop_means()
        self._check_finite(means)
        if is_first_process():
            self._log(means, n_steps)
        self._training_seconds = 0.0

    def _pop_means(self) -> dict[str, float]:
        """The means since the last call; where a GPU computes them, the time to wait for them is training time."""
        start = time.perf_counter()
        means = self._means.pop()
        self._training_seconds += time.perf_counter() - start
        return means

    def _check_finite(self, means: dict[str, float]) -> None:
        """
        :raises FloatingPointError: the loss or its gradient is no longer finite
        """
        for name in ("loss", "grad_norm"):
            if not math.isfinite(means.get(name, 0.0)):
                raise FloatingPointError(
                    f"The {name} became {means[name]} at or before gradient step {self._n_updates} of this model; such "
                    "steps change no weight. Try a lower learning_rate, warmup_steps or max_grad_norm."
                )

    def _log(self, means: dict[str, float], n_steps: int) -> None:
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        self.logger.record("train/action_mse", self._training_action_mse())
        self.logger.record("train/learning_rate", self._current_learning_rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("time/steps_per_second", n_steps / self._training_seconds)
        self.logger.record("time/time_elapsed", int((time.time_ns() - self.start_time) / 1e9), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _training_action_mse(self) -> float:
        """`train/action_mse` on windows of the training data that belong to the step, so that it disturbs nothing."""
        assert self.buffer is not None
        generator = th.Generator(self.device).manual_seed(self.num_timesteps)
        batch = self.buffer.sample(self.batch_size, self.context_length, generator)
        return float(self.policy.action_mse(batch, generator))

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        SB3's saving, on process 0 only: the others hold the same model, and would write the same file at the same time.

        :param path: file to write
        :param exclude: attributes to leave out beside the default ones
        :param include: attributes to save although they are left out by default
        """
        if is_first_process():
            super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "dataset", "buffer", "_means"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
