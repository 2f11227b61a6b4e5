"""The offline learn loop."""

import contextlib
import itertools
import math
import re
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger, update_learning_rate

from sb3_dtfm.algorithms.base import OfflineAlgorithm
from sb3_dtfm.arguments import POSITIVE
from sb3_dtfm.callbacks import GradientStepProgressBar, NormalizedScoreCallback, TimeLeft, find_eval_callbacks
from sb3_dtfm.data import TrajectoryBuffer
from sb3_dtfm.data.decisions import sentences
from sb3_dtfm.distributed import DataParallel, LossFunction, is_first_process, n_processes
from sb3_dtfm.envs import check_vec_env, share_target_return
from sb3_dtfm.optimization import (
    BATCHES,
    DROPOUT,
    NOISE,
    TRANSITIONS,
    RunningMeans,
    autocast,
    choose_precision,
    learning_rate_factor,
    limit_threads,
    seed_default_generator,
    step_seed,
)
from sb3_dtfm.windows import Transitions, Windows

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineSequenceAlgorithm")

# What has to be finite of what is logged.
FINITE = ("loss", "grad_norm", "critic_loss")
# Episodes that a message shows at most.
N_EPISODES_SHOWN = 50


class OfflineSequenceAlgorithm(OfflineAlgorithm):
    """
    Learn a sequence policy from recorded episodes: `learn(total_timesteps)` counts gradient steps.

    Where `torch.distributed` is initialised, its processes train one model together; callbacks, logs and `save` are those
    of process 0.

    Parameters are those of :class:`~sb3_dtfm.algorithms.base.OfflineAlgorithm`.
    """

    progress_bar_class: type[ProgressBarCallback] = GradientStepProgressBar

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False, *own: BaseCallback) -> BaseCallback:
        if not is_first_process():
            callback, progress_bar, own = None, False, ()
        if isinstance(callback, list):
            callback = CallbackList(callback)
        evaluations = find_eval_callbacks(callback) if isinstance(callback, BaseCallback) else []
        for evaluation in evaluations:
            name, remedy = "The evaluation environment of EvalCallback", "EvalCallback(ReturnToGoWrapper(eval_env), ...)"
            check_vec_env(evaluation.eval_env, name, remedy)
            share_target_return(evaluation.eval_env, self.target_return)
        if self.env is None and evaluations:  # SB3's callbacks ask the model for an environment
            self.n_envs = evaluations[0].eval_env.num_envs
            self.set_env(evaluations[0].eval_env)
        children = [callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)]
        if self.score_reference is not None:
            children.append(NormalizedScoreCallback(self.score_reference, evaluations))
        if progress_bar:
            children.append(self.progress_bar_class())
        combined = CallbackList([*children, *own])
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
        self._training_seconds, self._timed_steps = 0.0, 0
        if reset_num_timesteps:
            self._means = RunningMeans()
        if not self._custom_logger:
            verbose, folder = (self.verbose, self.tensorboard_log) if is_first_process() else (0, None)
            self._logger = configure_logger(verbose, folder, tb_log_name, reset_num_timesteps)
        return total_timesteps, self._init_callback(callback, progress_bar, TimeLeft())

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
        :raises ValueError: no dataset, an argument out of range, or a callback that evaluates in an environment which is not
            wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
        :raises FloatingPointError: the loss or its gradient is no longer finite, with the step, its episodes and the last
            checkpoint; such a step changes no weight
        :raises MemoryError: a gradient step needs more than there is, with what decides how much that is
        """
        buffer = self.buffer or self._load_buffer()
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        parallel = DataParallel(self.policy, self._loss_function(), self.batch_size)
        self._training_seed = parallel.broadcast(self._choose_training_seed())
        if self.verbose >= 1 and is_first_process():
            n_steps = total_timesteps - self.num_timesteps
            epochs = n_steps * self.batch_size / len(buffer)
            sizes = f"{n_steps:,} gradient steps of {self.batch_size} windows"
            print(f"{sizes}: {epochs:.1f} epochs of {len(buffer):,} recorded steps", flush=True)
            for sentence in sentences(self.decisions):
                print(sentence, flush=True)
        batches = self._batches(buffer, self.batch_size)
        callback.on_training_start(locals(), globals())
        parallel.broadcast(True)  # which may evaluate for longer than a gradient step's messages wait
        while self.num_timesteps < total_timesteps:
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self.train(batches, parallel)
            self.num_timesteps += 1
            if log_interval and (self.num_timesteps % log_interval == 0 or self.num_timesteps == total_timesteps):
                self.dump_logs()
            callback.update_locals(locals())
            if not parallel.broadcast(callback.on_step()):
                break
        self._check_finite(self._means.sums(), self._means.n_values)
        callback.on_training_end()
        parallel.close()
        return self

    def _batches(self, buffer: TrajectoryBuffer, batch_size: int, stream: int = BATCHES) -> Iterator[Windows]:
        """Batches of the gradient steps from now on, each drawn by a seed of its own."""
        assert self._training_seed is not None
        seeds = (step_seed(self._training_seed, n_updates, stream) for n_updates in itertools.count(self._n_updates))
        return buffer.batches(
            batch_size,
            self.context_length,
            th.Generator(self.device),
            n_ahead=self.policy.options.chunk_size - 1,
            return_weighting=self.return_weighting,
            seeds=seeds,
        )

    def train(self, batches: Iterator[Windows], parallel: DataParallel) -> None:
        """The next gradient step, which the number of those before it decides, and how long it took."""
        assert self._training_seed is not None
        start = time.perf_counter()
        generator = th.Generator(self.device).manual_seed(step_seed(self._training_seed, self._n_updates, NOISE))
        seed_default_generator(self.device, step_seed(self._training_seed, self._n_updates, DROPOUT, parallel.rank))
        with self._explain_out_of_memory(), limit_threads(self._n_macs()):
            self._gradient_step(next(batches), generator, parallel)
        self._training_seconds += time.perf_counter() - start
        self._timed_steps += 1

    def _n_macs(self) -> int:
        """Multiplications of a gradient step, forward and twice as many backward, without attention's."""
        return 3 * self.batch_size * self.context_length * self.policy.network.n_macs

    def _loss_function(self) -> LossFunction:
        """The policy's loss in the precision asked for, compiled where that pays."""
        on_gpu = self.device.type == "cuda"
        compute_loss = self.compute_loss
        if self.compile or (self.compile is None and on_gpu):
            # "reduce-overhead" starts a GPU's kernels as one graph; one by one a step takes three times as long. With
            # several processes it is not measured.
            as_graph = on_gpu and n_processes() == 1
            compute_loss = th.compile(compute_loss, mode="reduce-overhead" if as_graph else "default")
        return autocast(self._chosen_precision(), self.device)(compute_loss)

    def compute_loss(self, batch: Windows, *noise: th.Tensor) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :param batch: windows of a buffer, actions in the environment's range, (B, K + H - 1, A) of them
        :param noise: what the network's `draw_noise` gave for the batch
        :return: the loss to minimise, and its parts by their logged names
        """
        return self.policy.network.loss(self.policy.normalization.scale_batch(batch), *noise)

    def _chosen_precision(self) -> str:
        """ "float32" or "bfloat16": what was asked for, or what "auto" is here."""
        if self.precision != "auto":
            return self.precision
        if self.device.type == "cpu" and n_processes() > 1:
            precision, reason = (
                "float32",
                "Matrix products are in float32: each of several processes would measure for itself.",
            )
        else:
            n_rows = self.batch_size * self.context_length * self.policy.network.trunk.tokens_per_step
            with limit_threads(self._n_macs()):
                precision, reason = choose_precision(self.policy.network, n_rows, self.device)
        if self.verbose >= 1 and is_first_process():
            print(reason, flush=True)
        return precision

    def _gradient_step(self, batch: Windows, generator: th.Generator, parallel: DataParallel) -> None:
        """Learn from a batch; a loss or gradient that is not finite changes nothing."""
        if not self.policy.training:  # an evaluation in between leaves evaluation mode on
            self.policy.set_training_mode(True)
        optimizer = self.policy.optimizer
        self._update_learning_rate(optimizer)
        optimizer.zero_grad(set_to_none=True)  # before the loss, which has the most in memory
        loss, parts = parallel.compute_loss(batch, *self.policy.network.draw_noise(batch, generator))
        loss.backward()
        grad_norm = optimizer.clip_gradient(self.max_grad_norm or math.inf)
        means = parallel.mean({"loss": loss, "grad_norm": grad_norm, **parts, **self._learn_values()})
        self._means.add(means)
        # The fused optimiser leaves the weights alone where this is 1, and no host has to wait for a GPU to tell.
        optimizer.found_inf = (~th.isfinite(means["loss"] + means["grad_norm"])).float().detach()
        optimizer.step()
        self._n_updates += 1
        if self.device.type == "cpu":
            self._check_finite({name: float(means[name].detach()) for name in FINITE if name in means})
        if self.ema_decay > 0:
            # A young average follows more closely, or the random start would stay in it for long.
            self.policy.update_ema(min(self.ema_decay, (1 + self._n_updates) / (10 + self._n_updates)))

    def _learn_values(self) -> dict[str, th.Tensor]:
        """The critic's gradient steps, the same on every process; means of what is logged."""
        critic, n_steps = self.policy.critic, self.policy.options.critic_steps
        if critic is None:
            return {}
        assert self._training_seed is not None
        generator = th.Generator(self.device).manual_seed(step_seed(self._training_seed, self._n_updates, TRANSITIONS))
        sums: dict[str, th.Tensor] = {}
        for _ in range(n_steps):
            batch = self._sample_transitions(critic.batch_size, generator)
            parts = critic.learn(self.policy.normalization.scale_transitions(batch))
            sums = {name: sums.get(name, 0.0) + part for name, part in parts.items()}
        return {name: total / n_steps for name, total in sums.items()}

    def _sample_transitions(self, batch_size: int, generator: th.Generator) -> Transitions:
        """What the critic learns from."""
        assert self.buffer is not None
        return self.buffer.sample_transitions(batch_size, self.policy.critic_horizon, self.policy.options.gamma, generator)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        factor = learning_rate_factor(self.learning_rate_schedule, *self._schedule_position(), self.warmup_steps)
        self._current_learning_rate = factor * self.lr_schedule(self._current_progress_remaining)
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            update_learning_rate(optimizer, self._current_learning_rate)

    def _schedule_position(self) -> tuple[int, float]:
        """Gradient steps since the learning rate's schedule began, and the share of it that is done."""
        return self.num_timesteps, 1.0 - self._current_progress_remaining

    def _choose_training_seed(self) -> int:
        """The run's seed; one that was drawn stays the model's."""
        if self.seed is not None:
            return self.seed
        return th.Generator().seed() if self._training_seed is None else self._training_seed

    def dump_logs(self) -> None:
        """
        Log the means since the last call.

        :raises FloatingPointError: the loss or its gradient is no longer finite
        """
        n_steps = self._means.n_values
        if n_steps == 0:
            return
        means = self._pop_means()
        self._check_finite(means, n_steps)
        if is_first_process():
            self._log(means)
        self._training_seconds, self._timed_steps = 0.0, 0

    def _pop_means(self) -> dict[str, float]:
        """The means since the last call; where a GPU computes them, the time to wait for them is training time."""
        start = time.perf_counter()
        means = self._means.pop()
        self._training_seconds += time.perf_counter() - start
        return means

    def _check_finite(self, means: dict[str, float], n_steps: int = 1) -> None:
        """
        :param means: over the newest gradient steps
        :param n_steps: how many these are
        :raises FloatingPointError: the loss or its gradient is no longer finite
        """
        for name in FINITE:
            if not math.isfinite(means.get(name, 0.0)):
                raise FloatingPointError(
                    f"The {name} became {means[name]} {self._name_steps(n_steps)}. Such steps change no weight, so the last "
                    f"checkpoint is good: {self._last_saved or 'none was saved since this model was made or loaded'}. Try a "
                    "lower learning_rate, warmup_steps or max_grad_norm."
                )

    def _name_steps(self, n_steps: int) -> str:
        """Which gradient steps the newest ones are; of a single one, the episodes of its batch, too."""
        if n_steps > 1:
            return f"between gradient steps {self._n_updates - n_steps + 1} and {self._n_updates} of this model"
        assert self.buffer is not None
        episodes = self.buffer.present_episodes()
        more = f" and {len(episodes) - N_EPISODES_SHOWN} more" if len(episodes) > N_EPISODES_SHOWN else ""
        shown = ", ".join(map(str, episodes[:N_EPISODES_SHOWN]))
        return f"at gradient step {self._n_updates} of this model, whose batch is from episodes {shown}{more} of its buffer"

    @contextlib.contextmanager
    def _explain_out_of_memory(self) -> Iterator[None]:
        """
        :raises MemoryError: in place of any error of memory, with the settings that decide how much is needed
        """
        try:
            yield
        except (MemoryError, RuntimeError) as error:
            # On a CPU torch has no class for it.
            if isinstance(error, RuntimeError) and not re.search("out of memory|(allocate|enough) memory", str(error), re.I):
                raise
            sizes = self.policy.options
            raise MemoryError(
                f"A gradient step does not fit into the memory of {self.device}: batch_size={self.batch_size}, "
                f"context_length={self.context_length}, chunk_size={sizes.chunk_size}, embed_dim={sizes.embed_dim}, "
                f"n_layers={sizes.n_layers}. Lower batch_size first."
            ) from error

    def _log(self, means: dict[str, float]) -> None:
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        self.logger.record("train/action_mse", self._on_training_windows(self.policy.action_mse))
        if self.policy.options.n_action_samples > 1:
            self.logger.record("train/best_of_n_share", self._on_training_windows(self.policy.best_of_n_share))
        self.logger.record("train/learning_rate", self._current_learning_rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("time/steps_per_second", self._timed_steps / self._training_seconds)
        self.logger.record("time/time_elapsed", int((time.time_ns() - self.start_time) / 1e9), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _on_training_windows(self, measure: Callable[[Windows, th.Generator], th.Tensor]) -> float:
        """Something measured on windows of the training data that belong to the step, so that it disturbs nothing."""
        assert self.buffer is not None
        generator = th.Generator(self.device).manual_seed(self.num_timesteps)
        return float(measure(self.buffer.sample(self.batch_size, self.context_length, generator), generator))
