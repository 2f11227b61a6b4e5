"""The robosuite tasks, one row each. Another one needs another row, and nothing else."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sb3_dtfm.envs.robosuite.demonstrators import (
    CanDemonstrator,
    Demonstrator,
    LiftDemonstrator,
    SquareDemonstrator,
    StackDemonstrator,
)
from sb3_dtfm.envs.robosuite.scene import BodyPoses, CubeSize, SceneVariation, silence


def check_success(env: Any) -> bool:
    """
    Return whether robosuite holds the task for solved.

    :param env: robosuite's environment
    """
    return bool(env._check_success())


def wipe_and_check(env: Any) -> bool:
    """
    Return whether the table is clean.

    :param env: robosuite's environment, which takes away the dirt under the wiper when it is asked for the reward
    """
    with silence():  # it also warns about joint limits, at every step
        env.reward()
    return check_success(env)


@dataclass(frozen=True)
class RobosuiteTask:
    """
    A task of robosuite, as far as it differs from the others.

    Its objects are observed as robosuite's `object-state`, and robosuite draws their places.

    :param environment: robosuite's name of the task
    :param horizon: steps after which an unsolved episode is truncated: robomimic's, or 400 for each object to move
    :param variation: differences between episodes' scenes, beside their states; None if there are none
    :param is_solved: function that tells from robosuite's environment after a step whether the task is solved
    :param demonstrator: class of the scripted demonstrator; None if there is none
    """

    environment: str
    horizon: int = 400
    variation: SceneVariation | None = None
    is_solved: Callable[[Any], bool] = check_success
    demonstrator: type[Demonstrator] | None = None


TASKS: dict[str, RobosuiteTask] = {
    "Lift": RobosuiteTask("Lift", variation=CubeSize(), demonstrator=LiftDemonstrator),
    "Stack": RobosuiteTask("Stack", demonstrator=StackDemonstrator),
    "NutAssembly": RobosuiteTask("NutAssembly", horizon=800),
    "Square": RobosuiteTask("NutAssemblySquare", demonstrator=SquareDemonstrator),
    "Round": RobosuiteTask("NutAssemblyRound"),
    "ToolHang": RobosuiteTask("ToolHang", horizon=700),
    "PickPlace": RobosuiteTask("PickPlace", horizon=1600),
    "Can": RobosuiteTask("PickPlaceCan", demonstrator=CanDemonstrator),
    "Milk": RobosuiteTask("PickPlaceMilk"),
    "Bread": RobosuiteTask("PickPlaceBread"),
    "Cereal": RobosuiteTask("PickPlaceCereal"),
    "Door": RobosuiteTask("Door", variation=BodyPoses("Door_main")),
    "Wipe": RobosuiteTask(
        "Wipe", variation=BodyPoses(*(f"contact{marker}_main" for marker in range(100))), is_solved=wipe_and_check
    ),
}
