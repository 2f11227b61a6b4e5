"""What draws MuJoCo's scenes, freed before MuJoCo ends what it draws with."""

import atexit
import weakref
from typing import Any


def make_renderer(model: Any, height: int, width: int) -> Any:
    """
    Return a MuJoCo renderer that need not be closed. Otherwise one that is open when Python ends fails with many lines.

    :param model: MuJoCo's
    :param height: pixels
    :param width: pixels
    :raises mujoco.FatalError: nothing can be drawn on this machine as it is set up
    """
    import mujoco

    renderer = mujoco.Renderer(model, height, width)
    atexit.register(_close, weakref.ref(renderer))  # after MuJoCo's own, so before it
    return renderer


def _close(renderer: "weakref.ref[Any]") -> None:
    still_there = renderer()
    if still_there is not None:
        still_there.close()
