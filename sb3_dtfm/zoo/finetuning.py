"""RL-Zoo's experiments that start from a DTFM: noise-space RL, residual RL, or DTFM's own online fine-tuning."""

import hashlib
import inspect
import os
import shutil
import signal
from collections import OrderedDict
from pathlib import Path
from typing import Any

from rl_zoo3.utils import ALGOS, get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.algorithms import DTFM
from sb3_dtfm.arguments import with_nearest
from sb3_dtfm.callbacks import EvaluateAtStartAndEnd, SeedEvaluations
from sb3_dtfm.files import read_configuration, read_run
from sb3_dtfm.finetuning import FINETUNED, FinetunedDTFM, NoiseActionVecEnv, OnlineDTFM, ResidualActionVecEnv
from sb3_dtfm.finetuning.noise_env import NOISE_SPACE_FLOW_STEPS
from sb3_dtfm.finetuning.online import ACCEPTED
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.recording.loading import check_saved_by
from sb3_dtfm.zoo.arguments import UsageError, with_target_return
from sb3_dtfm.zoo.manager import OF_RL_ZOO, OfflineExperimentManager
from sb3_dtfm.zoo.resuming import AGENT, EPISODES, StopSignals

# Environments to learn in, by the key of their settings in a run's config.yml, where `enjoy` must not find a wrapper.
FROZEN_ENVS = {"noise_env": NoiseActionVecEnv, "residual_env": ResidualActionVecEnv}
# Arguments of an algorithm that the command line gives.
OF_THE_COMMAND = ("env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model")


class FinetunedCallbacks(BaseCallback):
    """
    Have evaluations and checkpoints see the fine-tuned model in place of the algorithm that learns its online actor.

    Until the algorithm has learned, that is the model without an actor: the curve begins at the offline policy's score.

    :param finetuned: model that acts by the algorithm's actor whenever a callback looks at it
    :param callbacks: callbacks to run with it
    :param seed: seed of the run, and of its evaluations
    :param signals: signals to stop; where one has interrupted the training, its end is not evaluated, and the model is saved
        at once
    """

    def __init__(self, finetuned: FinetunedDTFM, callbacks: list[BaseCallback], seed: int, signals: StopSignals) -> None:
        super().__init__()
        self.finetuned = finetuned
        self.signals = signals
        self.evaluations = [each for each in callbacks if isinstance(each, EvalCallback)]
        at_ends = EvaluateAtStartAndEnd(self.evaluations)
        self.inner = CallbackList([SeedEvaluations(self.evaluations, seed), *callbacks, at_ends])

    def _init_callback(self) -> None:
        self.finetuned.set_logger(self.logger)
        for evaluation in self.evaluations:
            self.finetuned.n_envs = evaluation.eval_env.num_envs
            self.finetuned.set_env(evaluation.eval_env)
        self.inner.init_callback(self.finetuned)

    def _on_training_start(self) -> None:
        self._take_over()
        self.inner.on_training_start(self.locals, self.globals)

    def _on_step(self) -> bool:
        self.finetuned.num_timesteps = self.num_timesteps
        environment: Any = self.training_env
        self.logger.record("time/environment_steps", environment.n_environment_steps)
        if any((each.n_calls + 1) % freq == 0 for each, freq in self._looking()):
            self._take_over()
        return self.inner.on_step()

    def _on_training_end(self) -> None:
        self._take_over()
        if not self.signals.asked:  # RL-Zoo calls this after an interrupt, too
            self.inner.on_training_end()

    def _looking(self) -> list[tuple[BaseCallback, int]]:
        """Return the callbacks that look at the model now and then, and how often."""
        frequencies = (
            (each, getattr(each, "eval_freq", 0) or getattr(each, "save_freq", 0)) for each in self.inner.callbacks
        )
        return [(each, frequency) for each, frequency in frequencies if frequency > 0]

    def _take_over(self) -> None:
        self.finetuned.num_timesteps = self.model.num_timesteps
        self.finetuned._n_updates = getattr(self.model, "_n_updates", 0)
        if has_learned(self.model):
            self.finetuned.take_actor(self.model)


def has_learned(agent: BaseAlgorithm) -> bool:
    """Return whether an algorithm has done a gradient step."""
    return getattr(agent, "_n_updates", 0) > 0


def keep_one_action(policy: SequencePolicy, residual: bool) -> None:
    """
    Have a model act in a way that leaves an algorithm something to choose.

    :param policy: policy of the model
    :param residual: whether residual actions are learned, not noise
    """
    if not residual and policy.network.head.noise_dim and not policy.network.head.noise_decides:
        given = policy.acting_settings()["flow_steps"]
        print(f"flow_steps={given} becomes {NOISE_SPACE_FLOW_STEPS}: else the model takes its mean action")
        policy.set_acting(flow_steps=NOISE_SPACE_FLOW_STEPS)
    if residual and policy.options.n_action_steps > 1:
        print(f"n_action_steps={policy.options.n_action_steps} becomes 1: a residual action is added to each action")
        policy.set_acting(n_action_steps=1)
    if policy.options.n_action_samples > 1:
        why = "a residual action is added to one sample" if residual else "the online algorithm chooses the noise"
        print(f"n_action_samples={policy.options.n_action_samples} becomes 1: {why}")
        policy.set_acting(n_action_samples=1)


class FinetuningManager(OfflineExperimentManager):
    """
    RL-Zoo's own manager, for what goes on from a DTFM in the environment of that DTFM's run.

    :param base: file of the DTFM, or folder of its run
    :param target_return: target return, environment reward units; that of the run, or of the file, by default
    :param evaluations_of_a_run: number of evaluations at equal shares of the timesteps; None where `eval_freq` decides
    """

    of_the_data: tuple[str, ...] = ()  # further settings of that run that count here

    def __init__(
        self,
        *args: Any,
        base: Path,
        target_return: float | None = None,
        evaluations_of_a_run: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.base, self.target_return, self.evaluations_of_a_run = base, target_return, evaluations_of_a_run
        self.base_file = base / f"{self.env_name}.zip" if base.is_dir() else base
        if not self.base_file.is_file():
            raise FileNotFoundError(f"{self.base_file} does not exist; --model names a DTFM's zip file or its run's folder.")

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read settings as RL-Zoo does; those of the environment come from the DTFM's run."""
        hyperparams, _ = super().read_hyperparameters()
        run = self.base_file.parent / self.env_name
        known = read_run(run) if (run / "config.yml").is_file() else {}
        if known.get("vec_env_wrapper") and "vec_env_wrapper" not in self.of_the_data:
            raise UsageError(
                f"--model {self.base}: it learned in {known['vec_env_wrapper']}, where an online algorithm needs a "
                "NoiseActionVecEnv or ResidualActionVecEnv; --algo dtfm continues in it."
            )
        from_the_run = ["env_wrapper", *([] if self.env_kwargs else ["env_kwargs"])]  # of the command line, if given there
        from_the_run += self.of_the_data
        hyperparams = {**{key: known[key] for key in from_the_run if known.get(key)}, **hyperparams}
        self.evaluate_alike(hyperparams)
        target_return = self.target_return
        if target_return is None and not hyperparams.get("env_wrapper"):
            target_return = read_configuration(self.base_file)["attributes"].get("target_return")
        if target_return is not None:
            hyperparams["env_wrapper"] = with_target_return(target_return, hyperparams.get("env_wrapper"))
        if not hyperparams.get("env_wrapper"):
            raise UsageError(
                f"--target-return R: needed, as {self.base} was saved without one; `sb3-dtfm inspect DATASET` suggests one."
            )
        if self.evaluations_of_a_run is not None:
            n_timesteps = self.n_timesteps if self.n_timesteps > 0 else hyperparams["n_timesteps"]
            self.eval_freq = max(int(n_timesteps) // self.evaluations_of_a_run, 1)
        return hyperparams, OrderedDict(sorted(hyperparams.items()))


class FinetunedManager(FinetuningManager):
    """
    An online algorithm learns in a :class:`~sb3_dtfm.finetuning.NoiseActionVecEnv`, or in a
    :class:`~sb3_dtfm.finetuning.ResidualActionVecEnv`.

    The fine-tuned model is evaluated and saved, in the folder of a run of "finetuned"; beside it the algorithm itself.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.sha256 = hashlib.sha256(self.base_file.read_bytes()).hexdigest()
        if self.trained_agent:
            try:
                check_saved_by(ALGOS[self.algo], Path(self.trained_agent))
            except ValueError as error:
                raise UsageError(f"-i: {error} It takes the {AGENT}.zip of a run of `finetune`.") from error
            self._check_same_model(Path(self.trained_agent))
        self.finetuned = FinetunedDTFM.of(DTFM.load(self.base_file, device=self.device))
        name = Path(self.save_path).name.removeprefix(f"{self.env_name}_")
        uuid = name.lstrip("0123456789")
        self.log_path = f"{self.log_folder}/{FINETUNED}/"
        number = get_latest_run_id(self.log_path, self.env_name) + 1
        self.save_path = os.path.join(self.log_path, f"{self.env_name}_{number}{uuid}")
        self.params_path = f"{self.save_path}/{self.env_name}"

    def _check_same_model(self, agent: Path) -> None:
        """
        :raises UsageError: the agent learned the noise or the residual actions of another DTFM
        """
        run = agent.parent / self.env_name
        known = read_run(run) if (run / "config.yml").is_file() else {}
        about: dict[str, Any] = next((known[key] for key in FROZEN_ENVS if key in known), {})
        if about.get("sha256", self.sha256) != self.sha256:
            raise UsageError(f"-i {agent}: learned on {about.get('model')}, not on these weights of {self.base_file}.")

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read the settings of the online algorithm, and of the wrapper that it learns in."""
        hyperparams, _ = super().read_hyperparameters()
        key, arguments = self._frozen_env(hyperparams)
        residual = FROZEN_ENVS[key] is ResidualActionVecEnv
        print(f"{self.algo.upper()} {'adds residual actions to those' if residual else 'chooses the noise'} of {self.base}")
        keep_one_action(self.finetuned.policy, residual)
        saved = {name: value for name, value in hyperparams.items() if name != "vec_env_wrapper"}
        saved[key] = {**arguments, "algorithm": self.algo, "model": str(self.base_file), "sha256": self.sha256}
        path = f"{FROZEN_ENVS[key].__module__}.{FROZEN_ENVS[key].__name__}"
        hyperparams["vec_env_wrapper"] = [{path: {**arguments, "model": self.finetuned}}]
        return hyperparams, OrderedDict(sorted(saved.items()))

    @staticmethod
    def _frozen_env(hyperparams: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        """
        The key in `FROZEN_ENVS` of what the settings name, and its arguments.

        :raises UsageError: another wrapper of vectorised environments
        """
        wrappers = hyperparams.get("vec_env_wrapper") or [f"{NoiseActionVecEnv.__module__}.{NoiseActionVecEnv.__name__}"]
        wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
        name, arguments = next(iter(wrappers[0].items())) if isinstance(wrappers[0], dict) else (wrappers[0], {})
        key = next((key for key, each in FROZEN_ENVS.items() if name.endswith(f".{each.__name__}")), None)
        if len(wrappers) > 1 or key is None:
            known = " or ".join(f"sb3_dtfm.finetuning.{each.__name__}" for each in FROZEN_ENVS.values())
            raise UsageError(f"vec_env_wrapper: {wrappers}; expected {known} alone.")
        return key, dict(arguments or {})

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Create environments as RL-Zoo does; the fine-tuned model is evaluated in the environment itself."""
        wrapper = self.vec_env_wrapper
        try:
            if eval_env:
                self.vec_env_wrapper = None
            return super().create_envs(n_envs, eval_env, no_log)
        finally:
            self.vec_env_wrapper = wrapper

    def create_callbacks(self) -> None:
        """Create callbacks as RL-Zoo does; evaluations and checkpoints are of the fine-tuned model."""
        super().create_callbacks()
        of_the_model: list[BaseCallback] = [
            each for each in self.callbacks if isinstance(each, EvalCallback | CheckpointCallback)
        ]
        others = [each for each in self.callbacks if each not in of_the_model]
        if self.save_freq > 0:  # RL-Zoo has divided it by the number of environments
            others.append(CheckpointCallback(self.save_freq, self.save_path, name_prefix=AGENT))
        self.callbacks = [*others, FinetunedCallbacks(self.finetuned, of_the_model, self.seed, self.signals)]

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        Set up as RL-Zoo does.

        :raises ValueError: an actor that cannot be taken over, or a replay buffer of another number of environments
        """
        try:
            result = super().setup_experiment()
            assert result is not None
            FinetunedDTFM.of(self.finetuned, result[0])
        except ValueError:
            shutil.rmtree(self.save_path, ignore_errors=True)
            raise
        return result

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        """Load an agent as RL-Zoo does, with the replay buffer beside it."""
        model = super()._load_pretrained_agent(hyperparams, env)
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None and buffer.n_envs != env.num_envs:
            raise UsageError(
                f"-i {self.trained_agent}: its replay buffer has {buffer.n_envs} environments, this run has {env.num_envs}; "
                f"use -params n_envs:{buffer.n_envs}."
            )
        return model

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the fine-tuned model where RL-Zoo looks for one, and the algorithm beside it, to go on with.

        :param model: the online algorithm
        :raises SystemExit: SIGTERM has ended the run
        """
        print(f"Saving to {self.save_path}")
        if has_learned(model):
            self.finetuned.take_actor(model)
        self.finetuned.save(os.path.join(self.save_path, f"{self.env_name}.zip"))
        model.save(os.path.join(self.save_path, AGENT))
        if self.save_replay_buffer and isinstance(model, OffPolicyAlgorithm):
            model.save_replay_buffer(os.path.join(self.save_path, "replay_buffer.pkl"))
        if self.signals.asked:
            print(
                f"Interrupted after {model.num_timesteps} decisions; "
                f"-i {self.save_path}/{AGENT}.zip continues it in a new run."
            )
        if self.signals.terminated:
            raise SystemExit(128 + signal.SIGTERM)


class OnlineManager(FinetuningManager):
    """
    The DTFM itself learns further, as an :class:`~sb3_dtfm.finetuning.OnlineDTFM`. The result is a run of "dtfm".

    The dataset is that of the DTFM's run. Own episodes are saved beside the model, and loaded by a run that starts from it.
    """

    command = "finetune"
    of_the_data = ("dataset", "dataset_kwargs", "vec_env_wrapper")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.continue_training and not self.has_checkpoint:
            raise UsageError(
                f"-i {self.trained_agent}: --model names the model to fine-tune; its run's own episodes come with it."
            )
        if not self.has_checkpoint:
            self.trained_agent, self.continue_training = str(self.base_file), True
        self.save_replay_buffer = False  # it is saved as episodes.npz
        self.signals.between_steps = False  # a round has many steps, and none is repeated to the bit anyway

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Read the settings of online learning.

        :raises UsageError: no dataset, or a name that it does not know
        """
        hyperparams, saved = super().read_hyperparameters()
        known = {*inspect.signature(DTFM).parameters, *ACCEPTED, *OF_RL_ZOO} - set(OF_THE_COMMAND)
        unknown = sorted(set(hyperparams) - known)
        if unknown:
            raise UsageError(f"{with_nearest(unknown, sorted(known))}: no hyperparameter of finetune --algo dtfm.")
        if "policy_kwargs" in hyperparams:
            raise UsageError("policy_kwargs: are those of the model that goes on, and cannot be changed.")
        if not hyperparams.get("dataset"):
            raise UsageError(f"-params dataset:...: needed, as {self.base} does not tell what it learned from.")
        return hyperparams, saved

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        """Load an agent as RL-Zoo does, by this algorithm."""
        settings = {key: value for key, value in hyperparams.items() if key != "policy"}
        about: dict[str, Any] = dict(
            seed=self.seed, tensorboard_log=self.tensorboard_log, verbose=self.verbose, device=self.device
        )
        model = OnlineDTFM.load(self.trained_agent, env, **about, **settings)
        own = Path(self.trained_agent).with_name(EPISODES)
        if own.is_file():
            model.load_replay_buffer(own)
        if not self.has_checkpoint:
            model.num_timesteps = 0  # those of the model's own training are not this run's
        else:  # not the episodes once more that it began with
            seed = (self.seed + model.num_timesteps) % 2**31
            env.seed(seed)
            model.policy.seed_noise(seed)
        return model

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Create environments as RL-Zoo does; a resumed run appends to its monitors."""
        if self.resumed is not None:
            self.monitor_kwargs = {**self.monitor_kwargs, "override_existing": False}
        return super().create_envs(n_envs, eval_env, no_log)

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the model as RL-Zoo does, and the own episodes.

        :param model: trained model
        :raises SystemExit: SIGTERM has ended the run
        """
        assert isinstance(model, OnlineDTFM)
        if model.replay_buffer is not None:
            model.save_replay_buffer(os.path.join(self.save_path, EPISODES))
        super().save_trained_model(model)
