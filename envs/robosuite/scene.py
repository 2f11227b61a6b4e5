"""robosuite itself: imported without its noise, its scenes built, and what an episode changes in a built scene."""

import logging
import os
import re
import sys
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np

CONTROL_FREQUENCY = 20  # Hz

CUBE_SIZE_RANGE = (0.020, 0.022)  # metres: half extents that robosuite draws its cube from whenever it builds the scene
CUBE_DENSITY = 1000.0  # kg / m^3


def import_robosuite() -> ModuleType:
    """
    robosuite, imported without its messages and without its choice of a rendering backend for the whole process.

    :raises ImportError: not installed; says which extra installs it
    """
    if sys.modules.get("robosuite") is not None:
        return sys.modules["robosuite"]
    rendering_backend = os.environ.get("MUJOCO_GL")
    try:
        with silence(), _optional_opencv(), warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)  # Python 3.12 and newer warn of robosuite's logo.
            import robosuite
    except ImportError as error:
        raise ImportError(
            f"The robosuite environments need robosuite, which cannot be imported ({error}): "
            'pip install "sb3-dtfm[robosuite]", and on Python 3.13 or newer also: pip install --no-deps "robosuite<1.6"'
        ) from error
    finally:
        if rendering_backend is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = rendering_backend
    return robosuite


@contextmanager
def _optional_opencv() -> Iterator[None]:
    """Let robosuite's own viewer, which is not used here, import OpenCV in vain: without libGL it cannot be loaded."""
    try:
        import cv2  # noqa: F401
    except ImportError:
        sys.modules["cv2"] = ModuleType("cv2")
        try:
            yield
        finally:
            del sys.modules["cv2"]
    else:
        yield


@contextmanager
def silence() -> Iterator[None]:
    """Hold back robosuite's log messages below errors."""
    logger = logging.getLogger("robosuite_logs")

    def is_error(record: logging.LogRecord) -> bool:
        return record.levelno >= logging.ERROR

    logger.addFilter(is_error)
    try:
        yield
    finally:
        logger.removeFilter(is_error)


def make_robosuite(environment: str, controller_config: dict[str, Any] | None, lite_physics: bool) -> Any:
    """
    robosuite's own environment, without cameras, renderer and horizon.

    :param environment: robosuite's name of the task
    :param controller_config: controller settings of robosuite 1.5 or <= 1.4; robosuite's default for the Panda if not given
    :param lite_physics: see :class:`~sb3_dtfm.envs.robosuite.RobosuiteEnv`
    """
    robosuite = import_robosuite()
    from robosuite.controllers.composite.composite_controller_factory import refactor_composite_controller_config

    with silence():
        if controller_config is not None:
            controller_config = refactor_composite_controller_config(controller_config, "Panda", ["right"])
        return robosuite.make(
            environment,
            robots="Panda",
            controller_configs=controller_config,
            control_freq=CONTROL_FREQUENCY,
            lite_physics=lite_physics,
            reward_shaping=False,
            use_camera_obs=False,
            has_renderer=False,
            has_offscreen_renderer=False,
            renderer="mujoco",  # none is opened; the default one would read a viewer's settings from disk
            hard_reset=False,
            ignore_done=True,
            seed=0,
        )


def scene_xml(env: Any, variation: "SceneVariation | None") -> str:
    """
    MuJoCo XML of a scene as it is at present; asset paths start at robosuite's package, as robomimic expects.

    :param env: robosuite's environment
    :param variation: differences between episodes in this scene; None if there are none
    """
    package = os.path.dirname(import_robosuite().__file__ or "")
    xml = re.sub(r'file="' + re.escape(package), 'file="robosuite', env.edit_model_xml(env.model.get_xml()))
    if variation is None:
        return xml
    root = ET.fromstring(xml)
    variation.write(env, root)
    return ET.tostring(root, encoding="unicode")


class SceneVariation:
    """Differences between one episode's scene and another's, beside the positions and velocities that a state holds."""

    def draw(self, env: Any, rng: np.random.Generator) -> None:
        """
        Draw what robosuite's own reset does not; it comes before that.

        :param env: robosuite's environment
        :param rng: source of randomness
        """

    def write(self, env: Any, scene: ET.Element) -> None:
        """
        Put what the compiled scene has at present into its XML.

        :param env: robosuite's environment
        :param scene: root of the XML
        """
        raise NotImplementedError

    def read(self, env: Any, scene: ET.Element) -> None:
        """
        Give the compiled scene what was recorded.

        :param env: robosuite's environment
        :param scene: root of the recorded XML
        """
        raise NotImplementedError


class CubeSize(SceneVariation):
    """Lift's cube, which robosuite draws whenever it builds the scene; here it changes in the compiled one."""

    def draw(self, env: Any, rng: np.random.Generator) -> None:
        set_cube_size(env, rng.uniform(*CUBE_SIZE_RANGE, size=3))

    def write(self, env: Any, scene: ET.Element) -> None:
        for name in ("cube_g0", "cube_g0_vis"):
            _named(scene, "geom", name).set("size", _numbers(env.cube.size))

    def read(self, env: Any, scene: ET.Element) -> None:
        set_cube_size(env, np.array(_named(scene, "geom", "cube_g0").get("size", "").split(), np.float64))


class BodyPoses(SceneVariation):
    """
    Bodies without a joint, which robosuite's reset puts elsewhere in the compiled scene.

    :param names: names of the bodies
    """

    def __init__(self, *names: str) -> None:
        self.names = names

    def write(self, env: Any, scene: ET.Element) -> None:
        model = env.sim.model
        for name in self.names:
            index, body = model.body_name2id(name), _named(scene, "body", name)
            body.set("pos", _numbers(model.body_pos[index]))
            body.set("quat", _numbers(model.body_quat[index]))

    def read(self, env: Any, scene: ET.Element) -> None:
        model = env.sim.model
        for name in self.names:
            index, body = model.body_name2id(name), _named(scene, "body", name)
            model.body_pos[index] = np.array(body.get("pos", "0 0 0").split(), np.float64)
            model.body_quat[index] = np.array(body.get("quat", "1 0 0 0").split(), np.float64)


def _named(scene: ET.Element, tag: str, name: str) -> ET.Element:
    element = scene.find(f".//{tag}[@name='{name}']")
    if element is None:
        raise ValueError(f"model_file holds no {tag} named {name!r}; it is of another task.")
    return element


def _numbers(values: np.ndarray | list[float]) -> str:
    """Write numbers as MuJoCo's XML has them, with all digits."""
    return " ".join(repr(float(value)) for value in values)


def set_cube_size(env: Any, size: np.ndarray) -> None:
    """
    Give the cube of a compiled Lift scene another size, which costs a thousandth of compiling the scene anew.

    :param env: robosuite's environment
    :param size: (3,) half extents, metres
    """
    import mujoco

    env.cube.size = [float(half) for half in size]
    model, body = env.sim.model._model, env.cube_body_id
    geoms = slice(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
    model.geom_size[geoms] = size
    model.geom_rbound[geoms] = np.linalg.norm(size)
    model.geom_aabb[geoms, 3:] = size
    model.bvh_aabb[model.body_bvhadr[body] :][: model.body_bvhnum[body], 3:] = size
    mass = CUBE_DENSITY * 8.0 * np.prod(size)
    squares = np.square(size)
    model.body_mass[body] = mass
    model.body_inertia[body] = mass / 3.0 * (squares.sum() - squares)
    mujoco.mj_setConst(model, env.sim.data._data)
