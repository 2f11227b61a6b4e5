"""robosuite's tasks, each built once and when it is first asked for: building takes seconds."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from sb3_dtfm.envs.robosuite import RobosuiteEnv


@pytest.fixture(scope="session")
def environment() -> Iterator[Callable[[str], RobosuiteEnv]]:
    """The environment of a task, by its name."""
    built: dict[str, RobosuiteEnv] = {}

    def build(task: str) -> RobosuiteEnv:
        if task not in built:
            built[task] = RobosuiteEnv(task)
        return built[task]

    yield build
    for env in built.values():
        env.close()


@pytest.fixture
def lift(environment):
    return environment("Lift")


@pytest.fixture
def can(environment):
    return environment("Can")


def rollout(env, n_steps=15, seed=None, options=None):
    """Observations (n_steps + 1, O) of an episode with random actions, the same for each call."""
    rng = np.random.default_rng(0)
    observations = [env.reset(seed=seed, options=options)[0]]
    for _ in range(n_steps):
        observations.append(env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))[0])
    return np.stack(observations)


# Variables that a new process chooses anew; MuJoCo sets PyOpenGL's once it has drawn here.
CHOSEN = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "PYTHONHASHSEED")


def run_python(code, *arguments, **environment):
    """Run a program in another process, which chooses its own rendering backend and order of sets."""
    variables = {name: value for name, value in os.environ.items() if name not in CHOSEN}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**variables, **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
