"""The `sb3-dtfm` command."""

import argparse
import contextlib
import importlib.util
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from types import CodeType, FrameType

from gymnasium.error import Error as GymnasiumError

EXPECTED_ERRORS = (ValueError, AssertionError, OSError, ImportError, GymnasiumError)


def train(argv: Sequence[str]) -> None:
    """RL-Zoo's `train`, with dt and dtfm."""
    from rl_zoo3.train import train as zoo_train

    from sb3_dtfm.zoo.arguments import train_arguments, train_parser
    from sb3_dtfm.zoo.registration import register
    from sb3_dtfm.zoo.torchrun import joined_processes

    register()
    if {"-h", "--help"} & set(argv):
        train_parser().print_help()
        _run_with_arguments(zoo_train, "train", ["--help"])
    try:
        with joined_processes(train_arguments(argv)) as arguments:
            _run_with_arguments(zoo_train, "train", arguments)
    except BaseException as error:
        _remove_folder_of_no_run(error)
        raise


def enjoy(argv: Sequence[str]) -> None:
    """RL-Zoo's `enjoy`, with dt and dtfm."""
    from rl_zoo3.enjoy import enjoy as zoo_enjoy
    from rl_zoo3.utils import get_model_path

    from sb3_dtfm.zoo.arguments import enjoy_arguments
    from sb3_dtfm.zoo.registration import register

    register()
    try:
        _run_with_arguments(zoo_enjoy, "enjoy", enjoy_arguments(argv))
    except (AssertionError, ValueError) as error:
        if not _raised_inside(error, get_model_path.__code__):
            raise
        raise FileNotFoundError(f"{error}. -f names the folder that train wrote to, --exp-id the run in it.") from error


def record(argv: Sequence[str]) -> None:
    """Make a dataset from a trained agent or a scripted demonstrator."""
    from sb3_dtfm.cli.record import record as record_dataset

    record_dataset(argv)


def demo(argv: Sequence[str]) -> None:
    """Record, train and evaluate on robosuite's Lift, start to end."""
    from sb3_dtfm.cli.demo import main as run_demo

    run_demo(argv)


def plot(argv: Sequence[str]) -> None:
    """Draw the learning curve of a run of `train`."""
    from sb3_dtfm.zoo.plots import main as plot_run

    plot_run(argv)


def benchmark(argv: Sequence[str]) -> None:
    """Compare DT and DTFM on a grid of tasks, shares of the data and seeds."""
    from sb3_dtfm.benchmark.runner import main as run_benchmark

    run_benchmark(argv)


def report(argv: Sequence[str]) -> None:
    """Make tables and figures from the results of `benchmark`."""
    from sb3_dtfm.benchmark.report import main as write_report

    write_report(argv)


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "train": train,
    "enjoy": enjoy,
    "record": record,
    "demo": demo,
    "plot": plot,
    "benchmark": benchmark,
    "report": report,
}


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run one command.

    A user's mistake ends in one line on standard error; an error in the midst of training keeps its traceback.

    :param argv: arguments after the program's name; those of the process by default
    :return: exit code: 0, or 2 after a user's mistake
    """
    options = _parser().parse_args(argv)
    if options.command in ("train", "enjoy", "demo", "benchmark", "report") and importlib.util.find_spec("rl_zoo3") is None:
        return _fail(options.command, 'needs RL-Zoo: pip install "sb3-dtfm[zoo]"')
    try:
        COMMANDS[options.command](options.arguments)
    except EXPECTED_ERRORS as error:
        if options.debug or _raised_while_training(error):
            raise
        return _fail(options.command, _describe(error))
    return 0


def _parser() -> argparse.ArgumentParser:
    lines = [f"  {name:10}{command.__doc__}" for name, command in COMMANDS.items()]
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm",
        description="Offline reinforcement learning for Stable-Baselines3.",
        epilog="\n".join(["commands:", *lines, "", "`sb3-dtfm COMMAND --help` lists a command's arguments."]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of any error")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help=", ".join(COMMANDS))
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="the command's own arguments")
    return parser


def _run_with_arguments(function: Callable[[], None], command: str, arguments: Sequence[str]) -> None:
    """RL-Zoo's functions read `sys.argv`."""
    saved = sys.argv
    sys.argv = [f"sb3-dtfm {command}", *arguments]
    try:
        function()
    finally:
        sys.argv = saved


def _fail(command: str, message: str) -> int:
    print(f"sb3-dtfm {command}: error: {message}", file=sys.stderr)
    return 2


def _describe(error: BaseException) -> str:
    message = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, OSError) and error.strerror and error.filename:
        message = f"{error.filename}: {error.strerror}"
    return message


def _raised_while_training(error: BaseException) -> bool:
    if "rl_zoo3.exp_manager" not in sys.modules:
        return False
    from rl_zoo3.exp_manager import ExperimentManager

    return _raised_inside(error, ExperimentManager.learn.__code__)


def _remove_folder_of_no_run(error: BaseException) -> None:
    """RL-Zoo makes a run's folder before its model: where that failed, `enjoy` would look there for the latest run."""
    from rl_zoo3.exp_manager import ExperimentManager

    frame = _frame_of(error, ExperimentManager.setup_experiment.__code__)
    if frame is None:
        return
    manager = frame.f_locals["self"]
    with contextlib.suppress(OSError):  # not made yet, or no longer empty: then it is a run's
        os.rmdir(manager.params_path)
        shutil.rmtree(manager.save_path)


def _raised_inside(error: BaseException, code: CodeType) -> bool:
    return _frame_of(error, code) is not None


def _frame_of(error: BaseException, code: CodeType) -> FrameType | None:
    """The call of this code that the error went through."""
    traceback = error.__traceback__
    while traceback is not None:
        if traceback.tb_frame.f_code is code:
            return traceback.tb_frame
        traceback = traceback.tb_next
    return None


if __name__ == "__main__":
    sys.exit(main())
