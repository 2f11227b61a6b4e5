"""`sb3-dtfm finetune`: an online algorithm learns to steer a trained DTFM."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import UsageError
from sb3_dtfm.zoo.registration import finetuning_config, register

EXAMPLES = """\
  sb3-dtfm finetune --model logs/dtfm/robosuite-Lift-v0_1 --env robosuite/Lift-v0 --algo sac -n 20000
  sb3-dtfm enjoy --algo steered --env robosuite/Lift-v0 --load-best
"""


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm finetune`.

    :param argv: its arguments
    :raises UsageError: arguments that do not go together
    """
    register()
    parser = _parser()
    if {"-h", "--help"} & set(argv):
        parser.print_help()
        commands.train(["--help"])
    options, rest = parser.parse_known_args(argv)
    if "-optimize" in rest or "--optimize-hyperparameters" in rest:
        raise UsageError("-optimize: hyperparameters of finetune cannot be searched; -params changes them.")
    config = options.conf_file or finetuning_config(options.algo)
    given = ["--algo", options.algo, "--conf-file", str(config), "--eval-freq", str(options.eval_freq)]
    commands.finetune([*given, "--eval-episodes", str(options.eval_episodes), *rest], options.model, options.target_return)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm finetune",
        add_help=False,
        usage="sb3-dtfm finetune --model MODEL --env ENV [options] [RL-Zoo options]",
        description="Go on learning online: an algorithm of Stable-Baselines3 chooses the noise of a frozen DTFM.",
        epilog=f"examples:\n{EXAMPLES}\nRL-Zoo's own options follow.\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    argument = parser.add_argument
    argument("--model", required=True, type=Path, help="zip file of a DTFM, or folder of its run of `train`")
    argument("--algo", default="sac", help="sac by default; tqc or ppo, or with a --conf-file a2c or trpo")
    argument("--target-return", type=float, help="return to ask for, in reward units; as in the model's run by default")
    argument("-conf", "--conf-file", help="the packaged settings if not given, else a YAML file or a Python package")
    argument("--eval-freq", type=int, default=1000, metavar="N", help="decisions between two evaluations; 1000 by default")
    argument("--eval-episodes", type=int, default=20, metavar="N", help="of an evaluation; 20 by default")
    return parser
