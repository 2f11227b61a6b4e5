"""Images for policies that learn from them: pictures of an environment as observations, all in one size."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

# As gymnasium.wrappers.AddRenderObservation has them.
PIXELS, STATE = "pixels", "state"


def resize_image(image: np.ndarray, size: Sequence[int] | None) -> np.ndarray:
    """
    An image in another size, the same for recordings, datasets and acting: averages of the pixels that fall together.

    :param image: (height, width, channels) uint8
    :param size: new height and width, pixels; None keeps them
    :return: (new height, new width, channels) uint8
    """
    if size is None or image.shape[:2] == tuple(size):
        return image
    from PIL import Image

    height, width = size
    channels = [Image.fromarray(np.ascontiguousarray(image[:, :, i])) for i in range(image.shape[2])]
    return np.stack([np.asarray(each.resize((width, height), Image.Resampling.BOX)) for each in channels], axis=2)


class RenderWrapper(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """
    Observes what an environment renders, in one size, beside what it observes itself: a Dict of `pixels` and of the
    environment's own entries, or its `state`. :class:`gymnasium.wrappers.AddRenderObservation` does so without a size.

    :param env: environment of `render_mode="rgb_array"`
    :param size: height and width of the image, pixels; a number means both
    :param state: show what the environment observes itself; without it the image is all
    :raises ValueError: another render mode, or the environment has an entry `pixels` itself
    """

    def __init__(self, env: gym.Env, size: int | Sequence[int] = 84, state: bool = True) -> None:
        RecordConstructorArgs.__init__(self, size=size, state=state)
        super().__init__(env)
        self._size = (size, size) if isinstance(size, int) else tuple(size)
        if env.render_mode != "rgb_array":
            raise ValueError(f"RenderWrapper needs render_mode='rgb_array', got {env.render_mode!r}.")
        own = env.observation_space
        parts = dict(own.spaces) if isinstance(own, spaces.Dict) else {STATE: own}
        if PIXELS in parts:
            raise ValueError(f"The environment has an entry {PIXELS!r} itself: {own}.")
        image = spaces.Box(0, 255, (*self._size, 3), np.uint8)
        self.observation_space = spaces.Dict({PIXELS: image, **(parts if state else {})})
        self._state = state

    def observation(self, observation: Any) -> dict[str, Any]:
        picture: Any = self.env.render()
        parts = observation if isinstance(observation, dict) else {STATE: observation}
        return {PIXELS: resize_image(picture, self._size), **(parts if self._state else {})}


@contextmanager
def images_on_demand(vec_env: "VecEnv") -> Iterator[Callable[[np.ndarray], None]]:
    """
    Environments of this process draw in their next steps only where it is asked for; all draw again at the end.

    Those that cannot, have a wrapper that may look at images, or live in other processes draw in each step.

    :param vec_env: n environments
    :return: a function that takes which of them draw, (n,) bool
    """
    envs = _drawing_envs(vec_env)

    def draw(wanted: np.ndarray) -> None:
        for env, each in zip(envs, wanted, strict=False):
            env.draw_images(bool(each))

    try:
        yield draw
    finally:
        draw(np.ones(len(envs), bool))


def _drawing_envs(vec_env: "VecEnv") -> list[Any]:
    """The robosuite environments in `vec_env` if all that wraps them passes images on unseen, else none."""
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

    passing = (Monitor, TimeLimit, OrderEnforcing, PassiveEnvChecker)
    while isinstance(vec_env, VecTransposeImage):
        vec_env = vec_env.venv
    envs: list[Any] = list(vec_env.envs) if isinstance(vec_env, DummyVecEnv) else []
    for i, env in enumerate(envs):
        while isinstance(env, passing) or getattr(type(env), "passes_images", False):
            env = env.env
        envs[i] = env
    return envs if all(hasattr(env, "draw_images") and env is env.unwrapped for env in envs) else []
