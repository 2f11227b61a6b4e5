"""The reward: a table of weights and terms, after MuJoCo Playground's."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_dtfm.envs.go1.model import HOME, JOINT_LIMITS
from sb3_dtfm.envs.go1.simulation import DECISION, Motion

TRACKING_SCALE = 0.25  # of squared errors, (m/s)^2 and (rad/s)^2
SOFT_LIMIT = 0.95  # share of a joint's limits beyond which a position costs
SWING_HEIGHT = 0.1  # of a moving foot, metres
SMALLEST_COMMAND = 0.01
POSE_WEIGHTS = np.tile([1.0, 1.0, 0.1], 4)


class Step(NamedTuple):
    """
    A step as its reward sees it.

    :param motion: motion after the step
    :param action: (12,)
    :param last_action: action of the step before, (12,)
    :param command: commanded velocities: forward and left in m/s, turn in rad/s, (3,)
    """

    motion: Motion
    action: np.ndarray
    last_action: np.ndarray
    command: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Command less velocity, (3,)."""
        return self.command - self.motion.tracked

    @property
    def is_asked_to_move(self) -> bool:
        return bool(np.linalg.norm(self.command) > SMALLEST_COMMAND)


def beyond_limits(positions: np.ndarray) -> float:
    """
    :param positions: positions of the joints, (12,) rad
    :return: sum of the angles by which they are beyond their soft limits, rad
    """
    low, high = (SOFT_LIMIT * JOINT_LIMITS).T
    return float(np.sum(np.maximum(low - positions, 0.0) + np.maximum(positions - high, 0.0)))


# Weight, and the term.
REWARDS: dict[str, tuple[float, Callable[[Step], float]]] = {
    "tracking": (1.0, lambda step: np.exp(-np.sum(step.error[:2] ** 2) / TRACKING_SCALE)),
    "turning": (0.5, lambda step: np.exp(-(step.error[2] ** 2) / TRACKING_SCALE)),
    "pose": (0.5, lambda step: np.exp(-np.sum(POSE_WEIGHTS * (step.motion.joint_positions - HOME) ** 2))),
    "vertical velocity": (-0.5, lambda step: (step.motion.gravity @ step.motion.velocity) ** 2),
    "roll and pitch rates": (-0.05, lambda step: np.sum(step.motion.gyro[:2] ** 2)),
    "orientation": (-5.0, lambda step: np.sum(step.motion.gravity[:2] ** 2)),
    "joint limits": (-1.0, lambda step: beyond_limits(step.motion.joint_positions)),
    "fall": (-1.0, lambda step: step.motion.fallen),
    "standing": (-1.0, lambda step: not step.is_asked_to_move and np.sum(np.abs(step.motion.joint_positions - HOME))),
    "torques": (-0.0002, lambda step: np.linalg.norm(step.motion.torques) + np.sum(np.abs(step.motion.torques))),
    "energy": (-0.001, lambda step: np.sum(np.abs(step.motion.joint_velocities * step.motion.torques))),
    "action rate": (-0.01, lambda step: np.sum((step.action - step.last_action) ** 2)),
    "slip": (-0.1, lambda step: step.is_asked_to_move and np.sum(step.motion.foot_contacts * step.motion.foot_speeds**2)),
    "clearance": (
        -2.0,
        lambda step: np.sum(np.abs(step.motion.foot_heights - SWING_HEIGHT) * np.sqrt(step.motion.foot_speeds)),
    ),
}


def reward_terms(step: Step) -> dict[str, float]:
    """
    :param step: step to reward
    :return: weighted terms by name
    """
    return {name: float(weight * term(step)) for name, (weight, term) in REWARDS.items()}


def total_reward(terms: dict[str, float]) -> float:
    """
    :param terms: weighted terms of a step, by name
    :return: sum of the terms over the time of a decision, and not below 0, so that no robot gains by falling soon
    """
    return max(0.0, DECISION * sum(terms.values()))
