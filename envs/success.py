"""What environments say of an episode's success."""

from typing import Any


def reported_success(info: dict[str, Any]) -> bool | None:
    """
    Whether an episode succeeded: by SB3's name of it, or that of gymnasium-robotics' mazes and hands.

    :param info: of the episode's last step
    :return: None where it says nothing
    """
    success = info.get("is_success", info.get("success"))
    return None if success is None else bool(success)
