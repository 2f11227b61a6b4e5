"""What an RL-Zoo run tells of the environment that its model was trained in."""

from pathlib import Path
from typing import Any


def read_run(run: Path) -> dict[str, Any]:
    """
    A run's hyperparameters; its `env_kwargs` are those of the command line, before those of the YAML file, and its
    `eval_env_kwargs` those of its evaluations.

    The files are read as RL-Zoo reads them, by a loader that can run code: name runs that you trust.

    :param run: the folder that holds config.yml and args.yml
    :raises ImportError: RL-Zoo is needed and not installed
    """
    try:
        import yaml
        from rl_zoo3.utils import get_saved_hyperparams
    except ImportError as error:
        raise ImportError(f'{run} is an RL-Zoo run; to read it: pip install "sb3-dtfm[zoo]" ({error})') from error
    hyperparams, _ = get_saved_hyperparams(str(run))
    arguments = run / "args.yml"
    given = yaml.load(arguments.read_text(), Loader=yaml.UnsafeLoader) if arguments.is_file() else {}
    env_kwargs = given.get("env_kwargs") or hyperparams.get("env_kwargs") or {}
    return {**hyperparams, "env_kwargs": env_kwargs, "eval_env_kwargs": given.get("eval_env_kwargs") or env_kwargs}
