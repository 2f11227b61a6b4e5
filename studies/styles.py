"""
Demonstrators of other styles than the packaged scripts': settings that were chosen on one script are judged on others.

Each is a person of its own: slow and low; quick and from high above; one who goes level and then straight down, and raises
before it goes aside; one whose first grasp is often a near miss. `several` is a file of all four, in turns.

    for style in slow quick level missing several; do
        python studies/styles.py $style --task can --episodes 100 --output datasets/can_$style.hdf5
    done
    sb3-dtfm benchmark --datasets studies/styles.yml --seeds 0 1 2 --final-episodes 100 --label several
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sb3_dtfm.envs.robosuite import TASKS
from sb3_dtfm.envs.robosuite.demonstrators import CanDemonstrator, Demonstrator, LiftDemonstrator
from sb3_dtfm.recording.demonstrations import record_demonstrations


class Slow(Demonstrator):
    """Takes its time, comes in low, and grasps deep."""

    def reset(self) -> None:
        super().reset()
        self.manner.speed *= 0.6
        self.manner.hover_height *= 0.5
        self.manner.grasp_offset[2] -= 0.006
        self.manner.dwell += 3


class Quick(Demonstrator):
    """Hurries, from high above, grasps at the upper edge and does not stay."""

    def reset(self) -> None:
        super().reset()
        self.manner.speed *= 1.4
        self.manner.time_constant *= 0.8
        self.manner.hover_height *= 2.0
        self.manner.grasp_offset[2] += 0.006
        self.manner.dwell = 0


class Level(Demonstrator):
    """One thing after the other: level over the object, straight down, straight up, and only then aside."""

    def _target(self, hand: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        target, gripper = super()._target(hand, position)
        if self.stage == "hover":
            aside = float(np.hypot(*(target - hand)[:2]))
            target[2] = self._grasp_point(position)[2] + 2.0 * self.manner.hover_height
            if aside < 0.02:
                target[2] -= self.manner.hover_height
        if self.stage == "raise":
            target[:2] = hand[:2]
        return target, gripper


class Missing(Demonstrator):
    """Its first grasp closes above or beside the object every other time; it looks again, and corrects that."""

    def reset(self) -> None:
        super().reset()
        if self._rng.random() < 0.5:
            self._misjudged_height = self.misjudgement * self._rng.uniform(0.7, 1.1)


STYLES = (Slow, Quick, Level, Missing)


def demonstrator(style: str, script: type[Demonstrator]) -> Callable[..., Demonstrator]:
    """
    The packaged script in another style.

    :param style: name of one, or "several"
    :param script: of the task
    :return: makes the demonstrator of an episode from its seed and pause
    """
    people = {each.__name__.lower(): type(each.__name__, (each, script), {}) for each in STYLES}

    def one_of_all(seed: int | None = None, pause: float = 0.0) -> Demonstrator:
        return list(people.values())[np.random.default_rng(seed).integers(len(people))](seed, pause)

    return one_of_all if style == "several" else people[style]


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("style", choices=[*(style.__name__.lower() for style in STYLES), "several"])
    parser.add_argument("--task", choices=["can", "lift"], default="can")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--output", required=True)
    arguments = parser.parse_args()
    name, script = {"can": ("Can", CanDemonstrator), "lift": ("Lift", LiftDemonstrator)}[arguments.task]
    TASKS[name] = replace(TASKS[name], demonstrator=demonstrator(arguments.style, script))
    print(record_demonstrations(arguments.task, arguments.episodes, arguments.output, overwrite=True))


if __name__ == "__main__":
    main()
