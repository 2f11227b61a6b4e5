"""`sb3-dtfm finetune`: go on learning online, from a trained DTFM."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import UsageError, resumed_run
from sb3_dtfm.zoo.registration import ONLINE, finetuning_config, register
from sb3_dtfm.zoo.resuming import Start

EXAMPLES = """\
  sb3-dtfm finetune --model logs/dtfm/robosuite-Can-v0_1 --env robosuite/Can-v0 --algo dtfm -n 100000
  sb3-dtfm finetune --model logs/dtfm/robosuite-Lift-v0_1 --env robosuite/Lift-v0 --algo sac -n 20000
  sb3-dtfm finetune --model logs/dtfm/HalfCheetah-v5_1 --env HalfCheetah-v5 --algo ppo -n 1000000
  sb3-dtfm enjoy --algo steered --env robosuite/Lift-v0 --load-best
"""
# Timesteps between two evaluations: the environments' steps where a DTFM learns itself, decisions where it is steered.
EVAL_FREQ, USUAL_EVAL_FREQ = {ONLINE: 10_000, "ppo": 100_000}, 1000


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
    resumed, others = resumed_run(argv)
    if resumed is not None and not others:
        argv = Start.read(resumed, "finetune").arguments
    elif resumed is not None:
        raise UsageError(
            f"--resume {resumed}: takes no other arguments, as a run goes on with its own; got {' '.join(others)}."
        )
    options, rest = parser.parse_known_args(argv)
    if "-optimize" in rest or "--optimize-hyperparameters" in rest:
        raise UsageError("-optimize: hyperparameters of finetune cannot be searched; -params changes them.")
    config = options.conf_file or finetuning_config(options.algo)
    usual = EVAL_FREQ.get(options.algo, USUAL_EVAL_FREQ)
    eval_freq = usual if options.eval_freq is None else options.eval_freq
    given = ["--algo", options.algo, "--conf-file", str(config), "--eval-freq", str(eval_freq)]
    arguments = [*given, "--eval-episodes", str(options.eval_episodes), *rest]
    commands.finetune(arguments, options.model, options.target_return, argv, resumed)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm finetune",
        add_help=False,
        usage="sb3-dtfm finetune --model MODEL --env ENV [options] [RL-Zoo options]",
        description="Go on learning online: a DTFM from its own episodes (--algo dtfm), or an SB3 algorithm "
        "that chooses the noise of a frozen one, or corrects its actions.",
        epilog=f"examples:\n{EXAMPLES}\nRL-Zoo's own options follow.\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    argument = parser.add_argument
    argument("--model", required=True, type=Path, help="zip file of a DTFM, or folder of its run of `train`")
    argument("--algo", default="sac", help="dtfm, sac, tqc or ppo, or with a --conf-file a2c or trpo; sac by default")
    argument("--target-return", type=float, help="return to ask for, in reward units; as in the model's run by default")
    argument("-conf", "--conf-file", help="the packaged settings if not given, else a YAML file or a Python package")
    argument(
        "--eval-freq",
        type=int,
        metavar="N",
        help=f"timesteps between two evaluations; {USUAL_EVAL_FREQ} decisions by default, "
        + ", ".join(f"{freq} with {algo}" for algo, freq in EVAL_FREQ.items()),
    )
    argument("--eval-episodes", type=int, default=20, metavar="N", help="of an evaluation; 20 by default")
    argument("--resume", metavar="RUN", help="go on with an interrupted run of --algo dtfm, as logs/dtfm/HalfCheetah-v5_2")
    return parser
