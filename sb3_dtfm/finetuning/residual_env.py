"""Residual RL (Johannink et al., 2019): an online algorithm's actions are added to those of a frozen policy."""

from os import PathLike

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_dtfm.algorithms.model import SequenceModel
from sb3_dtfm.finetuning.frozen_env import FrozenPolicyVecEnv
from sb3_dtfm.finetuning.online_actor import check_residual_actions
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.context import Context

# Largest residual action by default, in units of [-1, 1].
RESIDUAL_BOUND = 0.5


class ResidualActionVecEnv(FrozenPolicyVecEnv):
    """
    Acts with a frozen DTFM, and adds an online algorithm's choice to its actions: residual reinforcement learning (Johannink
    et al., 2019; Silver et al., 2018). A choice of zeros is what the DTFM does with `deterministic=True`.

    Observations are those of :class:`~sb3_dtfm.finetuning.frozen_env.FrozenPolicyVecEnv`, followed by the DTFM's own action,
    between -1 and 1. Rewards are divided by `reward_unit`: ten times the largest absolute return-to-go of the model's
    training data, per step of their longest episode. So value functions need no other normalisation.

    :param venv: environments wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
    :param model: a DTFM that carries out single actions without a critic's choice, or the path to a saved one
    :param bound: largest residual action, in units of actions in [-1, 1]
    :param hidden_state: whether observations hold the Transformer's hidden state, too
    :raises ValueError: a policy that is no flow, carries out several actions of a plan or has its critic choose,
        environments that do not fit it, or an argument out of range
    """

    def __init__(
        self,
        venv: VecEnv,
        model: SequenceModel | str | PathLike[str],
        bound: float = RESIDUAL_BOUND,
        hidden_state: bool = False,
    ) -> None:
        super().__init__(venv, model, bound, hidden_state)
        normalization = self.policy.normalization
        self.reward_unit = 10.0 * float(normalization.return_scale) / normalization.max_timestep

    @staticmethod
    def _action_space(policy: SequencePolicy, bound: float) -> spaces.Box:
        check_residual_actions(policy, policy.options.n_action_steps)
        if policy.options.n_action_samples > 1:
            raise ValueError(
                f"n_action_samples={policy.options.n_action_samples}: residual actions are added to one sample; "
                "model.policy.set_acting(n_action_samples=1) leaves the critic out."
            )
        return spaces.Box(-bound, bound, (policy.action_dim,), np.float32)

    @staticmethod
    def _n_shown(policy: SequencePolicy) -> int:
        return FrozenPolicyVecEnv._n_shown(policy) + policy.action_dim

    def reset(self) -> VecEnvObs:
        return self._remember(super().reset())

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = super().step_wait()
        return self._remember(observations), rewards / self.reward_unit, dones, infos

    def _remember(self, shown: VecEnvObs) -> VecEnvObs:
        """Keep the own actions, whatever an algorithm does with what it is shown."""
        assert isinstance(shown, np.ndarray)
        self._own = shown[:, -self.policy.action_dim :].copy()
        return shown

    def _show(self, context: Context, hidden: th.Tensor) -> np.ndarray:
        _, acted = self.policy.decode(context, hidden, self.policy.default_noise(context))
        return np.concatenate([super()._show(context, hidden), acted.actions[:, -1]], axis=1)

    def _act(self, context: Context, hidden: th.Tensor, actions: np.ndarray) -> tuple[np.ndarray, Context]:
        if not np.isfinite(actions).all():
            raise ValueError(
                f"A residual action must be finite numbers, got {actions[~np.isfinite(actions).all(axis=1)][0]}."
            )
        residuals = np.clip(actions, -self.bound, self.bound)
        return self.policy.apply_actions(context, np.clip(self._own + residuals, -1.0, 1.0)[:, None])
