"""The environment that an online algorithm sees: its actions are the noise of a frozen policy."""

from os import PathLike

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.algorithms.model import SequenceModel
from sb3_dtfm.finetuning.frozen_env import FrozenPolicyVecEnv
from sb3_dtfm.finetuning.online_actor import check_noise_actions
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.context import Context

# Largest noise in a dimension, as in DSRL (Wagenmaker et al., 2025).
NOISE_BOUND = 1.5
# Flow steps in place of a mean action, which leaves no noise to choose.
NOISE_SPACE_FLOW_STEPS = 3


class NoiseSpace(spaces.Box):
    """
    Noise within a bound. Samples are standard normal, clipped to it: the noise that the frozen policy was trained with.

    Stable-Baselines3's off-policy algorithms sample their first actions, so they explore with the frozen policy.

    :param noise_dim: number N of noise values
    :param bound: largest absolute value of the noise
    :param seed: seed of the samples
    """

    def __init__(self, noise_dim: int, bound: float = NOISE_BOUND, seed: int | None = None) -> None:
        super().__init__(-bound, bound, (noise_dim,), np.float32, seed)

    def sample(self, mask: None = None, probability: None = None) -> np.ndarray:
        """:return: noise (N,)"""
        return self.np_random.standard_normal(self.shape, np.float32).clip(self.low, self.high)


class NoiseActionVecEnv(FrozenPolicyVecEnv):
    """
    Acts with a frozen DTFM from noise that an online algorithm chooses: `SAC("MlpPolicy", NoiseActionVecEnv(venv, model))`.

    One step is one decision of the frozen policy: with `chunk_size` it carries out `n_action_steps` actions, and rewards
    are added up, without a discount, so that the return of an episode stays what it is. A discount factor counts decisions.

    For observations, and for the model, see :class:`~sb3_dtfm.finetuning.frozen_env.FrozenPolicyVecEnv`.

    :param venv: environments wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`
    :param model: a DTFM, or the path to a saved one
    :param bound: largest absolute noise
    :param hidden_state: whether observations hold the Transformer's hidden state, too
    :raises ValueError: a policy whose actions do not depend on noise (DT, and one step of Euler, which ends at the mean
        action), environments that do not fit it, or an argument out of range
    """

    def __init__(
        self,
        venv: VecEnv,
        model: SequenceModel | str | PathLike[str],
        bound: float = NOISE_BOUND,
        hidden_state: bool = False,
    ) -> None:
        super().__init__(venv, model, bound, hidden_state)

    @staticmethod
    def _action_space(policy: SequencePolicy, bound: float) -> spaces.Box:
        noise_dim = check_noise_actions(policy)
        if not policy.network.head.noise_decides:
            raise ValueError(
                f"flow_steps={policy.acting_settings()['flow_steps']}: the model takes its mean action, whatever the noise; "
                f"call model.policy.set_acting(flow_steps={NOISE_SPACE_FLOW_STEPS})."
            )
        return NoiseSpace(noise_dim, bound)

    def _act(self, context: Context, hidden: th.Tensor, actions: np.ndarray) -> tuple[np.ndarray, Context]:
        return self.policy.decode(context, hidden, actions)
