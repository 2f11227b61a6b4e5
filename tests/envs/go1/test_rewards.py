"""Terms of the Go1's reward, from motions that are set by hand."""

import numpy as np
import pytest

from sb3_dtfm.envs.go1.model import HOME
from sb3_dtfm.envs.go1.rewards import REWARDS, Step, reward_terms, total_reward
from sb3_dtfm.envs.go1.simulation import Motion

STILL = Motion(
    velocity=np.zeros(3),
    gyro=np.zeros(3),
    gravity=np.array([0.0, 0.0, -1.0]),
    joint_positions=HOME,
    joint_velocities=np.zeros(12),
    torques=np.zeros(12),
    height=0.29,
    foot_heights=np.full(4, 0.1),
    foot_speeds=np.zeros(4),
    foot_contacts=np.ones(4, bool),
)


def terms(command=(0.0, 0.0, 0.0), action=0.0, **motion) -> dict[str, float]:
    step = Step(STILL._replace(**motion), np.full(12, action), np.zeros(12), np.array(command))
    return reward_terms(step)


def test_a_robot_that_stands_as_asked_gains_all_and_pays_nothing():
    gained = {"tracking": 1.0, "turning": 0.5, "pose": 0.5}
    assert terms() == pytest.approx({name: gained.get(name, 0.0) for name in REWARDS})
    assert total_reward(terms()) == pytest.approx(0.04)


def first(value: float, n: int = 12) -> np.ndarray:
    return np.array([value] + [0.0] * (n - 1))


TILTED = np.array([0.6, 0.0, -0.8])


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("tracking", {"command": (1.0, 0.5, 0.0), "velocity": np.array([0.5, 0.5, 9.0])}, np.exp(-1.0)),
        ("tracking", {"command": (0.0, 0.5, 0.0), "velocity": np.array([0.0, -0.5, 0.0])}, np.exp(-4.0)),
        ("turning", {"command": (0.0, 0.0, 1.0), "gyro": np.array([9.0, 9.0, 0.5])}, 0.5 * np.exp(-1.0)),
        ("pose", {"joint_positions": HOME + first(0.5)}, 0.5 * np.exp(-0.25)),
        ("pose", {"joint_positions": HOME + np.roll(first(0.5), 2)}, 0.5 * np.exp(-0.025)),
        ("vertical velocity", {"velocity": np.array([3.0, 2.0, 0.4])}, -0.5 * 0.16),
        ("vertical velocity", {"velocity": np.array([1.0, 5.0, 0.0]), "gravity": TILTED}, -0.5 * 0.36),
        ("roll and pitch rates", {"gyro": np.array([1.0, 2.0, 3.0])}, -0.25),
        ("orientation", {"gravity": TILTED}, -5.0 * 0.36),
        ("joint limits", {"joint_positions": HOME + first(0.8)}, -(0.9 - 0.95 * 0.863)),
        ("fall", {"height": 0.14}, -1.0),
        ("fall", {"gravity": np.array([0.0, 0.9, -0.43])}, -1.0),
        ("fall", {"gravity": TILTED}, 0.0),
        ("standing", {"joint_positions": HOME + 0.1}, -1.2),
        ("standing", {"joint_positions": HOME + 0.1, "command": (0.02, 0.0, 0.0)}, 0.0),
        ("torques", {"torques": np.array([3.0, -4.0] + [0.0] * 10)}, -0.0002 * 12.0),
        ("energy", {"torques": first(-4.0), "joint_velocities": first(5.0)}, -0.02),
        ("action rate", {"action": 0.5}, -0.01 * 12 * 0.25),
        ("slip", {"foot_speeds": np.array([1.0, 2.0, 3.0, 0.0]), "foot_contacts": np.array([1, 1, 0, 0], bool)}, 0.0),
        (
            "slip",
            {
                "command": (0.0, 0.0, 0.5),
                "foot_speeds": np.array([1.0, 2.0, 3.0, 0.0]),
                "foot_contacts": np.array([1, 1, 0, 0], bool),
            },
            -0.5,
        ),
        ("clearance", {"foot_speeds": first(4.0, 4), "foot_heights": np.array([0.05, 0.0, 0.0, 0.0])}, -2.0 * 0.05 * 2.0),
    ],
)
def test_a_term_is_the_published_one(name, changes, expected):
    assert terms(**changes)[name] == pytest.approx(expected, abs=1e-9)


def test_a_reward_is_never_negative():
    assert total_reward(terms(gravity=np.array([1.0, 0.0, 0.0]))) == 0.0
