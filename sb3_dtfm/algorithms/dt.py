"""Decision Transformer."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_dtfm.algorithms.model import POLICY_NAMES
from sb3_dtfm.algorithms.offline import OfflineAlgorithm
from sb3_dtfm.policies import DTPolicy


class DT(OfflineAlgorithm):
    """
    Decision Transformer (Chen et al., 2021): the action is regressed, under a tanh, from the Transformer's hidden state.
    Discrete actions are learned by cross-entropy.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(POLICY_NAMES, DTPolicy)
