"""Orientations of the hand and of what lies on the table, as robosuite's quaternions: x y z w."""

import numpy as np

DOWNWARD = np.array([1.0, 0.0, 0.0, 0.0])  # of a hand that points down


def rotation_between(quaternion: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """
    Axis-angle rotation in the world's frame that turns one orientation into another.

    :param quaternion: (4,) x y z w
    :param goal: (4,) x y z w
    :return: (3,) radians
    """
    vector, scalar = -quaternion[:3], quaternion[3]  # of the inverse
    turned = goal[3] * vector + scalar * goal[:3] + np.cross(goal[:3], vector)
    cosine = float(goal[3] * scalar - goal[:3] @ vector)
    if cosine < 0.0:
        turned, cosine = -turned, -cosine
    sine = float(np.linalg.norm(turned))
    return turned * (2.0 * np.arctan2(sine, cosine) / max(sine, 1e-9))


def downward(yaw: float) -> np.ndarray:
    """
    A hand that points down, turned about the vertical; its fingers open along the y axis for 0, and for half a turn.

    :param yaw: radians
    :return: (4,) x y z w
    """
    return np.array([np.cos(yaw / 2.0), np.sin(yaw / 2.0), 0.0, 0.0])


def hand_yaw(quaternion: np.ndarray) -> float:
    """
    Return how far a hand that points down is turned about the vertical, radians.

    :param quaternion: (4,) x y z w
    """
    return float(2.0 * np.arctan2(quaternion[1], quaternion[0]))


def object_yaw(quaternion: np.ndarray) -> float:
    """
    Return how far an object that lies flat is turned about the vertical, radians in [-pi, pi].

    :param quaternion: (4,) x y z w
    """
    x, y, z, w = quaternion
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
