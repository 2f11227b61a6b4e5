"""robosuite's cameras as observations: upright, in the same light wherever they are drawn."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_dtfm.envs.rendering import make_renderer


class Cameras:
    """
    Images of the present state by robomimic's names, `agentview_image` for the camera `agentview`. They are upright, as in
    robomimic's files (robosuite's own are upside down), and without shadows and reflections, which take most of the time
    where no GPU draws.

    :ivar close: function that frees the renderer
    :ivar images: the newest ones, (size, size, 3) uint8 by key

    :param model: MuJoCo model
    :param names: names of the cameras
    :param size: height and width of the images, pixels
    :raises ValueError: no such camera, or a size below 1
    :raises RuntimeError: nothing can be drawn on this machine as it is set up
    """

    def __init__(self, model: Any, names: Sequence[str], size: int) -> None:
        import mujoco

        there = [model.camera(i).name for i in range(model.ncam)]
        unknown = [name for name in names if name not in there]
        if unknown:
            raise ValueError(f"cameras: there is no {', '.join(unknown)}; accepted are {', '.join(there)}.")
        if size < 1:
            raise ValueError(f"camera_size must be at least 1, got {size}.")
        self.names = list(names)
        self._model = model
        self._renderer = make_renderer(model, size, size)
        self.close = self._renderer.close
        self._option = mujoco.MjvOption()
        self._option.geomgroup[0] = 0  # collision shapes
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = False
        self.images: dict[str, np.ndarray] = {}
        self.space = dict.fromkeys(map(image_key, names), spaces.Box(0, 255, (size, size, 3), np.uint8))

    def __call__(self, data: Any) -> dict[str, np.ndarray]:
        """
        :param data: MuJoCo data of the state to draw
        :return: images (size, size, 3) uint8 by key
        """
        import mujoco

        mujoco.mj_camlight(self._model, data)  # where the hand's camera is after a step, which moves the hand alone
        self.images = {}
        for name in self.names:
            self._renderer.update_scene(data, camera=name, scene_option=self._option)
            self.images[image_key(name)] = self._renderer.render()
        return self.images


def camera_args(names: Sequence[str], size: int) -> dict[str, Any]:
    """Describe cameras as robomimic files do."""
    used = {"camera_names": list(names), "camera_heights": size, "camera_widths": size} if names else {}
    return {"use_camera_obs": bool(names), "camera_depths": False, **used}


def image_key(camera: str) -> str:
    """Name of a camera's image in robomimic."""
    return f"{camera}_image"
