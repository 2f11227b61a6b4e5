"""Pictures of the Go1."""

import mujoco
import numpy as np

from sb3_dtfm.envs.go1.model import TRUNK
from sb3_dtfm.envs.go1.simulation import Simulation
from sb3_dtfm.envs.rendering import make_renderer


class Camera:
    """
    Follows the trunk.

    :param simulation: simulation to render
    :param width: width of the pictures, pixels
    :param height: height of the pictures, pixels
    """

    def __init__(self, simulation: Simulation, width: int, height: int) -> None:
        self._simulation = simulation
        self._renderer = make_renderer(simulation.model, height, width)
        self._view = mujoco.MjvCamera()
        self._view.type, self._view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, simulation.model.body(TRUNK).id
        self._view.distance, self._view.azimuth, self._view.elevation = 1.5, 120.0, -20.0

    def frame(self) -> np.ndarray:
        """The present picture, (height, width, 3) uint8."""
        self._renderer.update_scene(self._simulation.data, self._view)
        return self._renderer.render()

    def close(self) -> None:
        self._renderer.close()
