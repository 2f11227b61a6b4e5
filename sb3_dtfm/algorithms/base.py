"""What an offline algorithm is made of: arguments, dataset, environment, policy, and the file it is saved to."""

import inspect
import io
from abc import ABC
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
from sb3_dtfm.algorithms.loading import check_sizes, from_file, parameters
from sb3_dtfm.algorithms.saving import OPTIMIZER, POLICY, UnsavedSchedule, optimizer_tensors, optimizers, to_configuration
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
    documented_parameters,
)
from sb3_dtfm.data import (
    Dataset,
    DatasetError,
    ReturnReference,
    ScoreReference,
    TrajectoryBuffer,
    check_action_space,
    load_dataset,
)
from sb3_dtfm.data.decisions import Decision, decide
from sb3_dtfm.data.inspection import return_reference, suggested_target_return
from sb3_dtfm.distributed import check_batch_size, is_first_process, local_rank_zero_first
from sb3_dtfm.envs import ReturnToGoWrapper, check_vec_env, known_task, return_to_go_space, share_target_return
from sb3_dtfm.files import ModelFile, file_name, holds_pickles, read_model, write_model, write_onnx
from sb3_dtfm.optimization import LEARNING_RATE_SCHEDULES, PRECISIONS, RunningMeans
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.exported import ExportedPolicy

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineAlgorithm")

# The names of an algorithm's one policy: Stable-Baselines3's for dictionaries, which is what it observes, and for vectors.
POLICY_NAMES = ("MultiInputPolicy", "MlpPolicy")
ACCEPTED: dict[str, Rule] = {
    "batch_size": COUNT._replace(optional=True),
    "weight_decay": NOT_NEGATIVE,
    "context_length": Number(low=1, high=100_000, whole=True),
    "dataset_fraction": Number(low=0, high=1, above_low=True),
    "dataset_seed": Number(low=0, whole=True),
    "return_weighting": NOT_NEGATIVE._replace(optional=True),
    "expected_return_steps": Number(low=0, whole=True, optional=True),
    "max_grad_norm": NOT_NEGATIVE._replace(optional=True),
    "warmup_steps": Number(low=0, whole=True),
    "learning_rate_schedule": Choice(LEARNING_RATE_SCHEDULES),
    "ema_decay": PROBABILITY_BELOW_1,
    "precision": Choice(PRECISIONS),
    "compile": Choice((None, *BOOLEAN.values)),
    "seed": Number(low=0, whole=True, optional=True),
    "target_return": Number(optional=True),
}
# Arguments of the algorithm that the data decide where they are None; the policy's are among `policy_kwargs`.
DECIDED = {"batch_size", "return_weighting", "expected_return_steps"}


class OfflineAlgorithm(BaseAlgorithm, ABC):
    """
    A model with the data it learns from: everything of an algorithm but its learn loop.

    :param policy: "MultiInputPolicy" (or "MlpPolicy", which is the same), or a policy class
    :param env: environment, or its Gymnasium id; optional, never used for learning. It is wrapped in
        :class:`~sb3_dtfm.envs.ReturnToGoWrapper` where it is not yet; a vectorised one has to be wrapped inside
    :param dataset: Minari id or dataset, path to a robomimic hdf5 file or to flat arrays (`.npz`, hdf5), or what is in
        memory: a dictionary of arrays, a list of episodes, an SB3 `ReplayBuffer`, a
        :class:`~sb3_dtfm.data.TrajectoryBuffer`; see :func:`~sb3_dtfm.data.load_dataset`
    :param learning_rate: AdamW's, a number or a function of the progress remaining (from 1 to 0)
    :param batch_size: windows in a gradient step, of all processes together; by default 64 of less than 10,000 recorded
        steps, and 256 of more
    :param weight_decay: AdamW's, on weight matrices only
    :param context_length: K, steps the policy sees
    :param dataset_fraction: share of the episodes to learn from, randomly drawn
    :param dataset_seed: seed of that draw alone, so that different runs learn from the same episodes
    :param return_weighting: w: of mixed data, a step of the best episode is learned from 1 + w times as often as one of the
        worst, and others by their returns in between (Yue et al., 2022); 0 learns from all alike. By default 5 where
        returns tell how episodes act, and 0 elsewhere
    :param expected_return_steps: n: a step's return-to-go is the rewards of n steps and the return expected after such an
        observation, so that a high target return does not stand for chance (Paster et al., 2022); 0 takes the recorded
        one. By default 50 where returns tell how episodes act and no number makes up half of the rewards, and 0 elsewhere
    :param dataset_kwargs: further arguments of :func:`~sb3_dtfm.data.load_dataset`: `{"cache_dir": folder}` for datasets
        larger than memory, `{"env_id": id}` for data that were recorded under another environment's name, and the
        reader's own, for example `{"filter_key": "train"}` for robomimic. `max_episode_steps` is the environment's unless
        it is given, and stays the model's when it is saved: what episodes hold beyond it is left out, since no episode of
        the environment gets there; None keeps it
    :param max_grad_norm: clip the gradient's norm to this; None and 0 do not clip
    :param warmup_steps: gradient steps over which the learning rate rises linearly from zero; 0 for none
    :param learning_rate_schedule: factor on the learning rate: "constant", or "linear" or "cosine" down to zero
    :param ema_decay: decay of the exponential moving average of weights that acts; 0 acts with the trained weights
    :param precision: of matrix products: "float32", "bfloat16" (autocast), or "auto": bfloat16 where the hardware has
        instructions for it, on a CPU only if it is the faster one for this model, which is measured once
    :param compile: compile the loss with `torch.compile`; None does so on a GPU, where one process starts its kernels as a
        CUDA graph. It takes a minute, and a C++ compiler
    :param policy_kwargs: arguments of the policy, for example `embed_dim`, `n_layers`, `n_heads`, `dropout`, `kv_cache`. The
        data decide `dropout`, `chunk_size`, `flow_steps`, `regression_coef`, `timestep_embedding`, `observation_scaling`,
        `return_conditioning` and `return_range` where they are not given, see :mod:`sb3_dtfm.data.decisions`
    :param stats_window_size: as in SB3; offline learning collects no episodes
    :param tensorboard_log: folder of the TensorBoard log, None for no log
    :param verbose: 0 silent, 1 prints the log
    :param seed: seed of weights, batches and acting
    :param device: "auto", "cpu" or "cuda"
    :param _init_setup_model: build the network at once
    :ivar target_return: to ask for, environment reward units: the environment's, or where it has none the mean return of the
        best tenth of the recorded episodes, which `sb3-dtfm inspect` suggests. It is saved with the model, and given to each
        environment of the model that is wrapped without a target. None where a file does not tell
    :raises ValueError: no dataset, an argument out of range, or an environment that does not fit
    :raises DatasetError: the dataset cannot be read, or does not fit the environment
    """

    policy: SequencePolicy
    action_space: ActionSpace

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """`help` of an algorithm with a policy of its own lists all parameters, those of policy and head, too."""
        super().__init_subclass__(**kwargs)
        policy = vars(cls).get("policy_aliases", {}).get(POLICY_NAMES[0])
        if isinstance(policy, type) and issubclass(policy, SequencePolicy):
            head_options = set(policy.head_class.options())
            parts = [
                inspect.cleandoc(cls.__doc__ or ""),
                documented_parameters(OfflineAlgorithm),
                "`policy_kwargs` may hold:",
                documented_parameters(SequencePolicy, policy.parameter_names() - head_options),
                documented_parameters(policy.head_class, head_options),
            ]
            cls.__doc__ = "\n\n".join(filter(None, parts))

    def __init__(
        self,
        policy: str | type[SequencePolicy],
        env: GymEnv | str | None = None,
        dataset: Dataset | None = None,
        learning_rate: float | Schedule = 1e-3,
        batch_size: int | None = None,
        weight_decay: float = 1e-3,
        context_length: int = 1,
        dataset_fraction: float = 1.0,
        dataset_seed: int = 0,
        return_weighting: float | None = None,
        expected_return_steps: int | None = None,
        dataset_kwargs: dict[str, Any] | None = None,
        max_grad_norm: float | None = None,
        warmup_steps: int = 100,
        learning_rate_schedule: str = "cosine",
        ema_decay: float = 0.999,
        precision: str = "float32",
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
            self._get_policy_from_name(policy) if isinstance(policy, str) else policy,
            env,
            learning_rate,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
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
        self.dataset = dataset
        self.batch_size: int = batch_size  # type: ignore[assignment]  # None until the data have decided
        self.weight_decay = weight_decay
        self.context_length = context_length
        self.dataset_fraction = dataset_fraction
        self.dataset_seed = dataset_seed
        self.return_weighting: float = return_weighting  # type: ignore[assignment]  # as batch_size
        self.expected_return_steps: int = expected_return_steps  # type: ignore[assignment]  # as batch_size
        self.dataset_kwargs = dataset_kwargs
        self.max_grad_norm = max_grad_norm
        self.warmup_steps = warmup_steps
        self.learning_rate_schedule = learning_rate_schedule
        self.ema_decay = ema_decay
        self.precision = precision
        self.compile = compile
        self.max_timestep = 1000
        self.time_limit: int | None = None  # of the newest environment that it learned for
        self.score_reference: ScoreReference | None = None
        self.decisions: list[Decision] = []
        self.return_reference: ReturnReference | None = None
        self.buffer: TrajectoryBuffer | None = None
        self._means = RunningMeans()
        self._training_seconds, self._timed_steps = 0.0, 0
        self._last_saved: str | None = None  # by this object
        self._training_seed: int | None = None  # where `seed` is None
        if _init_setup_model:
            self._check_arguments(learning_rate=POSITIVE)
            buffer = self._read_dataset()
            self.max_timestep = int(buffer.episode_lengths.max())
            self._decide(buffer)
            taken = self._learn_from(buffer)
            self.score_reference = buffer.score_reference
            self._setup_model()
            normalization = self.policy.normalization
            normalization.set_statistics(*buffer.statistics())
            if normalization.return_mean is not None:
                normalization.set_return_to_go_moments(taken.return_to_go_moments())
            if normalization.return_to_go_range is not None:
                normalization.set_return_to_go_range(taken.return_to_go_range())
            if self.policy.critic is not None:
                self.policy.critic.set_scale(buffer.largest_discounted_return(self.policy.gamma))

    def _decide(self, buffer: TrajectoryBuffer) -> None:
        """Have the data decide of the policy's arguments what the user has left open; they are saved with the others."""
        given = self.policy_kwargs or {}
        names = self._policy_class.parameter_names() - set(given)
        names |= {name for name in DECIDED if getattr(self, name) is None}
        if given.get("flow_steps") == 0:  # the mean action, which a regression learns
            names.discard("regression_coef")
        if given.get("return_conditioning") is False:
            names.discard("expected_return_steps")
        if given.get("regression_coef") == 0 or given.get("critic_steps"):  # no mean action; a choice among draws
            names.discard("flow_steps")
        self.decisions = [each for each in decide(buffer) if each.name in names]
        values = {each.name: each.value for each in self.decisions}
        for name in DECIDED & set(values):
            setattr(self, name, values.pop(name))
        self.policy_kwargs = {**values, **given}

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        """
        :raises ValueError: there is none of that name
        """
        if policy_name not in self.policy_aliases:
            first, *others = map(repr, self.policy_aliases)
            raise ValueError(f"policy must be {first} (or {', '.join(others)}), got {policy_name!r}.")
        return self.policy_aliases[policy_name]

    def _check_arguments(self, learning_rate: Rule) -> None:
        """
        :param learning_rate: what a number may be that is given as such: 0 is for those who load a model to act with it
        """
        if isinstance(self.learning_rate, UnsavedSchedule) and learning_rate is POSITIVE:
            self.learning_rate.check()
        accepted = ACCEPTED if callable(self.learning_rate) else {**ACCEPTED, "learning_rate": learning_rate}
        vars(self).update(check_arguments(vars(self), accepted))
        if self.batch_size is not None:
            check_batch_size(self.batch_size)

    def set_dataset(self, dataset: Dataset) -> None:
        """
        Learn from another dataset from now on; normalisation and spaces stay those of the model.

        :param dataset: as in the constructor
        :raises DatasetError: it cannot be read, or does not fit the model
        """
        self.dataset, self.decisions = dataset, []
        self._load_buffer()

    def _load_buffer(self) -> TrajectoryBuffer:
        """The dataset of a model whose settings stand, as it is learned from."""
        return self._learn_from(self._read_dataset())

    def _read_dataset(self) -> TrajectoryBuffer:
        """Read the dataset and check it against the spaces, which it defines where there is no environment."""
        if self.dataset is None:
            name = type(self).__name__
            raise ValueError(
                f"{name} has no dataset to learn from: give one to the constructor, or to a loaded model by "
                f"{name}.load(path, dataset=...) or model.set_dataset(...)."
            )
        if self.env is not None and (task := known_task(self.env)) is not None:
            self.time_limit = task.max_episode_steps
        known = {"action_space": getattr(self, "action_space", None), "max_episode_steps": self.time_limit}
        with local_rank_zero_first():
            buffer = load_dataset(self.dataset, **{**known, **(self.dataset_kwargs or {})})
        observation_space = return_to_go_space(buffer.observation_space)
        if getattr(self, "observation_space", None) is None:
            self.observation_space, self.action_space, self.n_envs = observation_space, buffer.action_space, 1
        self._check_spaces(observation_space, buffer.action_space, f"{buffer.source} holds", "the environment's are")
        if self.env is not None:
            self._check_task(buffer, self.env)
        buffer = buffer.random_fraction(self.dataset_fraction, self.dataset_seed)
        if self.target_return is None:
            self._take_target_return(suggested_target_return(buffer))
        self.return_reference = return_reference(buffer)
        return buffer

    def _learn_from(self, buffer: TrajectoryBuffer) -> TrajectoryBuffer:
        """
        Learn from these episodes from now on.

        :return: them, with the returns-to-go that the model is conditioned on
        """
        if self.expected_return_steps:
            if self.verbose >= 1 and is_first_process():
                print(
                    f"Learning which returns may be expected (expected_return_steps={self.expected_return_steps})",
                    flush=True,
                )
            buffer = buffer.to("cpu").with_expected_returns(self.expected_return_steps, self.dataset_seed)
        self.buffer = buffer.to(self.device)
        return self.buffer

    def _take_target_return(self, target_return: float) -> None:
        """
        Have the model and its environment ask for what the data suggest.

        :param target_return: environment reward units
        """
        self.target_return = target_return
        if self.env is None:
            return
        share_target_return(self.env, target_return)
        if self.verbose >= 1 and is_first_process():
            what = "as `sb3-dtfm inspect` suggests of the recorded returns"
            print(f"The environment asks for target_return={target_return:g}, {what}.", flush=True)

    def _check_spaces(self, observation_space: spaces.Space, action_space: ActionSpace, found: str, expected: str) -> None:
        """
        Compare with the model's spaces what the policy depends on: sizes, and the range of actions.

        :raises DatasetError: they do not fit
        """
        ours, theirs = self.observation_space["observation"], observation_space["observation"]  # type: ignore[index]
        if ours.shape != theirs.shape:
            raise DatasetError(f"{found} observations of {theirs}, {expected} {ours}.")
        if not same_actions(self.action_space, action_space):
            raise DatasetError(f"{found} actions of {action_space}, {expected} {self.action_space}.")

    @staticmethod
    def _check_task(buffer: TrajectoryBuffer, env: VecEnv) -> None:
        """
        :raises DatasetError: the data were recorded in another environment
        """
        if (task := known_task(env)) is not None:
            buffer.check_task(task.env_id)

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
        assert issubclass(self.policy_class, SequencePolicy)
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

        :param seed: None changes nothing
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

        :param env: of the model's sizes and range of actions; the bounds of observations may differ, since the policy
            normalises them itself. It is wrapped as in the constructor, and asks for the model's `target_return` where it
            has no target of its own
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
        self.target_return = share_target_return(vec_env, self.target_return)
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
        allow_pickle: bool = False,
        **kwargs: Any,
    ) -> SelfAlgorithm:
        """
        SB3's loading, which runs nothing that a file holds; arguments are SB3's but for `allow_pickle`.

        :param path: file to load
        :param env: see :meth:`set_env`
        :param device: "auto", "cpu" or "cuda"
        :param custom_objects: attributes to use in place of those in the file
        :param print_system_info: print what the file was saved with
        :param force_reset: as in SB3
        :param allow_pickle: load files as SB3 saves them, and this package once did. That runs whatever their author wished
            to be run: for files that you trust
        :param kwargs: attributes to change, `dataset` for example
        :raises ModelFileError: the file is damaged, pickled, of another algorithm, or holds what no model can have
        :raises ValueError: an attribute out of range, or an environment that does not fit
        """
        if allow_pickle and holds_pickles(path):
            model = super().load(path, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        else:
            model = from_file(cls, path, device, custom_objects or {}, print_system_info, kwargs)
        model.policy.set_weight_decay(model.weight_decay)  # the optimiser's state in the file brings that of its own
        if env is not None:
            model.set_env(env, force_reset)
            model.set_random_seed(model.seed)  # the environments', too
        return model

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        SB3's, from a file as :meth:`save` makes them.

        :param load_path_or_dict: the file, or what `get_parameters` gives
        :param exact_match: all parameters have to be there, and no others
        :param device: where they are loaded to
        :raises ModelFileError: the file is damaged, pickled, or of another model
        """
        if not isinstance(load_path_or_dict, dict):
            source = file_name(load_path_or_dict)
            _, tensors = read_model(load_path_or_dict, {POLICY, OPTIMIZER}, get_device(device))
            check_sizes(self, tensors[POLICY], source)
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
        :param include: attributes to save although they are left out by default
        :raises OSError: names the path, where what was there before still is
        :raises ValueError: an attribute of `include` that is no plain value
        """
        if not is_first_process():
            return
        wanted = set(include or ())
        left_out = {*self._excluded_save_params(), *(exclude or ())} - wanted
        tensors = {POLICY: self.get_parameters()[POLICY], OPTIMIZER: optimizer_tensors(self.policy)}
        write_model(path, ModelFile(to_configuration(self, left_out, wanted), tensors))
        self._last_saved = file_name(path)

    def export(self, path: str | PathLike[str], env_id: str | None = None, target_return: float | None = None) -> None:
        """
        Write the policy into one ONNX file, as it acts at present: solver, steps, chunks, `kv_cache`.

        Inputs and outputs are those of :class:`~sb3_dtfm.policies.exported.ExportedPolicy`; the file's metadata have JSON
        under `sb3_dtfm`: sizes, bounds, settings of acting, and what is known of the task. On process 0 only, as `save`.

        :param path: file to write, for example "policy.onnx"
        :param env_id: Gymnasium id for the metadata; by default the environment's, or the dataset's
        :param target_return: for the metadata, environment reward units; by default the environment's, or the model's
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
        ]
        return [*super()._excluded_save_params(), *of_an_environment, *made_anew]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return [POLICY, *optimizers(self.policy)], []
