"""Environments of online algorithms that choose how a frozen policy acts."""

from os import PathLike

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_dtfm.algorithms import DTFM
from sb3_dtfm.algorithms.model import SequenceModel
from sb3_dtfm.arguments import POSITIVE, check_arguments
from sb3_dtfm.envs import BETWEEN, OBSERVATION, RETURN_TO_GO, TIMESTEP, check_vec_env, share_target_return
from sb3_dtfm.finetuning.online_actor import actor_observation
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.context import Context
from sb3_dtfm.policies.normalization import OBSERVATION_CLIP
from sb3_dtfm.windows import Windows


class FrozenPolicyVecEnv(VecEnvWrapper):
    """
    One step is one decision of a frozen DTFM, of which an online algorithm chooses a part.

    The observation is one vector, in the units of the model's training data and clipped at 10: the environment's
    observation, the return-to-go as the Transformer gets it and the time step; with `hidden_state` also its hidden state,
    which has seen the steps before.

    The model is left as it is: its weights, the context that its own `predict` remembers, and its random numbers.

    :param venv: environments wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
    :param model: a DTFM, or the path to a saved one
    :param bound: largest absolute value of a choice
    :param hidden_state: whether observations hold the Transformer's hidden state, too
    :raises ValueError: a model that has an online actor already or does not fit, environments that do not fit, or an
        argument out of range
    """

    def __init__(
        self,
        venv: VecEnv,
        model: SequenceModel | str | PathLike[str],
        bound: float,
        hidden_state: bool = False,
    ) -> None:
        check_arguments({"bound": bound}, {"bound": POSITIVE})
        if isinstance(model, str | PathLike):
            model = DTFM.load(model, device="cpu")  # type: ignore[arg-type]
        if model.policy.online_actor is not None:
            raise ValueError(f"This {type(model).__name__} has an online actor already; take the DTFM that it was made of.")
        action_space = self._action_space(model.policy, float(bound))
        check_vec_env(venv)
        model._check_spaces(venv.observation_space, venv.action_space, "The environment has", "the model's are")  # type: ignore[arg-type]
        model.check_controller(venv)
        share_target_return(venv, model.target_return)
        n_shown = self._n_shown(model.policy) + (model.policy.options.embed_dim if hidden_state else 0)
        super().__init__(venv, spaces.Box(-OBSERVATION_CLIP, OBSERVATION_CLIP, (n_shown,), np.float32), action_space)
        self.model = model
        self.bound = float(bound)
        self.hidden_state = hidden_state
        self.n_environment_steps = 0
        self._known: tuple[Context, th.Tensor] | None = None  # each row's newest step, and its hidden state
        self._acted: Context | None = None

    @staticmethod
    def _action_space(policy: SequencePolicy, bound: float) -> spaces.Box:
        """
        Space of choices.

        :raises ValueError: a policy of which nothing can be chosen
        """
        raise NotImplementedError

    @staticmethod
    def _n_shown(policy: SequencePolicy) -> int:
        """Return how many numbers are shown, but for the hidden state."""
        return policy.observation_dim + 2

    def _act(self, context: Context, hidden: th.Tensor, actions: np.ndarray) -> tuple[np.ndarray, Context]:
        """
        Actions that follow from a choice.

        :param actions: choices (B, ...) in the action space
        :return: actions (B, n_action_steps, A) in the environment's range, and the context with them
        """
        raise NotImplementedError

    def _show(self, context: Context, hidden: th.Tensor) -> np.ndarray:
        """:return: observations (B, F) of rows that have not acted"""
        with th.inference_mode():
            newest = Windows(*(th.from_numpy(each[:, -1:]).to(hidden.device) for each in context.windows))
            shown = actor_observation(self.policy.normalization, newest, hidden if self.hidden_state else None)
        return shown.cpu().numpy()

    @property
    def policy(self) -> SequencePolicy:
        """The frozen policy."""
        return self.model.policy

    def reset(self) -> VecEnvObs:
        observations = self.venv.reset()
        self._known = self.policy.encode(observations, episode_start=np.ones(self.num_envs, bool))  # type: ignore[arg-type]
        return self._show(*self._known)

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: choices (B, ...) in the action space
        """
        assert self._known is not None, "reset() comes before step()"
        chosen, self._acted = self._act(*self._known, actions)
        self.venv.step_async(chosen if self.policy.options.n_action_steps > 1 else chosen[:, 0])

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        assert self._acted is not None
        between = [info.pop(BETWEEN, {}) for info in infos]
        n_between = [len(each.get(TIMESTEP, ())) for each in between]
        self.n_environment_steps += self.num_envs + sum(n_between)
        for row in np.flatnonzero(dones):
            context = self._pass(Context(*(each[[row]] for each in self._acted)), [between[row]], n_between[row])
            last = {key: value[None] for key, value in infos[row]["terminal_observation"].items()}
            infos[row]["terminal_observation"] = self._show(*self.policy.encode(last, context))[0]
        context = self._pass(self._acted, between, self.policy.options.n_action_steps - 1)
        self._known = self.policy.encode(observations, context, dones)  # type: ignore[arg-type]
        return self._show(*self._known), rewards, dones, infos

    def _pass(self, context: Context, between: list[dict[str, np.ndarray]], n_steps: int) -> Context:
        """
        The context after the planned actions, but for the last observation.

        Rows whose episode ended earlier stay where they were; their context is not needed any more.

        :param context: context of b rows that have acted
        :param between: observations of each row between its actions, by key
        :param n_steps: number of these observations in rows whose episode went on
        """
        vectors = context.observations[:, -1, : self.policy.vector_dim].copy()
        newest = {OBSERVATION: vectors, RETURN_TO_GO: context.returns_to_go[:, -1:].copy()}
        for camera, space in self.policy.image_spaces.items():
            newest[camera] = np.zeros((len(between), *space.shape), np.uint8)
        timestep = context.timesteps[:, -1:]
        for step in range(n_steps):
            for row, seen in enumerate(between):
                for key in newest if step < len(seen[TIMESTEP]) else ():
                    shown = seen[key][step]
                    channels_last = shown.shape != newest[key].shape[1:]
                    newest[key][row] = np.moveaxis(shown, 2, 0) if channels_last else shown
            observation = {**newest, TIMESTEP: timestep + step + 1}
            _, state = self.policy.predict(observation, tuple(context), np.zeros(len(between), bool))
            assert state is not None
            context = Context(*state)
        return context
