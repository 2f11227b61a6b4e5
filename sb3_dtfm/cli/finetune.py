"""`sb3-dtfm finetune`: fine-tune a trained DTFM online."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.zoo import commands
from sb3_dtfm.zoo.arguments import (
    UsageError,
    check_algorithm,
    check_env_id,
    import_packages,
    restored_arguments,
    resumed_run,
)
from sb3_dtfm.zoo.registration import finetuning_config, register
from sb3_dtfm.zoo.resuming import Start

EXAMPLES = """\
  sb3-dtfm finetune --model logs/dtfm/robosuite-Can-v0_1 --env robosuite/Can-v0 --algo dtfm -n 100000
  sb3-dtfm finetune --model logs/dtfm/robosuite-Lift-v0_1 --env robosuite/Lift-v0 --algo sac -n 20000
  sb3-dtfm finetune --model logs/dtfm/HalfCheetah-v5_1 --env HalfCheetah-v5 --algo ppo -n 1000000
  sb3-dtfm enjoy --algo finetuned --env robosuite/Lift-v0 --load-best
"""
# Default number of evaluations in a run, beside those at its beginning and end.
EVALUATIONS_OF_A_RUN = 10


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
    restored = None
    if resumed is not None:
        restored = restored_arguments(resumed, others)
        if restored is None:
            raise UsageError(
                f"--resume {resumed}: takes no other arguments but --gym-packages and --conf-file, as a run resumes with "
                f"its own; got {' '.join(others)}."
            )
        argv = Start.read(resumed, "finetune").arguments
    options, rest = parser.parse_known_args(argv)
    check_algorithm(options.algo)
    if restored is None:
        check_env_id(options.env)
        import_packages(options.gym_packages)
    if "-optimize" in rest or "--optimize-hyperparameters" in rest:
        raise UsageError("-optimize: hyperparameters of finetune cannot be searched; -params changes them.")
    if options.dataset:
        raise UsageError(
            "--dataset: refused, as the DTFM's own dataset is used; -params dataset:... names another for --algo dtfm."
        )
    config = options.conf_file or finetuning_config(options.algo)
    if options.env is not None:
        rest += ["--env", options.env]
    if options.gym_packages:
        rest += ["--gym-packages", *options.gym_packages]
    given = ["--algo", options.algo, "--conf-file", str(config), "--eval-episodes", str(options.eval_episodes)]
    if options.eval_freq is not None:
        given += ["--eval-freq", str(options.eval_freq)]
    evaluations_of_a_run = EVALUATIONS_OF_A_RUN if options.eval_freq is None else None
    commands.finetune([*given, *rest], options.model, options.target_return, argv, resumed, evaluations_of_a_run, restored)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm finetune",
        add_help=False,
        usage="sb3-dtfm finetune --model MODEL --env ENV [options] [RL-Zoo options]",
        description="Fine-tune a trained model online: a DTFM from its own episodes (--algo dtfm), or an SB3 algorithm "
        "that chooses the noise of a frozen one, or adds residual actions to its own.",
        epilog=f"examples:\n{EXAMPLES}\nRL-Zoo's own options follow.\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    argument = parser.add_argument
    argument("--model", required=True, type=Path, help="zip file of a DTFM, or folder of its run of `train`")
    argument("--env", metavar="ENV", help="Gymnasium id")
    argument("--algo", default="sac", help="dtfm, sac, tqc or ppo, or with a --conf-file a2c or trpo; sac by default")
    argument("--target-return", type=float, help="in reward units; the model's by default")
    argument("-conf", "--conf-file", help="the packaged settings if not given, else a YAML file or a Python package")
    every = "timesteps between two evaluations; by default a tenth of all: steps with dtfm, else decisions"
    argument("--eval-freq", type=int, metavar="N", help=every)
    argument("--eval-episodes", type=int, default=20, metavar="N", help="episodes of an evaluation; 20 by default")
    argument("--dataset", help=argparse.SUPPRESS)
    argument("--gym-packages", nargs="+", default=[], help=argparse.SUPPRESS)
    argument("--resume", metavar="RUN", help="resume an interrupted run of --algo dtfm, as logs/dtfm/HalfCheetah-v5_2")
    return parser
