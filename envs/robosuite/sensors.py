"""Observations of robosuite, read after a step."""

from typing import Any

import numpy as np

ROBOT_KEYS = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")


class Observer:
    """
    robomimic's low-dimensional observation: the robot's hand, then robosuite's `object-state`, in robosuite's order.

    Each of robosuite's sensors is read once, when it is first asked for: from the positions as they are now. robosuite
    itself reads them at the beginning of the last physics step, and in a fixed order, in which a pose relative to the hand
    comes before what it is computed from, and so lags behind it.

    :param env: robosuite's environment
    """

    def __init__(self, env: Any) -> None:
        observables = env._observables
        self._readings = _Readings({name: observable._sensor for name, observable in observables.items()})
        objects = [
            name
            for name, observable in observables.items()
            if observable.modality == "object" and observable.is_enabled() and observable.is_active()
        ]
        self.keys: dict[str, int] = {}
        self._columns: list[tuple[str, slice]] = []
        self.size = 0
        for name in (*ROBOT_KEYS, *objects):
            width = int(np.size(self._readings[name]))
            key = name if name in ROBOT_KEYS else "object"
            if width > 0:  # a wiper has no fingers to observe
                self.keys[key] = self.keys.get(key, 0) + width
                self._columns.append((name, slice(self.size, self.size + width)))
            self.size += width

    def __call__(self) -> np.ndarray:
        """The present observation, (O,) float32."""
        self._readings.clear()
        observation = np.empty(self.size, np.float32)
        for name, columns in self._columns:
            observation[columns] = self._readings[name]
        return observation


class _Readings(dict[str, Any]):
    """The cache that robosuite's sensors look into for each other's readings: here it asks the others for theirs."""

    def __init__(self, sensors: dict[str, Any]) -> None:
        super().__init__()
        self._sensors = sensors

    def __contains__(self, name: object) -> bool:
        return name in self._sensors

    def __missing__(self, name: str) -> Any:
        self[name] = reading = self._sensors[name](self)
        return reading
