"""The warning about an environment that does not start from its seed."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_dtfm.envs.seeding import warn_of_seeds


class Starts(gym.Env):
    """
    Starts from a number that it draws, and always shows it in the same array.

    :param obeys: draw by the seed of `reset`, not from a generator of its own, as Meta-World does
    :param in_dict: observe a dictionary
    """

    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, obeys: bool, in_dict: bool) -> None:
        box = spaces.Box(-np.inf, np.inf, (2,))
        self.observation_space = spaces.Dict({"state": box}) if in_dict else box
        self.generator = None if obeys else np.random.default_rng(0)
        self.shown = np.zeros(2, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.shown[1] = (self.generator or self.np_random).normal()
        return {"state": self.shown} if isinstance(self.observation_space, spaces.Dict) else self.shown, {}


@pytest.mark.parametrize("in_dict", [False, True])
def test_an_environment_that_does_not_start_from_its_seed_is_warned_of(in_dict):
    with pytest.warns(
        UserWarning, match=r"Starts.*: two reset\(seed=7\) start differently, so all is lost\. A task"
    ) as caught:
        warn_of_seeds(Starts(obeys=False, in_dict=in_dict), "all is lost", seed=7)
    assert len(caught) == 1


def test_a_registered_environment_is_named_by_its_id(monkeypatch):
    monkeypatch.setitem(gym.registry, "Starts-v0", gym.envs.registration.EnvSpec("Starts-v0", entry_point=Starts))
    env = gym.make("Starts-v0", obeys=False, in_dict=False)
    with pytest.warns(UserWarning, match=r"^Starts-v0: two reset\(seed=0\)"):
        warn_of_seeds(env, "all is lost")


@pytest.mark.parametrize("in_dict", [False, True])
def test_an_environment_that_starts_from_its_seed_is_not_warned_of(in_dict):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_seeds(Starts(obeys=True, in_dict=in_dict), "all is lost")
