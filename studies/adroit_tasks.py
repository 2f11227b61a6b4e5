"""
Adroit's Door, Hammer and Relocate with the reward of Rajeswaran et al. (2018), as `AdroitHandDoorPublished-v1` and so on.

    PYTHONPATH=studies sb3-dtfm record --gym-packages adroit_tasks --env AdroitHandDoorPublished-v1 --algo ppo ...
"""

import gymnasium as gym

from sb3_dtfm.envs import AdroitReward
from sb3_dtfm.envs.robotics import OBJECTS, register_gymnasium_robotics

register_gymnasium_robotics()
for name in OBJECTS:
    gym.register(
        f"{name}Published-v1",
        entry_point=gym.spec(f"{name}-v1").entry_point,
        max_episode_steps=gym.spec(f"{name}-v1").max_episode_steps,
        additional_wrappers=(AdroitReward.wrapper_spec(),),
    )
