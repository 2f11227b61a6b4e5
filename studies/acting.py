"""
Success of trained models by the way they act, from the same initial states (docs/studies/images.md).

    PYTHONPATH=studies SDL_VIDEODRIVER=dummy python studies/acting.py logs/PushTImages-v0.zip --env PushTImages-v0 \\
        --gym-packages pusht --acting n_action_steps:6 --episodes 200

Plays final episodes of `sb3-dtfm benchmark`, or those from `--first` on, with a target return of 1.
"""

import argparse
import importlib
from pathlib import Path

import numpy as np
import torch as th
from several_models import SETTINGS

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.cli.literals import key_value

N_ENVS = 20


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--env", required=True)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--acting", nargs="+", type=key_value, default=[], help="as `set_acting` takes them")
    parser.add_argument("--first", type=int, default=0, help="final episode to begin with")
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args()
    for package in options.gym_packages:
        importlib.import_module(package)
    th.set_num_threads(1)
    first = FINAL_STATES + options.first
    for path in options.models:
        model = DTFM.load(path, device="cpu")
        model.policy.set_acting(**dict(options.acting))
        found = evaluate(model, make_seeded_envs(options.env, SETTINGS, N_ENVS), range(first, first + options.episodes))
        solved = "" if found.successes is None else f", {np.sum(found.successes):.0f} of {options.episodes} solved"
        print(f"{path}: mean return {np.mean(found.returns):.3f}{solved}", flush=True)


if __name__ == "__main__":
    main()
