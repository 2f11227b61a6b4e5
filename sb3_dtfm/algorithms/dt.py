"""Decision Transformer."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_dtfm.algorithms.model import POLICY_NAMES
from sb3_dtfm.algorithms.offline import OfflineAlgorithm
from sb3_dtfm.policies import DTPolicy


class DT(OfflineAlgorithm):
    """
    Decision Transformer (Chen et al., 2021): the action is regressed, under a tanh, from the trunk's hidden state. Of a
    Discrete action space it is one of n, by cross-entropy.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(POLICY_NAMES, DTPolicy)
