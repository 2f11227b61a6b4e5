"""
A film of a trained model that walks in the second simulation: forward, to the left, and turning.

    MUJOCO_GL=egl PYTHONPATH=studies python -m go1.film model.zip go1.xml docs/images/go1.gif
"""

import argparse

import numpy as np
from gymnasium.wrappers import TimeLimit
from PIL import Image

from sb3_dtfm import DTFM
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.envs.go1.env import Go1Env

COMMANDS = ((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.4, 0.0, 1.0))  # forward and left in m/s, turn in rad/s
N_STEPS = 100  # of each command
EVERY = 5  # steps of 20 ms a picture
SIZE = (320, 240)
N_COLORS = 48


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "second", "output"):
        parser.add_argument(name)
    options = parser.parse_args()
    model = DTFM.load(options.model, device="cpu")
    robot = Go1Env(options.second, render_mode="rgb_array", width=SIZE[0], height=SIZE[1])
    env = ReturnToGoWrapper(TimeLimit(robot, 1000), target_return=model.target_return)
    frames, state = [], None
    observation, _ = env.reset(seed=0, options={"command": COMMANDS[0]})
    for step in range(N_STEPS * len(COMMANDS)):
        robot.command = np.array(COMMANDS[step // N_STEPS])
        actions, state = model.predict(
            {key: value[None] for key, value in observation.items()}, state, np.array([step == 0]), deterministic=True
        )
        observation, *_ = env.step(actions[0])
        if step % EVERY == 0:
            frames.append(Image.fromarray(env.render()).quantize(N_COLORS))
    frames[0].save(options.output, save_all=True, append_images=frames[1:], duration=20 * EVERY, loop=0, optimize=True)


if __name__ == "__main__":
    main()
