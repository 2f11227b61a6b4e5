"""`sb3-dtfm train`: RL-Zoo's `train`, with dt and dtfm; on several processes where torchrun started them."""

from collections.abc import Sequence

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import train_arguments, train_parser
from sb3_dtfm.zoo.registration import register
from sb3_dtfm.zoo.torchrun import joined_processes


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm train`.

    :param argv: its arguments
    """
    register()
    if {"-h", "--help"} & set(argv):
        train_parser().print_help()
        commands.train(["--help"])
    with joined_processes(train_arguments(argv)) as arguments:
        commands.train(arguments)
