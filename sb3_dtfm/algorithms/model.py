"""A model as Stable-Baselines3 knows it: a policy, environments that it acts in, and files that run no code."""

import inspect
import io
import itertools
from collections.abc import Iterable
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule, TensorDict
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.actions import ActionSpace, same_actions
from sb3_dtfm.algorithms.loading import SAVED, SavedModel, check_policy, parameters, read_saved, wrap_file_errors
from sb3_dtfm.algorithms.options import TrainingOptions
from sb3_dtfm.algorithms.saved_options import STRUCTURED
from sb3_dtfm.algorithms.saving import (
    ENCODED,
    OPTIMIZER,
    POLICY,
    UnsavedSchedule,
    optimizer_tensors,
    optimizers,
    saved_policy_kwargs,
    to_configuration,
)
from sb3_dtfm.arguments import NOT_NEGATIVE, POSITIVE, Number, Rule, check_arguments, with_nearest
from sb3_dtfm.data import (
    DatasetError,
    ReturnReference,
    ScoreReference,
    TrajectoryBuffer,
    check_action_space,
    check_controller,
)
from sb3_dtfm.distributed import check_batch_size, is_first_process
from sb3_dtfm.envs import ReturnToGoWrapper, channels_first, check_vec_env, image_spaces, known_task, share_target_return
from sb3_dtfm.files import ModelFile, ModelFileError, file_name, holds_pickles, read_model, write_model, write_onnx
from sb3_dtfm.optimization import RunningMeans
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.exported import ExportedPolicy

# The names of an algorithm's one policy: Stable-Baselines3's for dictionaries, which it observes, for vectors and images.
POLICY_NAMES = ("MultiInputPolicy", "MlpPolicy", "CnnPolicy")

# Arguments of an algorithm, beside TrainingOptions, that are numbers.
ACCEPTED: dict[str, Rule] = {
    "seed": Number(low=0, high=2**32 - 1, whole=True, optional=True),
    "target_return": Number(optional=True),
}

# Attributes of all models that a file may hold.
KNOWN = {*SAVED, *STRUCTURED, *ACCEPTED, *TrainingOptions.__dataclass_fields__}

SelfModel = TypeVar("SelfModel", bound="SequenceModel")


class SequenceModel(BaseAlgorithm):
    """
    A sequence policy with its environment: built, saved, loaded, exported. It acts; `OfflineAlgorithm` learns, too.

    :param policy: name or class of the policy
    :param env: environment that the model acts in, or its Gymnasium id
    :param options: options of training, which become attributes
    :param learning_rate: learning rate; this and further arguments are those of `OfflineAlgorithm`
    :param policy_kwargs: arguments of the policy
    :param tensorboard_log: folder of the TensorBoard log
    :param verbose: 0 silent, 1 prints the log
    :param seed: seed of weights, batches and acting
    :param device: "auto", "cpu" or "cuda"
    :ivar target_return: target return for acting, environment reward units; given to each environment of the model that is
        wrapped without a target. None if a file does not tell
    :ivar controller: robot, controller and control frequency of the dataset's actions, by robosuite's names, which an
        environment must have, too; None where the data do not tell, or are meant for another environment (`env_id`)
    :ivar buffer: recorded episodes that it learns from; None if the model only acts
    """

    policy: SequencePolicy
    action_space: ActionSpace
    batch_size: int
    context_length: int
    return_weighting: float
    weight_decay: float
    learning_rate_schedule: str
    warmup_steps: int
    max_grad_norm: float | None
    ema_decay: float
    precision: str
    compile: bool | None

    def __init__(
        self,
        policy: str | type[SequencePolicy],
        env: GymEnv | str | None,
        options: TrainingOptions,
        learning_rate: float | Schedule,
        policy_kwargs: dict[str, Any] | None,
        tensorboard_log: str | None,
        verbose: int,
        seed: int | None,
        device: th.device | str,
    ) -> None:
        super().__init__(
            self._get_policy_from_name(policy) if isinstance(policy, str) else policy,
            env,
            learning_rate,
            policy_kwargs=saved_policy_kwargs(policy_kwargs),
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            supported_action_spaces=(spaces.Box, spaces.Discrete),
        )
        self.target_return: float | None = None
        if self.env is not None:
            self._policy_class.head_for(self.action_space)  # before the data are read, which may take long
            self.target_return = share_target_return(self.env, None)
        vars(self).update(vars(options))
        self.max_timestep = 1000
        self.score_reference: ScoreReference | None = None
        self.return_reference: ReturnReference | None = None
        self.controller: dict[str, Any] | None = None
        self.buffer: TrajectoryBuffer | None = None
        self._means = RunningMeans()
        self._last_saved: str | None = None  # file that this object wrote last

    def _check_arguments(self, learning_rate: Rule) -> None:
        """
        :param learning_rate: rule for a learning rate that is a number: 0 is for those who load a model to act with it
        :raises ValueError: an argument out of range, by name
        """
        if isinstance(self.learning_rate, UnsavedSchedule) and learning_rate is POSITIVE:
            self.learning_rate.check()
        accepted = ACCEPTED if callable(self.learning_rate) else {**ACCEPTED, "learning_rate": learning_rate}
        vars(self).update({**vars(TrainingOptions.of(vars(self))), **check_arguments(vars(self), accepted)})
        if self.batch_size is not None:
            check_batch_size(self.batch_size)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        """
        :raises ValueError: there is none of that name
        """
        if policy_name not in self.policy_aliases:
            first, *others = map(repr, self.policy_aliases)
            raise ValueError(f"policy must be {first} (or {', '.join(others)}), got {policy_name!r}.")
        return self.policy_aliases[policy_name]

    def _setup_model(self) -> None:
        self._check_arguments(learning_rate=NOT_NEGATIVE)
        if self.score_reference is not None:  # a list in a saved file
            self.score_reference = ScoreReference(*self.score_reference)
        if self.return_reference is not None:
            self.return_reference = ReturnReference(*self.return_reference)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._make_policy(ema=self.ema_decay > 0).to(self.device)

    @property
    def _policy_class(self) -> type[SequencePolicy]:
        if not issubclass(self.policy_class, SequencePolicy):
            raise ValueError(
                f"policy is {self.policy_class.__name__}, which belongs to another algorithm than {type(self).__name__}."
            )
        return self.policy_class

    def _make_policy(self, ema: bool) -> SequencePolicy:
        return self._policy_class(
            self.observation_space,  # type: ignore[arg-type]
            self.action_space,
            self.lr_schedule,
            context_length=self.context_length,
            max_timestep=self.max_timestep,
            weight_decay=self.weight_decay,
            ema=ema,
            seed=self.seed,
            **self.policy_kwargs,
        )

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Seed everything random, the noise of `predict(deterministic=False)` included.

        :param seed: seed; None changes nothing
        """
        super().set_random_seed(seed)
        if seed is not None and hasattr(self, "policy"):
            self.policy.seed_noise(seed)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """
        SB3's wrapping, within it ours, then a check that return-to-go arrives unharmed and that actions can be learned.

        :raises ValueError: no return-to-go in the observation, normalised or stacked observations, or unbounded actions
        """
        if isinstance(env, gym.Env) and not is_wrapped(env, ReturnToGoWrapper):
            if verbose >= 1:
                print("Wrapping the env in a ReturnToGoWrapper.")
            env = ReturnToGoWrapper(env)
        if isinstance(env, gym.vector.VectorEnv):  # type: ignore[unreachable]
            raise ValueError(
                f"env is a {type(env).__name__}: write make_vec_env(env_id, n_envs) of Stable-Baselines3 instead."
            )
        vec_env = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        check_vec_env(vec_env)
        check_action_space(vec_env.action_space, "the environment")
        return vec_env

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Act in another environment from now on.

        :param env: environment of the model's sizes and range of actions; the bounds of observations may differ, since the
            policy normalises them itself. It is wrapped as in the constructor, and takes the model's `target_return` if it
            has none
        :param force_reset: whether the environment is reset before the next step, as in SB3
        :raises ValueError: it does not fit
        """
        vec_env = self._wrap_env(env, self.verbose)
        action_space = check_action_space(vec_env.action_space, "the environment")
        self._check_spaces(vec_env.observation_space, action_space, "The environment has", "the model's are")
        if self.buffer is not None:
            self._check_task(self.buffer, vec_env)
        self.check_controller(vec_env)
        self.observation_space, self.action_space = vec_env.observation_space, action_space
        self.n_envs = vec_env.num_envs
        self.target_return = share_target_return(vec_env, self.target_return)
        super().set_env(vec_env, force_reset)

    def _check_spaces(self, observation_space: spaces.Space, action_space: ActionSpace, found: str, expected: str) -> None:
        """
        Compare with the model's spaces what the policy depends on: sizes, and the range of actions.

        :raises DatasetError: they do not fit
        """
        ours, theirs = self.observation_space["observation"], observation_space["observation"]  # type: ignore[index]
        if ours.shape != theirs.shape:
            raise DatasetError(f"{found} observations of {theirs}, {expected} {ours}.")
        own, others = (
            {camera: channels_first(image).shape for camera, image in image_spaces(space).items()}
            for space in (self.observation_space, observation_space)
        )
        if own != others:
            raise DatasetError(f"{found} images {others or 'of no camera'}, {expected} {own or 'of no camera'}.")
        if not same_actions(self.action_space, action_space):
            raise DatasetError(f"{found} actions of {action_space}, {expected} {self.action_space}.")

    @staticmethod
    def _check_task(buffer: TrajectoryBuffer, env: VecEnv) -> None:
        """
        :raises DatasetError: the data were recorded in another environment
        """
        if (task := known_task(env)) is not None:
            buffer.check_task(task.env_id)

    def check_controller(self, env: VecEnv, name: str = "the environment") -> None:
        """
        Refuse an environment in which an action does something else than in the data.

        :param env: environment wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
        :param name: name of the environment, for messages
        :raises DatasetError: its robot, controller or control frequency is another than :attr:`controller`
        """
        check_controller(self.controller, env.get_attr("env_args", [0])[0], name)

    @classmethod
    def load(
        cls: type[SelfModel],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        allow_pickle: bool = False,
        **kwargs: Any,
    ) -> SelfModel:
        """
        SB3's loading, which runs nothing that a file holds; arguments are SB3's but for `allow_pickle`.

        :param path: file to load
        :param env: environment to act in, see :meth:`set_env`
        :param device: "auto", "cpu" or "cuda"
        :param custom_objects: attributes to use in place of those in the file
        :param print_system_info: whether to print the system info that the file holds, as in SB3
        :param force_reset: whether the environment is reset before the next step, as in SB3
        :param allow_pickle: whether to load files in SB3's format, whose pickles run code of their author; for trusted files
        :param kwargs: attributes to change, `dataset` for example
        :raises ModelFileError: the file is damaged, pickled, of another algorithm, or holds what no model can have
        :raises ValueError: an attribute out of range or of another name, or an environment that does not fit
        """
        if allow_pickle and holds_pickles(path):
            model = super().load(path, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        else:
            model = cls._from_saved(path, device, custom_objects or {}, print_system_info, kwargs)
        model.policy.set_weight_decay(model.weight_decay)  # the optimiser's state in the file brings that of its own
        if env is not None:
            model.set_env(env, force_reset)
            model.set_random_seed(model.seed)  # the environments', too
        return model

    @classmethod
    def _from_saved(
        cls: type[SelfModel],
        path: str | Path | io.BufferedIOBase,
        device: th.device | str,
        custom_objects: dict[str, Any],
        print_system_info: bool,
        changed: dict[str, Any],
    ) -> SelfModel:
        """
        A model of the plain data that a file holds; parameters and errors are those of :meth:`load`.

        :param changed: attributes to change, by name
        """
        saved = read_saved(path, cls.policy_aliases, custom_objects, get_device(device), print_system_info)
        attributes, source = saved.attributes, saved.source
        if "policy_kwargs" in changed:
            changed = {**changed, "policy_kwargs": saved_policy_kwargs(changed["policy_kwargs"])}
        if changed.get("policy_kwargs", attributes.get("policy_kwargs")) != attributes.get("policy_kwargs"):
            raise ValueError(
                f"policy_kwargs are what the weights of {source} were made with, {attributes.get('policy_kwargs')}, and "
                f"cannot be changed: got {changed['policy_kwargs']}."
            )
        model = cls(attributes["policy_class"], device=device, _init_setup_model=False)  # type: ignore[call-arg]
        if attributes.get("online_actor") is not None and not hasattr(model, "online_actor"):
            raise ModelFileError(
                f"{source} is a fine-tuned DTFM: sb3_dtfm.finetuning.FinetunedDTFM loads it. To fine-tune further, "
                "`sb3-dtfm finetune -i` takes the agent.zip beside it, and --model the DTFM that it began with."
            )
        accepted = model._saved_names() | ENCODED | set(custom_objects)
        for name in attributes:
            if name not in accepted:
                raise ModelFileError(f"{source}: {name!r} is no attribute that a {cls.__name__} is saved with.")
        vars(model).update(attributes)
        known = {*vars(model), *inspect.signature(cls).parameters}
        if unknown := sorted(set(changed) - known):
            raise ValueError(f"load: {with_nearest(unknown, known)}: no attribute of {cls.__name__}.")
        model._check_saved(saved)
        vars(model).update(changed)
        model._setup_model()
        with wrap_file_errors(source):
            model.set_parameters(parameters(model.policy, saved.tensors, source), device=device)
        return model

    def _check_saved(self, saved: SavedModel) -> None:
        """
        Refuse the tensors of a file that such a model cannot have.

        :raises ModelFileError: more layers than there are tensors, or others than these settings make
        """
        tensors, source = saved.tensors[POLICY], saved.source
        with wrap_file_errors(source):
            self._check_arguments(learning_rate=NOT_NEGATIVE)
            for name, value in (self.policy_kwargs or {}).items():
                if name.endswith("n_layers") and isinstance(value, int) and value > len(tensors):
                    found = f"there are {len(tensors)} tensors"
                    raise ModelFileError(f"{source}: policy_kwargs say {name}={value}, and {found}.")
            self._setup_lr_schedule()
            with th.device("meta"):
                check_policy(self._make_policy(ema=False), tensors, source)

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Set parameters as SB3 does, from a file as :meth:`save` makes them.

        :param load_path_or_dict: file, or parameters as from `get_parameters`
        :param exact_match: whether all parameters have to be there, and no others
        :param device: device to load the parameters to
        :raises ModelFileError: the file is damaged, pickled, or of another model
        """
        if not isinstance(load_path_or_dict, dict):
            source = file_name(load_path_or_dict)
            _, tensors = read_model(load_path_or_dict, {POLICY, OPTIMIZER}, get_device(device))
            self._check_saved(SavedModel({}, tensors, source))
            load_path_or_dict = parameters(self.policy, tensors, source)
        super().set_parameters(load_path_or_dict, exact_match, device)

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        SB3's saving, into a file of JSON and safetensors that appears when it is complete.

        On process 0 only: the others hold the same model, and would write the same file at the same time.

        :param path: file to write
        :param exclude: attributes to leave out beside the default ones
        :param include: attributes to save whatever `exclude` names; an error, not a warning, tells of one that cannot be
        :raises OSError: names the path, where what was there before still is
        :raises ValueError: an attribute of `include` that no file holds, such as an environment or the data
        """
        if not is_first_process():
            return
        wanted = set(include or ())
        left_out = {*self._excluded_save_params(), *(exclude or ())} - wanted
        tensors = {POLICY: self.get_parameters()[POLICY], OPTIMIZER: optimizer_tensors(self.policy)}
        write_model(path, ModelFile(to_configuration(self, self._saved_names(), left_out, wanted), tensors))
        self._last_saved = file_name(path)

    def export(self, path: str | PathLike[str], env_id: str | None = None, target_return: float | None = None) -> None:
        """
        Write the policy into one ONNX file, as it acts at present: solver, steps, chunks, `kv_cache`.

        Inputs and outputs are those of :class:`~sb3_dtfm.policies.exported.ExportedPolicy`; the file's metadata have JSON
        under `sb3_dtfm`: sizes, bounds, settings of acting, and what is known of the task. On process 0 only, as `save`.

        :param path: file to write, for example "policy.onnx"
        :param env_id: Gymnasium id for the metadata; by default the environment's, or the dataset's
        :param target_return: target return for the metadata, environment reward units; by default the
            environment's, or the model's
        :raises ImportError: `sb3-dtfm[export]` is not installed
        :raises OSError: names the path, where what was there before still is
        :raises ValueError: the head does what no graph holds
        """
        if not is_first_process():
            return
        if self.env is not None:
            task = known_task(self.env)
            env_id = env_id or (task.env_id if task is not None else None)
            target_return = self.env.get_attr("target_return", indices=0)[0] if target_return is None else target_return
        if env_id is None and self.buffer is not None:
            env_id = self.buffer.env_id
        target_return = self.target_return if target_return is None else target_return
        exported = ExportedPolicy(self.policy)
        about = {"algorithm": type(self).__name__, "version": version("sb3-dtfm")}
        settings = {**about, "env_id": env_id, "target_return": target_return, **exported.settings}
        write_onnx(path, exported, exported.example(), exported.outputs, settings)

    def _saved_names(self) -> set[str]:
        """Attributes that a file may hold: this package's, and of a subclass those that constructors take."""
        classes = (each for each in type(self).__mro__ if issubclass(each, SequenceModel) and each is not SequenceModel)
        given = itertools.chain.from_iterable(inspect.signature(each).parameters.values() for each in classes)
        arguments = {each.name for each in given if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)}
        return (KNOWN | arguments) - {"_init_setup_model", *self._excluded_save_params()}

    def _excluded_save_params(self) -> list[str]:
        of_an_environment = [
            "_last_obs",
            "_last_episode_starts",
            "_last_original_obs",
            "ep_info_buffer",
            "ep_success_buffer",
        ]
        made_anew = [
            "decisions",
            "lr_schedule",
            "action_noise",
            "dataset",
            "buffer",
            "_training_seconds",
            "_timed_steps",
            "_last_saved",
            "tensorboard_log",
        ]
        return [*super()._excluded_save_params(), *of_an_environment, *made_anew]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return [POLICY, *optimizers(self.policy)], []
