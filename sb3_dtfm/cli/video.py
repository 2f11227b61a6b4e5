"""`sb3-dtfm video`: RL-Zoo's `record_video` and `record_training` with dt and dtfm, as an MP4 or a GIF, without a screen."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_dtfm.zoo.arguments import at_least, check_algorithm, check_env_id, import_packages
from sb3_dtfm.zoo.registration import register
from sb3_dtfm.zoo.video import FORMATS, add_model_arguments, chosen_model, film, models_of_training

EPILOG = """\
Frames of MuJoCo's tasks are drawn with EGL or OSMesa, whichever works; MUJOCO_GL chooses one.

examples:
  sb3-dtfm video --algo dtfm --env HalfCheetah-v5 -n 300
  sb3-dtfm video --algo dtfm --env robosuite/Lift-v0 -o lift.gif --env-kwargs "camera_name:'frontview'"
  sb3-dtfm video --algo sac --env HalfCheetah-v5 --training --gif
"""


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm video`.

    :param argv: its arguments
    """
    options, others = _parser().parse_known_args(argv)
    register()
    check_algorithm(options.algo)
    check_env_id(options.env.gym_id)
    import_packages(options.gym_packages)
    model = chosen_model(options)
    run = Path(model.run)
    models = models_of_training(run, options.algo, options.env) if options.training else [model]
    name = "training" if options.training else f"{model.prefix}-step-0-to-step-{options.n_timesteps}"
    output = Path(options.output or run / "videos")
    if output.suffix not in FORMATS:
        output = output / f"{name}{'.gif' if options.gif else '.mp4'}"
    arguments = ["--algo", options.algo, "--env", options.env.gym_id, "-n", str(options.n_timesteps), *others]
    film(models, arguments, output)
    print(f"Video: {output}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-dtfm video",
        description="Film a trained model, by RL-Zoo's record_video, whose --n-envs, --seed, --stochastic and --env-kwargs "
        "are known here, too.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_model_arguments(parser)
    argument = parser.add_argument
    argument("-n", "--n-timesteps", type=at_least(1), default=1000, metavar="N", help="steps to film, 1000 by default")
    argument(
        "-o", "--output-folder", dest="output", metavar="PATH", help="folder, or .mp4 or .gif file; RUN/videos by default"
    )
    argument("-g", "--gif", action="store_true", help="write a GIF")
    argument(
        "--training",
        action="store_true",
        help="RL-Zoo's record_training: all checkpoints of the run, the last and the best model",
    )
    argument("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first, which register tasks")
    return parser
