"""Lift: the cube off the table."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.base import CLOSE, Demonstrator


class LiftDemonstrator(Demonstrator):
    """Grasps the cube and lifts it off the table."""

    def _after_grasp(self) -> str:
        return "lift"

    def _next_stage_holding(self, hand: np.ndarray, position: np.ndarray, fingers: float) -> str:
        lost = fingers < self.smallest_grip or np.linalg.norm(position - hand) > 0.05
        return "hover" if lost else self.stage

    def _target_holding(self, hand: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        return hand + 0.1 * np.array([*self.manner.lift_drift, 1.0]), CLOSE
