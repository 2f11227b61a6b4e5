"""Go on learning online: a DTFM from its own episodes, or an algorithm of Stable-Baselines3 by choosing its noise."""

from sb3_dtfm.finetuning.noise_env import NoiseActionVecEnv, NoiseSpace
from sb3_dtfm.finetuning.online import OnlineDTFM
from sb3_dtfm.finetuning.steered import STEERED, SteeredDTFM

__all__ = ["STEERED", "NoiseActionVecEnv", "NoiseSpace", "OnlineDTFM", "SteeredDTFM"]
