"""gymnasium-robotics' tasks: hands, arms that fetch, mazes."""

import contextlib
import io

import gymnasium as gym


def register_gymnasium_robotics() -> None:
    """
    Make its ids work, as importing it does, where it is installed.

    It is imported when a task may be one of its own, since that takes half a second and MuJoCo, and in silence: it has a
    notice about some of its tasks.
    """
    with contextlib.redirect_stderr(io.StringIO()), contextlib.suppress(ImportError):
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
