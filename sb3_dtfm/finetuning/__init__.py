"""Go on learning online: a DTFM from its own episodes, or an algorithm of Stable-Baselines3 by choosing how it acts."""

from sb3_dtfm.finetuning.correction_env import CorrectionVecEnv
from sb3_dtfm.finetuning.noise_env import NoiseActionVecEnv, NoiseSpace
from sb3_dtfm.finetuning.online import OnlineDTFM
from sb3_dtfm.finetuning.steered import STEERED, SteeredDTFM

__all__ = ["STEERED", "CorrectionVecEnv", "NoiseActionVecEnv", "NoiseSpace", "OnlineDTFM", "SteeredDTFM"]
