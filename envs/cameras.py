"""Images for policies that learn from them: pictures of an environment as observations, all in one size."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
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

    :param env: of `render_mode="rgb_array"`
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


class ImagesOnDemand:
    """
    Has environments draw the images that a policy looks at, and no others, if they can.

    :param vec_env: robosuite's tasks with cameras, or others
    """

    def __init__(self, vec_env: VecEnv) -> None:
        self._vec_env = vec_env
        self._can = vec_env.has_attr("draw_images")
        self._drawn = np.zeros(vec_env.num_envs, bool)
        self.draw(~self._drawn)

    def draw(self, wanted: np.ndarray) -> None:
        """
        :param wanted: (n_envs,) bool, those that draw in their next steps
        """
        for i in np.flatnonzero(wanted != self._drawn) if self._can else ():
            self._vec_env.env_method("draw_images", bool(wanted[i]), indices=int(i))
        self._drawn = wanted
