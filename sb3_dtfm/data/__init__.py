"""Recorded episodes: readers, the buffer they fill, and one function that finds the right reader."""

from sb3_dtfm.data.buffer import TrajectoryBuffer
from sb3_dtfm.data.episodes import Statistics
from sb3_dtfm.data.flat import load_flat
from sb3_dtfm.data.in_memory import load_episodes, load_replay_buffer, load_steps
from sb3_dtfm.data.lerobot import load_lerobot
from sb3_dtfm.data.minari import load_minari
from sb3_dtfm.data.pickles import without_pickles
from sb3_dtfm.data.readers import Dataset, load_dataset, load_dataset_for
from sb3_dtfm.data.robomimic import check_controller, load_robomimic
from sb3_dtfm.data.trajectories import (
    DatasetError,
    ReturnReference,
    ScoreReference,
    Trajectory,
    check_action_space,
    returns_to_go,
)

__all__ = [
    "Dataset",
    "DatasetError",
    "ReturnReference",
    "ScoreReference",
    "Statistics",
    "Trajectory",
    "TrajectoryBuffer",
    "check_action_space",
    "check_controller",
    "load_dataset",
    "load_dataset_for",
    "load_episodes",
    "load_flat",
    "load_lerobot",
    "load_minari",
    "load_replay_buffer",
    "load_robomimic",
    "load_steps",
    "returns_to_go",
    "without_pickles",
]
