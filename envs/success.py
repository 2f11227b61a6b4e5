"""Success of an episode, as environments report it."""

from typing import Any

# SB3's name of it, and that of gymnasium-robotics' mazes and hands.
SUCCESS = ("is_success", "success")


def reported_success(info: dict[str, Any]) -> bool | None:
    """
    Return whether an episode succeeded.

    :param info: `info` of the episode's last step
    :return: success of the episode; None where `info` says nothing
    """
    success = next((info[name] for name in SUCCESS if name in info), None)
    return None if success is None else bool(success)
