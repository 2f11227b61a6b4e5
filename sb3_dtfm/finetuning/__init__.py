"""Go on learning online: an algorithm of Stable-Baselines3 chooses the noise of a frozen DTFM."""

from sb3_dtfm.finetuning.noise_env import NoiseActionVecEnv, NoiseSpace
from sb3_dtfm.finetuning.steered import SteeredDTFM

__all__ = ["NoiseActionVecEnv", "NoiseSpace", "SteeredDTFM"]
