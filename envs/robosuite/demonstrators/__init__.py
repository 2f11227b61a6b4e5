"""Scripted demonstrators: people who see the observation vector alone and act through OSC_POSE."""

from sb3_dtfm.envs.robosuite.demonstrators.base import Demonstrator
from sb3_dtfm.envs.robosuite.demonstrators.can import CanDemonstrator
from sb3_dtfm.envs.robosuite.demonstrators.lift import LiftDemonstrator
from sb3_dtfm.envs.robosuite.demonstrators.square import SquareDemonstrator
from sb3_dtfm.envs.robosuite.demonstrators.stack import StackDemonstrator

__all__ = ["CanDemonstrator", "Demonstrator", "LiftDemonstrator", "SquareDemonstrator", "StackDemonstrator"]
