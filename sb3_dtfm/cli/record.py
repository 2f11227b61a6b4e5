"""`sb3-dtfm record`: a dataset from a trained agent or a scripted demonstrator."""

import argparse
from collections.abc import Sequence

from sb3_dtfm.cli.literals import key_value

EPILOG = """\
An agent's files are pickles, and so are VecNormalize's statistics. Name those that you trust. A run's statistics,
environment arguments and wrappers are found whether its folder is named or a zip in it.

examples:
  sb3-dtfm record --algo tqc --model agent.zip --env HalfCheetah-v5 --episodes 100 --dataset-id local/halfcheetah/expert-v0
  sb3-dtfm record --algo ppo --model logs/ppo/Hopper-v5_1 --env Hopper-v5 --episodes 100 --dataset-id local/hopper/ppo-v0
  sb3-dtfm record --algo sac --model agent.zip --env Pendulum-v1 --episodes 100 --dataset-id local/pendulum/pixels-v0 \\
      --camera render
  sb3-dtfm record --demonstrator lift --episodes 200 --output datasets/lift.hdf5
"""


# Options of each way to record: name, whether it must be given, and what argparse gets.
AGENT_OPTIONS: dict[str, tuple[bool, dict]] = {
    "algo": (True, {"help": "algorithm of the agent, e.g. sac, tqc, ppo; onnx for an ONNX file"}),
    "model": (True, {"metavar": "PATH", "help": "the agent's zip or ONNX file, or the folder of its RL-Zoo run"}),
    "env": (True, {"metavar": "ENV", "help": "Gymnasium environment id"}),
    "dataset_id": (True, {"metavar": "ID", "help": "Minari id to write, e.g. local/halfcheetah/expert-v0"}),
    "vec_normalize": (False, {"metavar": "FILE", "help": "the agent's VecNormalize statistics; 'none' uses no statistics"}),
    "env_kwargs": (False, {"nargs": "+", "type": key_value, "metavar": "KEY:VALUE", "help": "of gymnasium.make"}),
    "env_wrapper": (
        False,
        {"metavar": "CLASS", "help": "wrapper class around the agent's environment; that of its RL-Zoo run by default"},
    ),
    "stochastic": (False, {"action": "store_true", "help": "sample actions; deterministic by default"}),
    "n_envs": (False, {"type": int, "metavar": "N", "help": "parallel environments"}),
    "gym_packages": (False, {"nargs": "+", "metavar": "MODULE", "help": "to import first: tasks, and a run's wrappers"}),
}
DEMONSTRATOR_OPTIONS: dict[str, tuple[bool, dict]] = {
    "output": (True, {"metavar": "FILE", "help": "robomimic hdf5 file to write"}),
    "pause": (False, {"type": float, "metavar": "STEPS", "help": "mean pause before the gripper closes, steps"}),
    "workers": (False, {"type": int, "metavar": "N", "help": "parallel processes"}),
}


def _parser() -> argparse.ArgumentParser:
    """Arguments of `record`, in one group for each way to record."""
    from sb3_dtfm.recording.demonstrations import demonstrated_tasks

    parser = argparse.ArgumentParser(
        prog="sb3-dtfm record",
        description="Record episodes of a trained agent into Minari, or of a scripted demonstrator into a robomimic file.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--episodes", type=int, required=True, metavar="N", help="episodes to keep")
    parser.add_argument("--seed", type=int, default=0, help="0 by default")
    parser.add_argument("--noise", type=float, default=0.0, metavar="STD", help="Gaussian action noise, share of the range")
    parser.add_argument(
        "--camera",
        nargs="+",
        default=[],
        metavar="NAME",
        help="record images: of a demonstration's cameras, e.g. agentview; of an agent 'render', what its environment draws",
    )
    parser.add_argument("--camera-size", type=int, default=84, metavar="PIXELS", help="height and width, 84 by default")
    parser.add_argument("--overwrite", action="store_true", help="replace a dataset that is there already")
    agent = parser.add_argument_group("a trained agent")
    demonstrator = parser.add_argument_group("a scripted demonstrator")
    demonstrator.add_argument("--demonstrator", choices=demonstrated_tasks(), help="robosuite task to demonstrate")
    for group, options in ((agent, AGENT_OPTIONS), (demonstrator, DEMONSTRATOR_OPTIONS)):
        for name, (_, settings) in options.items():
            group.add_argument(_flag(name), default=None, **settings)
    return parser


def main(argv: Sequence[str]) -> None:
    """
    Run `sb3-dtfm record`.

    :param argv: its arguments
    """
    parser = _parser()
    options = parser.parse_args(argv)
    if options.episodes < 1:
        parser.error(f"argument --episodes: must be at least 1, got {options.episodes}")
    if options.demonstrator is None:
        _check(parser, options, AGENT_OPTIONS, DEMONSTRATOR_OPTIONS, "without --demonstrator (recording a trained agent)")
        if options.camera not in ([], ["render"]):
            wrong = f"only 'render' is accepted of an agent, got {' '.join(options.camera)}"
            parser.error(f"argument --camera: {wrong}; images that an environment observes are recorded anyway")
        _record_agent(options)
    else:
        _check(parser, options, DEMONSTRATOR_OPTIONS, AGENT_OPTIONS, f"with --demonstrator {options.demonstrator}")
        _record_demonstrations(options)


def _record_agent(options: argparse.Namespace) -> None:
    from sb3_dtfm.envs.packages import import_packages
    from sb3_dtfm.recording.agent import record_agent

    import_packages(options.gym_packages or [])
    optional = {} if options.n_envs is None else {"n_envs": options.n_envs}
    dataset = record_agent(
        options.algo,
        options.model,
        options.env,
        options.episodes,
        options.dataset_id,
        deterministic=not options.stochastic,
        noise=options.noise,
        seed=options.seed,
        overwrite=options.overwrite,
        vec_normalize_path=options.vec_normalize,
        env_kwargs=dict(options.env_kwargs or []),
        env_wrapper=options.env_wrapper,
        picture_size=options.camera_size if options.camera else None,
        **optional,
    )
    print(f"Recorded {dataset.total_episodes} episodes, {dataset.total_steps} steps: {dataset.id}")


def _record_demonstrations(options: argparse.Namespace) -> None:
    from sb3_dtfm.recording.demonstrations import record_demonstrations

    summary = record_demonstrations(
        options.demonstrator,
        options.episodes,
        options.output,
        noise=options.noise,
        pause=options.pause or 0.0,
        seed=options.seed,
        n_workers=options.workers,
        overwrite=options.overwrite,
        cameras=options.camera,
        camera_size=options.camera_size,
    )
    print(summary)


def _check(
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    wanted: dict[str, tuple[bool, dict]],
    unwanted: dict[str, tuple[bool, dict]],
    when: str,
) -> None:
    """End with a usage error if an option is missing, or belongs to the other way to record."""
    missing = [_flag(name) for name, (required, _) in wanted.items() if required and getattr(options, name) is None]
    if missing:
        parser.error(f"{', '.join(missing)}: required {when}")
    misplaced = [_flag(name) for name in unwanted if getattr(options, name) is not None]
    if misplaced:
        parser.error(f"{', '.join(misplaced)}: not used {when}")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
