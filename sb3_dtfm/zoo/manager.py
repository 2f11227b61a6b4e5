"""RL-Zoo's experiment: its way from settings to a trained model."""

import contextlib
import functools
import inspect
import os
import shutil
import signal
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import optuna
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.algorithms.model import POLICY_NAMES
from sb3_dtfm.arguments import COUNT, Number, with_nearest
from sb3_dtfm.callbacks import EvaluateAtStartAndEnd, SeedEvaluations
from sb3_dtfm.distributed import is_first_process
from sb3_dtfm.files import CLASSES, EVALUATED, check_settings
from sb3_dtfm.zoo.arguments import (
    Restored,
    UsageError,
    check_device,
    find_target_return,
    listed_settings,
    with_target_return,
)
from sb3_dtfm.zoo.comparison import MeasureRandomActions, compare
from sb3_dtfm.zoo.registration import with_policy_options
from sb3_dtfm.zoo.resuming import CHECKPOINT, KeepCheckpoint, ReplaceEvaluations, Start, StopSignals, go_on

# Keys of RL-Zoo's YAML files that no algorithm sees.
OF_RL_ZOO = ("n_timesteps", "n_envs", "normalize", "frame_stack", "callback", "env_wrapper", "vec_env_wrapper", "env_kwargs")


# Keys that RL-Zoo reads as schedules: a number, or text such as lin_0.001 for one that falls to 0.
SCHEDULES = frozenset({"learning_rate", "clip_range", "clip_range_vf", "delta_std"})


class TrialNumber(int):
    """Number of a study's trial, true even if it is 0: RL-Zoo takes what is false for no number."""

    def __bool__(self) -> bool:
        return True


class TrainingError(RuntimeError):
    """An error in the midst of training, and so no mistake in the settings; the cause has the traceback that counts."""


class OfflineExperimentManager(ExperimentManager):
    """
    RL-Zoo's own manager, for all of its algorithms, and what offline learning needs beside it.

    - A run that ends before it has a model leaves no folder, where `enjoy` would look for the latest run.
    - An environment of dt or dtfm always shows a return-to-go, and the run's settings hold its target return.
    - dt and dtfm are evaluated before the first gradient step and after the last one too.
    - Only the first process of a training runs callbacks.
    - dt and dtfm keep a checkpoint while they train, and an interrupted run resumes from it.
    - The last evaluation is compared with the recorded episodes.

    :param arguments: arguments of the command
    :param resumed: folder of a run to go on with, instead of a new one
    :param restored: the user's arguments beside `--resume`, where all others come from that folder
    """

    command = "train"

    def __init__(
        self,
        *args: Any,
        arguments: Sequence[str] = (),
        resumed: Path | None = None,
        restored: Restored | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.restored = restored
        self._check_options()
        self.trial_id = None if self.trial_id is None else TrialNumber(self.trial_id)
        if resumed is not None and self.algo not in ALGORITHMS:  # other checkpoints are pickles
            raise UsageError(f"--resume {resumed}: runs of {' and '.join(ALGORITHMS)} go on, none of --algo {self.algo}.")
        if resumed is not None and self.optimize_hyperparameters:
            raise UsageError(f"--resume {resumed}: -optimize continues by its --storage and --study-name.")
        if restored is not None:
            restored.check_config(self.config)
        self.valueless: list[str] = []  # why trials of a search have no value
        self.signals = StopSignals(between_steps=self.algo in ALGORITHMS)
        self.keeper: KeepCheckpoint | None = None
        self.evaluations: list[EvalCallback] = []  # of dt and dtfm
        # RL-Zoo draws a seed where none is given; the last one that is given counts.
        self.start = Start([*arguments, "--seed", str(self.seed)], command=self.command)
        self.resumed = resumed
        if resumed is not None:
            began = Start.read(resumed, self.command)
            self.start = began._replace(arguments=self.start.arguments)
            if is_first_process():  # what others write is not kept
                self.save_path, self.params_path = str(resumed), str(resumed / self.env_name)
        self.has_checkpoint = resumed is not None and (resumed / CHECKPOINT).is_file()  # else it begins anew
        if resumed is not None and not self.has_checkpoint and is_first_process():
            print(f"{resumed} was interrupted before its first checkpoint: training begins anew.", flush=True)
        if resumed is not None and self.has_checkpoint:
            self.trained_agent, self.continue_training = str(resumed / CHECKPOINT), True

    def _check_options(self) -> None:
        """
        :raises UsageError: an option of RL-Zoo's that it would leave aside, or fail with later
        """
        numbers = {"-n": self.n_timesteps, "--eval-episodes": self.n_eval_episodes, "--n-eval-envs": self.n_eval_envs}
        for option, number in numbers.items():
            if number < 1 and (option, number) != ("-n", -1):  # RL-Zoo's default, the settings' number
                raise UsageError(f"{option}: must be at least 1, got {number}.")
        if not self.log_folder:
            raise UsageError("-f: expected a folder, got ''; . is the current one.")
        check_device(self.device)
        study = {"--storage": self.storage, "--study-name": self.study_name, "--trial-id": self.trial_id}
        missing = [option for option, value in study.items() if value is None]
        if not self.optimize_hyperparameters and 0 < len(missing) < len(study):
            raise UsageError(f"{', '.join(missing)}: needed, too, to train with a trial of a study; -optimize makes one.")

    def load_trial(self, storage: str, study_name: str, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """
        Load a trial's settings as RL-Zoo does; whoever wrote the study runs nothing by them.

        :raises ValueError: a class that is not known here, or Python that is no literal
        """
        settings = super().load_trial(storage, study_name, *args, **kwargs)
        return check_settings(settings, f"study {study_name!r}", [*CLASSES, *EVALUATED])

    def _check_settings(self, hyperparams: dict[str, Any]) -> None:
        """
        :raises UsageError: an invalid value of a setting that RL-Zoo reads itself
        """
        if not COUNT.accepts(hyperparams.get("n_envs", 1)):
            raise UsageError(f"n_envs must be {COUNT}, got {hyperparams['n_envs']!r}.")
        if self.n_timesteps < 1 and not Number(low=1).accepts(hyperparams.get("n_timesteps", 1)):
            raise UsageError(f"n_timesteps must be {COUNT}, got {hyperparams['n_timesteps']!r}; -n gives another one.")
        for name in CLASSES:
            given = hyperparams.get(name)
            for each in given if isinstance(given, list) else [given]:
                named = next(iter(each), None) if isinstance(each, dict) else each
                if not (each is None or isinstance(named, str | type | BaseCallback)):
                    raise UsageError(f"{name}: expected the dotted name of a {CLASSES[name]} in quotes, got {named!r}.")

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read settings as RL-Zoo does; policy options may stand among them, and the ReturnToGoWrapper may be left out."""
        listed_settings(self.config, self.env_name.gym_id)  # its errors name the file
        try:
            hyperparams, saved = super().read_hyperparameters()
        except IndexError as error:
            if self.trial_id is None:
                raise
            raise UsageError(f"--trial-id {self.trial_id}: study {self.study_name!r} has no such trial.") from error
        if self.restored is not None:
            hyperparams = self.restored.check_config(self.config, hyperparams)
        self._check_settings(hyperparams)
        hyperparams.update({name: _as_schedule(name, hyperparams[name]) for name in SCHEDULES & hyperparams.keys()})
        if self.n_timesteps < 1 and "n_timesteps" not in hyperparams:
            raise UsageError("n_timesteps: the settings have none; add it there, or give -n.")
        hyperparams.setdefault("n_timesteps", self.n_timesteps)
        if self.algo not in ALGORITHMS:
            return hyperparams, saved
        self.evaluate_alike(hyperparams)
        hyperparams = {"policy": POLICY_NAMES[0], **with_policy_options(hyperparams)}
        if self.learns_offline:
            wrappers = hyperparams.get("env_wrapper")
            hyperparams = {**hyperparams, "env_wrapper": with_target_return(find_target_return(wrappers), wrappers)}
        return hyperparams, OrderedDict(sorted(hyperparams.items()))

    def evaluate_alike(self, hyperparams: dict[str, Any]) -> None:
        """Give evaluations the arguments of the environment that the settings have, which RL-Zoo may leave out."""
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = hyperparams.get("env_kwargs") or self.env_kwargs

    @property
    def learns_offline(self) -> bool:
        """Return whether a timestep is a gradient step on recorded episodes."""
        return self.algo in ALGORITHMS and self.command == "train"

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """Set up as RL-Zoo does, which makes the run's folder before its model."""
        try:
            made = super().setup_experiment()
            if made is not None and self.learns_offline:
                self._save_target_return(*made)
            return made
        except BaseException as error:
            with contextlib.suppress(OSError):  # not made yet, or no longer empty: then it is a run's
                os.rmdir(self.params_path)
                if self.resumed is None:
                    shutil.rmtree(self.save_path)
            if isinstance(error, TypeError):
                self._check_names(error)
            raise

    def _save_target_return(self, model: BaseAlgorithm, saved: dict[str, Any]) -> None:
        """
        Write into the run's settings which target return its environment got from the data, for whoever acts with the model.

        :param model: model with its environment
        :param saved: settings of the run
        """
        assert model.env is not None
        saved["env_wrapper"] = with_target_return(model.env.get_attr("target_return")[0], saved["env_wrapper"])
        Path(self.params_path, "config.yml").write_text(yaml.dump(saved))

    def _check_names(self, error: TypeError) -> None:
        """
        :param error: error that the algorithm's constructor raised
        :raises UsageError: a hyperparameter that it does not have
        """
        known = [*inspect.signature(ALGOS[self.algo]).parameters, *OF_RL_ZOO]
        unknown = sorted(set(self._hyperparams) - set(known))
        if unknown:
            raise UsageError(f"{with_nearest(unknown, known)}: no hyperparameter of {self.algo}.") from error

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """Normalise as RL-Zoo does; dt and dtfm need no pickled statistics from beside a trained agent."""
        if self.algo not in ALGORITHMS:
            return super()._maybe_normalize(env, eval_env)
        of_evaluations = {"norm_reward": False, "training": False} if eval_env else {}
        return VecNormalize(env, **{**self.normalize_kwargs, **of_evaluations}) if self.normalize else env

    def objective(self, trial: optuna.Trial) -> float:
        """Run a trial as RL-Zoo does; one that diverges or needs too much memory has no value."""
        try:
            return super().objective(trial)
        except (FloatingPointError, MemoryError, optuna.TrialPruned) as error:
            cause = error.__cause__ or error
            self.valueless.append(f"{type(cause).__name__}: {cause}".removesuffix(": "))
            raise optuna.TrialPruned(str(cause)) from error

    def hyperparameters_optimization(self) -> None:
        """
        Search as RL-Zoo does.

        :raises UsageError: no trial has a value, so none is the best, and why the last one has none
        """
        try:
            super().hyperparameters_optimization()
        except ValueError as error:  # Optuna's, of a study without a best trial
            if not self.valueless:
                raise
            raise UsageError(f"{error} Of {len(self.valueless)} the last ended by {self.valueless[-1]}") from error

    def create_callbacks(self) -> None:
        """Create callbacks as RL-Zoo does, and the evaluations that a count of full intervals leaves out."""
        if not is_first_process():
            self.callbacks = []
            return
        n_envs = self.n_envs
        self.n_envs = 1 if self.learns_offline else n_envs  # RL-Zoo divides the intervals by it
        super().create_callbacks()
        self.n_envs = n_envs
        if self.algo not in ALGORITHMS or self.optimize_hyperparameters:
            return
        evaluations = [callback for callback in self.callbacks if isinstance(callback, EvalCallback)]
        first = self.callbacks.index(evaluations[0]) if evaluations else 0
        random = MeasureRandomActions(evaluations, self.seed, self.signals.end_evaluation)
        self.callbacks[first:first] = [random, SeedEvaluations(evaluations, self.seed)]
        self.evaluations = evaluations
        if self.signals.between_steps:
            for evaluation in evaluations:
                self.signals.watch(evaluation)
            for callback in self.callbacks:
                if hasattr(callback, "on_evaluation_step"):  # as the benchmark's
                    callback.on_evaluation_step = self.signals.end_evaluation
        self.keeper = KeepCheckpoint(Path(self.save_path), self.signals, self.start)
        self.callbacks += [EvaluateAtStartAndEnd(evaluations), ReplaceEvaluations(evaluations), self.keeper]

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train as RL-Zoo does; a run that is resumed has the rest of its steps before it.

        :param model: model to train
        :raises TrainingError: any error in the training
        :raises UsageError: another process is training the run that is to be resumed
        """
        if self.keeper is not None:
            self.keeper.hold()  # until the model is saved
        learning = model
        try:
            if self.resumed is not None:
                if not self.has_checkpoint:
                    model.num_timesteps = 0  # those of the agent that it began with are not its own
                go_on(model, self.callbacks, self.start)
                self.n_timesteps -= model.num_timesteps
                learn = functools.partial(model.learn, reset_num_timesteps=model.num_timesteps == 0)
                learning = cast(BaseAlgorithm, SimpleNamespace(learn=learn, env=model.env))  # all that RL-Zoo asks for
            with self.signals.caught():
                super().learn(learning)
        except UsageError:
            assert self.keeper is not None
            self.keeper.release()
            raise
        except Exception as error:
            if self.signals.asked:  # Ctrl-C reaches the environments' processes, too
                return
            if self.keeper is not None:
                self.keeper.release()
            message = f"Training ended after {model.num_timesteps} timesteps: {type(error).__name__}: {error}"
            raise TrainingError(message) from error

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the model as RL-Zoo does. An interrupted run keeps what it can go on from, a finished one does not.

        :param model: trained model
        :raises SystemExit: SIGTERM has ended the run
        """
        super().save_trained_model(model)
        ended = model.num_timesteps >= model._total_timesteps if self.keeper is None else self.keeper.ended
        if self.keeper is not None and ended:
            self.keeper.remove()
        elif self.keeper is not None:
            midst_of_a_step = self.signals.between_steps and self.signals.at_once
            if self.signals.asked and not midst_of_a_step:
                self.keeper.save()
            print(
                f"Interrupted after {model.num_timesteps} steps; "
                f"sb3-dtfm {self.command} --resume {self.save_path} continues it."
            )
        if self.keeper is not None:
            self.keeper.release()
        for evaluation in self.evaluations[-1:] if ended and self.verbose > 0 else []:
            reached = [evaluation.last_mean_reward], evaluation._is_success_buffer
            attributes = {**vars(model), "target_return": evaluation.eval_env.get_attr("target_return")[0]}
            for sentence in compare(attributes, *reached, Path(self.save_path), self.env_name):
                print(sentence)
        if self.signals.terminated and not ended:
            raise SystemExit(128 + signal.SIGTERM)


def _as_schedule(name: str, value: Any) -> Any:
    """
    Turn text such as 1e-3, which YAML does not read as a number, into one.

    :raises UsageError: text that is neither a number nor a schedule
    """
    if not isinstance(value, str):
        return value
    with contextlib.suppress(ValueError):
        return float(value)
    try:
        float(value.partition("_")[2])
    except ValueError:
        raise UsageError(f"{name}: expected a number, or lin_0.001 for one that falls to 0, got {value!r}.") from None
    return value
