"""Renderer of MuJoCo on a machine without a screen, found by trying."""

import contextlib
import importlib
import os
import subprocess
import sys
from collections.abc import Iterator

import mujoco

# Values of MUJOCO_GL: a GPU or Mesa without a screen, a CPU alone, or a window on a screen.
RENDERERS = ("egl", "osmesa", "glfw")
# Tried in a process of its own: a renderer that fails stays half loaded, and only one can be loaded.
ATTEMPT = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"
ATTEMPT_LIMIT = 120  # seconds; a busy machine needs some for the import
ADVICE = (
    "MuJoCo draws with EGL or OSMesa, and neither works here: on Debian and Ubuntu, apt-get install libegl1 or libosmesa6"
)


class RenderingError(OSError):
    """No picture can be drawn on this machine as it is; the message says what to install."""


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """
    Have MuJoCo draw with what works here. A `MUJOCO_GL` that is set is taken as it is.

    :raises RenderingError: drawing has failed, and nothing works
    """
    chosen = os.environ.get("MUJOCO_GL") or next(filter(_works, RENDERERS), None)
    try:
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen
            importlib.reload(sys.modules[mujoco.Renderer.__module__].gl_context)  # it has read the variable on import
        yield
    except Exception as error:  # each library raises its own; tasks that need no MuJoCo raise none
        if chosen is None or not _works(chosen):
            given = f"MUJOCO_GL={chosen} does not work here. " if chosen else ""
            raise RenderingError(f"{error}. {given}{ADVICE}.") from error
        raise


def _works(renderer: str) -> bool:
    environment = {**os.environ, "MUJOCO_GL": renderer}
    try:
        attempt = subprocess.run(
            [sys.executable, "-c", ATTEMPT], env=environment, capture_output=True, timeout=ATTEMPT_LIMIT
        )
    except subprocess.TimeoutExpired:
        return False
    return attempt.returncode == 0
