"""`sb3-dtfm enjoy`: RL-Zoo's `enjoy`, with dt and dtfm."""

from collections.abc import Sequence

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import enjoy_arguments
from sb3_dtfm.zoo.registration import register


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm enjoy`.

    :param argv: its arguments
    """
    register()
    commands.enjoy(enjoy_arguments(argv))
