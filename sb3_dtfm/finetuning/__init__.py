"""Online fine-tuning: a DTFM from its own episodes, or an algorithm of Stable-Baselines3 by choosing how it acts."""

from sb3_dtfm.finetuning.finetuned import FINETUNED, FinetunedDTFM
from sb3_dtfm.finetuning.noise_env import NoiseActionVecEnv, NoiseSpace
from sb3_dtfm.finetuning.online import OnlineDTFM
from sb3_dtfm.finetuning.residual_env import ResidualActionVecEnv

__all__ = ["FINETUNED", "FinetunedDTFM", "NoiseActionVecEnv", "NoiseSpace", "OnlineDTFM", "ResidualActionVecEnv"]
