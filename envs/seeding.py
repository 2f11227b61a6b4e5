"""A check that an environment starts from its seed, which replays and comparisons rely on."""

import copy
import warnings

import gymnasium as gym
from gymnasium.utils.env_checker import data_equivalence


def warn_of_seeds(env: gym.Env, consequence: str, seed: int = 0) -> None:
    """
    Reset an environment twice with the same seed, and warn if it does not show the same.

    :param env: the environment
    :param consequence: clause that says what follows, for the message
    :param seed: seed to reset with
    """
    first, second = (copy.deepcopy(env.reset(seed=seed)[0]) for _ in range(2))
    if not data_equivalence(first, second):
        warnings.warn(
            f"{env.spec.id if env.spec else env}: two reset(seed={seed}) start differently, so {consequence}. A task whose "
            "reset passes the seed to super().reset(seed=seed) and draws from self.np_random starts as it is told.",
            stacklevel=3,
        )
