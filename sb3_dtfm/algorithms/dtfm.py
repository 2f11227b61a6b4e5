"""Decision Transformer with flow matching."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_dtfm.algorithms.model import POLICY_NAMES
from sb3_dtfm.algorithms.offline import OfflineAlgorithm
from sb3_dtfm.policies import DTFMPolicy


class DTFM(OfflineAlgorithm):
    """
    Decision Transformer with flow matching: the Transformer's hidden state conditions a vector field from noise to action.

    Paper: Flow Matching Integrated Decision Transformer for Offline Reinforcement Learning.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(POLICY_NAMES, DTFMPolicy)
