"""Offline learning from recorded episodes: one class, whose children differ in their policy's head."""

import inspect
import itertools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import configure_logger, update_learning_rate

from sb3_dtfm.algorithms.model import POLICY_NAMES, SequenceModel
from sb3_dtfm.algorithms.options import TrainingOptions
from sb3_dtfm.arguments import POSITIVE, documented_parameters, whole_timesteps
from sb3_dtfm.callbacks import GradientStepProgressBar, TimeLeft, combine_callbacks
from sb3_dtfm.data import Dataset, TrajectoryBuffer, check_controller, load_dataset, without_pickles
from sb3_dtfm.data.decisions import DECIDED, Decision, decide_open, sentences
from sb3_dtfm.data.inspection import return_reference, suggested_target_return
from sb3_dtfm.distributed import (
    DataParallel,
    LossFunction,
    is_first_process,
    local_rank_zero_first,
    n_processes,
)
from sb3_dtfm.envs import channels_first, check_vec_env, reader_options, return_to_go_space, share_target_return
from sb3_dtfm.optimization import (
    BATCHES,
    DROPOUT,
    FINITE,
    NOISE,
    TRANSITIONS,
    RunningMeans,
    autocast,
    check_finite,
    choose_precision,
    explain_out_of_memory,
    learning_rate_factor,
    limit_threads,
    seed_default_generator,
    step_seed,
)
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.options import PolicyOptions
from sb3_dtfm.transitions import ENDS, Transitions
from sb3_dtfm.windows import Windows

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineAlgorithm")

# Arguments of the algorithm that the data decide where they are None; the policy's are among `policy_kwargs`.
DECIDED_HERE = DECIDED & set(TrainingOptions.defaults())
# Episodes that a message shows at most.
N_EPISODES_SHOWN = 50
# Windows on which `train/best_of_n_share` is measured: a whole batch of 32 samples each took 9 % of the training time.
N_SHARE_WINDOWS = 64


class OfflineAlgorithm(SequenceModel):
    """
    Learn a sequence policy from recorded episodes: `learn(total_timesteps)` counts gradient steps.

    If `torch.distributed` is initialised, its processes train one model together; callbacks, logs and `save` are those
    of process 0. Arguments that are not described here are :class:`~sb3_dtfm.algorithms.options.TrainingOptions`.

    :param policy: "MultiInputPolicy", "MlpPolicy" or "CnnPolicy" (all alike), or a policy class
    :param env: environment, or its Gymnasium id; optional, never used for learning. It is wrapped in
        :class:`~sb3_dtfm.envs.ReturnToGoWrapper` where it is not yet; a vectorised one has to be wrapped inside
    :param dataset: Minari id or dataset, path of a file or folder, or data in memory; see
        :func:`~sb3_dtfm.data.load_dataset`
    :param learning_rate: AdamW's learning rate, a number or a function of the progress remaining (from 1 to 0)
    :param dataset_kwargs: further arguments of :func:`~sb3_dtfm.data.load_dataset`: `{"cache_dir": folder}` for datasets
        larger than memory, `{"fraction": 0.5}` for a random half of the episodes, `{"env_id": id}` for data that were
        recorded under another environment's name, and the reader's own, for example `{"filter_key": "train"}` for robomimic.
        `max_episode_steps` is the environment's unless it is given, and stays the model's when it is saved: what episodes
        hold beyond it is left out, since no episode of the environment gets there; None keeps it
    :param policy_kwargs: arguments of the policy, for example `embed_dim`, `n_layers`, `n_heads`, `dropout`, `kv_cache`. The
        data decide some that are not given, see :mod:`sb3_dtfm.data.decisions`
    :param tensorboard_log: folder of the TensorBoard log, None for no log
    :param verbose: 0 silent, 1 prints the log
    :param seed: seed of weights, batches and acting
    :param device: "auto", "cpu" or "cuda"
    :param _init_setup_model: whether to build the network at once
    :ivar target_return: target return for acting, environment reward units: the environment's, or where it has none the mean
        return of the best tenth of the recorded episodes, which `sb3-dtfm inspect` suggests. It is saved with the model, and
        given to each environment of the model that is wrapped without a target. None if a file does not tell
    :raises ValueError: no dataset, an argument out of range, or an environment that does not fit
    :raises DatasetError: the dataset cannot be read, or does not fit the environment
    """

    progress_bar_class: type[ProgressBarCallback] = GradientStepProgressBar

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """`help` of an algorithm lists all parameters, those of training, policy and head, too."""
        super().__init_subclass__(**kwargs)
        policy: Any = cls.policy_aliases.get(POLICY_NAMES[0])
        if cls.__base__ is OfflineAlgorithm and policy is not None:
            order = inspect.signature(cls).parameters
            own = documented_parameters(OfflineAlgorithm, TrainingOptions, order=order, decided=DECIDED)
            of_the_policy = documented_parameters(PolicyOptions, policy.head_class.options_class, decided=DECIDED)
            parts = [inspect.cleandoc(cls.__doc__ or ""), own, "`policy_kwargs` may hold:", of_the_policy]
            cls.__doc__ = "\n\n".join(parts)

    def __init__(
        self,
        policy: str | type[SequencePolicy],
        env: GymEnv | str | None = None,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 1e-3,
        batch_size: int | None = TrainingOptions.batch_size,
        context_length: int = TrainingOptions.context_length,
        return_weighting: float | None = TrainingOptions.return_weighting,
        weight_decay: float = TrainingOptions.weight_decay,
        learning_rate_schedule: str = TrainingOptions.learning_rate_schedule,
        warmup_steps: int = TrainingOptions.warmup_steps,
        max_grad_norm: float | None = TrainingOptions.max_grad_norm,
        ema_decay: float = TrainingOptions.ema_decay,
        precision: str = TrainingOptions.precision,
        compile: bool | None = TrainingOptions.compile,
        dataset_kwargs: dict[str, Any] | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        options = TrainingOptions.of(locals())
        super().__init__(policy, env, options, learning_rate, policy_kwargs, tensorboard_log, verbose, seed, device)
        self.dataset = dataset
        self.dataset_kwargs = dataset_kwargs
        self.time_limit: int | None = None  # longest episode of the newest environment that it learned for
        self.decisions: list[Decision] = []
        self._training_seconds, self._timed_steps = 0.0, 0
        self._current_learning_rate = 0.0
        self._training_seed: int | None = None  # drawn where `seed` is None
        if _init_setup_model:
            self._check_arguments(learning_rate=POSITIVE)
            buffer = self._read_dataset()
            self.max_timestep = int(buffer.episode_lengths.max())
            self._decide(buffer)
            self.score_reference = buffer.score_reference
            self._setup_model()
            taken = self._learn_from(buffer)
            normalization = self.policy.normalization
            normalization.set_statistics(*buffer.statistics())
            if normalization.return_mean is not None:
                normalization.set_return_to_go_moments(taken.return_to_go_moments())
            if normalization.return_to_go_range is not None:
                normalization.set_return_to_go_range(taken.return_to_go_range())
            if self.policy.critic is not None:
                self.policy.critic.set_scale(buffer.largest_discounted_return(self.policy.options.gamma))

    def _decide(self, buffer: TrajectoryBuffer) -> None:
        """Have the data decide the arguments that the user has left open; they are saved with the others."""
        given = self.policy_kwargs or {}
        names = self._policy_class.parameter_names() | {name for name in DECIDED_HERE if getattr(self, name) is None}
        self.decisions = decide_open(buffer, names, given)
        values = {each.name: each.value for each in self.decisions}
        for name in DECIDED_HERE & set(values):
            setattr(self, name, values.pop(name))
        self.policy_kwargs = {**values, **given}

    def set_dataset(self, dataset: Dataset) -> None:
        """
        Learn from another dataset from now on; normalisation and spaces stay those of the model.

        :param dataset: dataset, as in the constructor
        :raises DatasetError: it cannot be read, or does not fit the model
        """
        self.dataset, self.decisions = dataset, []
        self._load_buffer()

    def _load_buffer(self) -> TrajectoryBuffer:
        """Read the dataset of a model whose settings are decided, to learn from it."""
        return self._learn_from(self._read_dataset())

    def _read_dataset(self) -> TrajectoryBuffer:
        """Read the dataset and check it against the spaces, which it defines where there is no environment."""
        if self.dataset is None:
            name = type(self).__name__
            raise ValueError(
                f"{name} has no dataset to learn from: give one to the constructor, or to a loaded model by "
                f"{name}.load(path, dataset=...) or model.set_dataset(...)."
            )
        known: dict[str, Any] = {"action_space": getattr(self, "action_space", None), "max_episode_steps": self.time_limit}
        if self.env is not None:
            known |= reader_options(self.env)
            self.time_limit = known["max_episode_steps"]
        with local_rank_zero_first():
            buffer = load_dataset(self.dataset, **{**known, **without_pickles(self.dataset_kwargs)})
        images = {camera: channels_first(space) for camera, space in buffer.image_spaces.items()}
        observation_space = return_to_go_space(buffer.observation_space, images)
        if getattr(self, "observation_space", None) is None:
            self.observation_space, self.action_space, self.n_envs = observation_space, buffer.action_space, 1
        self._check_spaces(observation_space, buffer.action_space, f"{buffer.source} holds", "the environment's are")
        if self.env is not None:
            self._check_task(buffer, self.env)
            check_controller(buffer.controller, known["env_args"], source=buffer.source)
        if self.target_return is None:
            self.target_return = suggested_target_return(buffer)
            if self.env is not None:
                share_target_return(self.env, self.target_return)
                if self.verbose >= 1 and is_first_process():
                    chosen = f"The environment has target_return={self.target_return:g}"
                    print(f"{chosen}, as `sb3-dtfm inspect` suggests of the recorded returns.", flush=True)
        self.return_reference, self.controller = return_reference(buffer), buffer.controller
        return buffer

    def _learn_from(self, buffer: TrajectoryBuffer) -> TrajectoryBuffer:
        """
        Learn from these episodes from now on.

        :return: the episodes, with the returns-to-go that the model is conditioned on
        """
        n_steps = self.policy.options.expected_return_steps
        if n_steps:
            if self.verbose >= 1 and is_first_process():
                print(f"Learning which returns may be expected (expected_return_steps={n_steps})", flush=True)
            buffer = buffer.to("cpu").with_expected_returns(n_steps)
        self.buffer = buffer.to(self.device)
        return self.buffer

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False, *own: BaseCallback) -> BaseCallback:
        if not is_first_process():
            callback, progress_bar, own = None, False, ()
        if progress_bar:
            own = (self.progress_bar_class(), *own)
        combined, evaluations = combine_callbacks(callback, self.score_reference, own)
        for evaluation in evaluations:
            name, remedy = "The evaluation environment of EvalCallback", "EvalCallback(ReturnToGoWrapper(eval_env), ...)"
            check_vec_env(evaluation.eval_env, name, remedy)
            self.check_controller(evaluation.eval_env, "the environment of EvalCallback")
            share_target_return(evaluation.eval_env, self.target_return)
        if self.env is None and evaluations:  # SB3's callbacks ask the model for an environment
            self.n_envs = evaluations[0].eval_env.num_envs
            self.set_env(evaluations[0].eval_env)
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

        Several processes all call this alike; callbacks run on process 0, which stops all when a callback stops it.

        :param total_timesteps: number of gradient steps
        :param callback: SB3 callback or list of callbacks
        :param log_interval: number of gradient steps between two logs, None for no logs
        :param tb_log_name: name of the run in TensorBoard, the algorithm's by default
        :param reset_num_timesteps: whether timesteps are counted from zero; otherwise they continue
        :param progress_bar: whether to show a progress bar
        :return: the model
        :raises ValueError: no dataset, an argument out of range, or a callback that evaluates in an environment which is not
            wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
        :raises FloatingPointError: the loss or its gradient is no longer finite, with the step, its episodes and the last
            checkpoint; such a step changes no weight
        :raises MemoryError: a gradient step needs more memory than there is; the message names the arguments that decide it
        """
        total_timesteps = whole_timesteps(total_timesteps, reset_num_timesteps)
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
        parallel.broadcast(True)  # callbacks may have evaluated for longer than a gradient step's messages wait
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
        """Take the next gradient step, whose random numbers follow from the number of those before it, and time it."""
        assert self._training_seed is not None
        start = time.perf_counter()
        generator = th.Generator(self.device).manual_seed(step_seed(self._training_seed, self._n_updates, NOISE))
        seed_default_generator(self.device, step_seed(self._training_seed, self._n_updates, DROPOUT, parallel.rank))
        with explain_out_of_memory(self.device, self._sizes, self._n_bytes()), limit_threads(self._n_macs()):
            self._gradient_step(next(batches), generator, parallel)
        self._training_seconds += time.perf_counter() - start
        self._timed_steps += 1

    def _sizes(self) -> str:
        """The arguments that decide how much memory a gradient step needs."""
        own, sizes = self.policy.options, {"batch_size": self.batch_size, "context_length": self.context_length}
        sizes |= {"chunk_size": own.chunk_size, "embed_dim": own.embed_dim, "n_layers": own.n_layers}
        return ", ".join(f"{name}={value}" for name, value in sizes.items())

    def _n_bytes(self) -> int:
        """Bytes that a gradient step needs at least: for its batch, and for what blocks keep for the backward pass."""
        own, policy = self.policy.options, self.policy
        in_batch = 4 * (policy.observation_dim + policy.action_dim)
        in_blocks = 2 * 8 * own.embed_dim * own.n_layers * own.tokens_per_step  # bfloat16: keys, values and the like
        return self.batch_size * self.context_length * (in_batch + in_blocks // n_processes())

    def _n_macs(self) -> int:
        """Multiply-accumulates of a gradient step, forward and twice as many backward, without attention's."""
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
        :param batch: windows of a buffer, with actions (B, K + H - 1, A) in the environment's range
        :param noise: noise of the batch, by the network's `draw_noise`
        :return: the loss to minimise, and its parts by their logged names
        """
        seen = batch._replace(observations=self.policy.network.see(batch.observations))
        return self.policy.network.loss(self.policy.normalization.scale_batch(seen), *noise)

    def _chosen_precision(self) -> str:
        """ "float32" or "bfloat16": what was asked for, or what "auto" is here."""
        if self.precision != "auto":
            return self.precision
        n_rows = self.batch_size * self.context_length * self.policy.options.tokens_per_step
        with limit_threads(self._n_macs()):
            precision, reason = choose_precision(self.policy.network, n_rows, self.device, n_processes())
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
        """Take the critic's gradient steps, the same on every process, and return means of the values to log."""
        critic, n_steps = self.policy.critic, self.policy.options.critic_steps
        if critic is None:
            return {}
        assert self._training_seed is not None
        generator = th.Generator(self.device).manual_seed(step_seed(self._training_seed, self._n_updates, TRANSITIONS))
        sums: dict[str, th.Tensor] = {}
        for _ in range(n_steps):
            batch = self._sample_transitions(critic.batch_size, generator)
            with th.no_grad():
                ends = {name: self.policy.network.see(getattr(batch, name)) for name in ENDS}
            parts = critic.learn(self.policy.normalization.scale_transitions(batch._replace(**ends)))
            sums = {name: sums.get(name, 0.0) + part for name, part in parts.items()}
        return {name: total / n_steps for name, total in sums.items()}

    def _sample_transitions(self, batch_size: int, generator: th.Generator) -> Transitions:
        """Draw data for the critic."""
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
        """The run's seed; a drawn one stays the model's."""
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
        start = time.perf_counter()
        means = self._means.pop()
        self._training_seconds += time.perf_counter() - start  # where a GPU computes them, it is waited for here
        self._check_finite(means, n_steps)
        if is_first_process():
            self._log(means)
        self._training_seconds, self._timed_steps = 0.0, 0

    def _check_finite(self, means: dict[str, float], n_steps: int = 1) -> None:
        """
        :param means: means over the newest gradient steps, by name
        :param n_steps: number of these steps
        :raises FloatingPointError: the loss or its gradient is no longer finite
        """
        check_finite(means, lambda: self._name_steps(n_steps), self._last_saved)

    def _name_steps(self, n_steps: int) -> str:
        """Return which gradient steps the newest ones are, for a single one also the episodes of its batch."""
        if n_steps > 1:
            return f"between gradient steps {self._n_updates - n_steps + 1} and {self._n_updates} of this model"
        assert self.buffer is not None
        episodes = self.buffer.present_episodes()
        more = f" and {len(episodes) - N_EPISODES_SHOWN} more" if len(episodes) > N_EPISODES_SHOWN else ""
        shown = ", ".join(map(str, episodes[:N_EPISODES_SHOWN]))
        return f"at gradient step {self._n_updates} of this model, whose batch is from episodes {shown}{more} of its buffer"

    def _log(self, means: dict[str, float]) -> None:
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        self.logger.record("train/action_mse", self._on_training_windows(self.policy.action_mse))
        if self.policy.options.n_action_samples > 1:
            share = self._on_training_windows(self.policy.best_of_n_share, N_SHARE_WINDOWS)
            self.logger.record("train/best_of_n_share", share)
        self.logger.record("train/learning_rate", self._current_learning_rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("time/steps_per_second", self._timed_steps / self._training_seconds)
        self.logger.record("time/time_elapsed", int((time.time_ns() - self.start_time) / 1e9), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _on_training_windows(
        self, measure: Callable[[Windows, th.Generator], th.Tensor], at_most: int | None = None
    ) -> float:
        """Measure on windows of the training data, drawn by the number of the step, so that no other draw changes."""
        assert self.buffer is not None
        generator = th.Generator(self.device).manual_seed(self.num_timesteps)
        n_windows = min(self.batch_size, at_most or self.batch_size)
        return float(measure(self.buffer.sample(n_windows, self.context_length, generator), generator))
