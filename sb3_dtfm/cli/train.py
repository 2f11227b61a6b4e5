"""`sb3-dtfm train`: RL-Zoo's `train`, with dt and dtfm; on several processes where torchrun started them."""

from collections.abc import Sequence

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import repeated_arguments, restored_arguments, resumed_run, train_arguments, train_parser
from sb3_dtfm.zoo.registration import register
from sb3_dtfm.zoo.resuming import Start
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
    resumed, others = resumed_run(argv)
    restored = None
    if resumed is None:
        arguments = train_arguments(others)
    else:
        arguments = Start.read(resumed).arguments
        restored = restored_arguments(resumed, others)
        arguments = arguments if restored else repeated_arguments(resumed, arguments, others)
    with joined_processes(arguments) as arguments:
        commands.train(arguments, resumed, restored)
