"""The `sb3-dtfm` command."""

import argparse
import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence

from gymnasium.error import Error as GymnasiumError

from sb3_dtfm import __version__

# Exceptions of a user's mistake: TypeError for an argument that a constructor does not know.
EXPECTED_ERRORS = (ValueError, TypeError, AssertionError, OSError, ImportError, GymnasiumError)

# Each is `main(argv)` in a module of this package that has its name, and is imported when it is asked for.
COMMANDS = {
    "train": "RL-Zoo's `train`, with dt and dtfm.",
    "enjoy": "RL-Zoo's `enjoy`, with dt and dtfm.",
    "finetune": "Fine-tune a trained DTFM online.",
    "inspect": "Show what is in a dataset, and suggest a target return.",
    "record": "Make a dataset from a trained agent or a scripted demonstrator.",
    "demo": "Record, train and evaluate on robosuite's Lift, start to end.",
    "video": "Film a trained model, as an MP4 or a GIF.",
    "plot": "Draw the learning curve of a run of `train`.",
    "sweep": "Evaluate trained models with one target return after the other.",
    "export": "Write a trained policy into one ONNX file.",
    "push": "Upload a trained model to Hugging Face's hub, with a card and a video.",
    "pull": "Download a model from there, as a run.",
    "benchmark": "Compare DT and DTFM on a grid of tasks, shares of the data and seeds.",
    "report": "Make tables and figures from the results of `benchmark`.",
}
WITHOUT_RL_ZOO = {"export", "inspect", "record"}


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run one command.

    A user's mistake ends in one line on standard error; an error in the midst of training keeps its traceback.

    :param argv: arguments after the program's name; those of the process by default
    :return: exit code: 0, or 2 after a user's mistake
    """
    options = _parser().parse_args(argv)
    # Before torch starts its threads: by default they spin for milliseconds while they wait, which takes the time of a
    # simulator or another job on the same core. Threads that sleep at once wake up too late (docs/performance.md).
    if "torch" not in sys.modules and "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    if options.command not in WITHOUT_RL_ZOO and importlib.util.find_spec("rl_zoo3") is None:
        return _fail(options.command, 'needs RL-Zoo: pip install "sb3-dtfm[zoo]"')
    try:
        importlib.import_module(f"sb3_dtfm.cli.{options.command}").main(options.arguments)
    except EXPECTED_ERRORS as error:
        if options.debug:
            raise
        return _fail(options.command, _describe(error))
    return 0


def _parser() -> argparse.ArgumentParser:
    lines = [f"  {name:10}{description}" for name, description in COMMANDS.items()]
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm",
        description="Offline reinforcement learning for Stable-Baselines3.",
        epilog="\n".join(["commands:", *lines, "", "`sb3-dtfm COMMAND --help` lists a command's arguments."]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of any error")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="the command's own arguments")
    return parser


def _fail(command: str, message: str) -> int:
    from sb3_dtfm.files import printable  # with torch, which --help and --version do not wait for

    lines = "\n".join(map(printable, message.split("\n")))
    print(f"sb3-dtfm {command}: error: {lines}", file=sys.stderr)
    return 2


def _describe(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
