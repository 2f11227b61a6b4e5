"""Tasks in which the object is carried to a place."""

import numpy as np

from sb3_dtfm.envs.robosuite.demonstrators.base import CLOSE, OPEN, OVERREACH, Demonstrator


class PlacingDemonstrator(Demonstrator):
    """Grasps the object, raises it over what is in the way, carries it over its place, lowers it there and lets go."""

    clearance: float  # metres: an object this high passes over what is in the way
    rest_height: float  # metres: of the object before it is raised
    precision = 1.0  # how much of the manner's offset and tolerance the place leaves
    place_turn_tolerance = np.inf  # radians from the orientation in which the object is lowered
    reach = 0.07  # metres from the hand to the object: further away, it is lost

    def _place(self) -> np.ndarray:
        """Goal of the object, (2,) metres."""
        raise NotImplementedError

    def _after_carry(self) -> str:
        return "lower"

    def _release_height(self) -> float:
        """Height at which a lowered object is let go, metres."""
        raise NotImplementedError

    def _after_grasp(self) -> str:
        return "raise"

    def _next_stage_holding(self, hand: np.ndarray, position: np.ndarray, fingers: float) -> str:
        if self.stage == "release":
            missed = self._steps_in_stage > 15
            return "hover" if missed else "release"
        if fingers < self.smallest_grip or np.linalg.norm(position - hand) > self.reach:
            return "hover"
        if self.stage == "raise" and position[2] > self.clearance:
            return "carry"
        aside = float(np.hypot(*(self._release_point() - position[:2])))
        placed = aside < self.precision * self.manner.release_tolerance and self._to_turn < self.place_turn_tolerance
        if self.stage == "carry" and placed:
            return self._after_carry()
        if self.stage == "lower" and position[2] < self._release_height():
            return "release"
        return self.stage

    def _target_holding(self, hand: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        height = self.clearance + self.manner.carry_height
        if self.stage == "raise":
            # Leans towards the target while rising, the more the higher the object already is.
            risen = np.clip((position[2] - self.rest_height) / (self.clearance - self.rest_height), 0.0, 1.0)
            sideways = 0.15 * risen * (self._release_point() - position[:2])
            return hand + np.array([*sideways, height + 0.02 - position[2]]), CLOSE
        if self.stage == "carry":
            return hand + np.array([*self._release_point(), height]) - position, CLOSE
        if self.stage == "lower":
            return hand + np.array([*self._release_point(), self._release_height() - OVERREACH]) - position, CLOSE
        return hand + np.array([0.0, 0.0, 0.01]), OPEN

    def _release_point(self) -> np.ndarray:
        return self._place() + self.precision * self.manner.release_offset
