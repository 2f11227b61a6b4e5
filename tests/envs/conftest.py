"""The two robosuite tasks, built once for each test file: building takes seconds."""

import pytest

from sb3_dtfm.envs.robosuite import RobosuiteEnv


@pytest.fixture(scope="module")
def lift():
    env = RobosuiteEnv("Lift")
    yield env
    env.close()


@pytest.fixture(scope="module")
def can():
    env = RobosuiteEnv("Can")
    yield env
    env.close()
