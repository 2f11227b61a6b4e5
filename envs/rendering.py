"""MuJoCo's renderers, freed before MuJoCo ends what they draw with."""

import atexit
import weakref
from typing import Any

_renderers: "weakref.WeakSet[Any]" = weakref.WeakSet()


def make_renderer(model: Any, height: int, width: int) -> Any:
    """
    Return a MuJoCo renderer that is closed at the latest when Python ends. MuJoCo's own would end in errors then.

    :param model: MuJoCo model, which gets room for pictures of this size
    :param height: height of the pictures, pixels
    :param width: width of the pictures, pixels
    :raises RuntimeError: nothing can be drawn on this machine as it is set up
    """
    import mujoco

    room = model.vis.global_
    room.offheight, room.offwidth = max(room.offheight, height), max(room.offwidth, width)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (mujoco.FatalError, ImportError, RuntimeError) as error:  # OpenGL's, or EGL's
        raise RuntimeError(
            f"MuJoCo cannot draw here ({error}): before Python starts, set MUJOCO_GL to egl or osmesa, and install its "
            "library (libegl1 or libosmesa6)."
        ) from error
    _renderers.add(renderer)
    atexit.unregister(_close_all)
    atexit.register(_close_all)  # after MuJoCo's own, so it runs before it
    return renderer


def _close_all() -> None:
    for renderer in list(_renderers):
        renderer.close()
