"""`sb3-dtfm enjoy`: RL-Zoo's `enjoy`, with dt and dtfm."""

from collections.abc import Sequence

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import enjoy_arguments, enjoy_parser
from sb3_dtfm.zoo.registration import register


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm enjoy`.

    :param argv: its arguments
    """
    register()
    if {"-h", "--help"} & set(argv):
        enjoy_parser().print_help()
        commands.enjoy(["--help"])
    target_return, arguments = enjoy_arguments(argv)
    commands.enjoy(arguments, target_return)
