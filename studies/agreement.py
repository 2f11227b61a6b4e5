"""
Distances of trained models' actions from recorded ones, and from those of the recorded agent, had it not drawn them
at random.

    python studies/agreement.py Walker2d-v5.zip ... --agent ppo-Walker2d-v5.zip --agent-algo ppo \\
        --dataset local/walker2d/expert-v0 --fraction 0.5
    python studies/agreement.py Can-v0.zip ... --dataset datasets/can.hdf5 --fraction 0.5

Models are told apart by `/dt/` and `/dtfm/` in their paths, where `sb3-dtfm train` and `benchmark` put them. Prints the root
mean square of the difference, in units of [-1, 1], at the last step of windows: of episodes learned from, and of the others;
anywhere, and among the first steps of episodes. And the share of the recorded numbers that lie at a bound of their action.
`-o FILE.json` also writes them down, by model, part and place.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch as th

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.benchmark.provenance import commit
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.recording.loading import algorithm_of, load_agent

N_WINDOWS = 4096
# Locomotion policies need so many steps until they walk steadily.
N_FIRST_STEPS = 40


def split(buffer: TrajectoryBuffer, fraction: float, seed: int) -> dict[str, TrajectoryBuffer]:
    """The episodes that `fraction` and `fraction_seed` choose, and those that they leave out."""
    learned = buffer.random_fraction(fraction, seed)
    others = np.flatnonzero(~np.isin(buffer.episodes.starts, learned.episodes.starts))
    return {"learned": learned} | ({"held out": buffer.select(others)} if len(others) else {})


def window_ends(buffer: TrajectoryBuffer) -> dict[str, th.Tensor]:
    """Draw where windows end: anywhere, and among the first steps of episodes."""
    generator = th.Generator().manual_seed(0)
    first = th.nonzero(buffer.timesteps < N_FIRST_STEPS).squeeze(1)
    return {
        "anywhere": th.randint(len(buffer), (N_WINDOWS,), generator=generator),
        f"first {N_FIRST_STEPS} steps": first[th.randint(len(first), (N_WINDOWS,), generator=generator)],
    }


def share_at_bounds(buffer: TrajectoryBuffer) -> float:
    """Share of all action dimensions at all steps whose action was as small or as large as it can be."""
    actions = buffer.actions.numpy()
    return float(((actions <= buffer.action_space.low) | (actions >= buffer.action_space.high)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--agent", help="the recorded agent; without one, only the recorded actions are compared with")
    parser.add_argument("--agent-algo")
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--fraction", type=float, default=1.0)
    parser.add_argument("--dataset-seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    if (options.agent is None) != (options.agent_algo is None):
        parser.error("--agent and --agent-algo belong together")
    agent = None if options.agent is None else load_agent(options.agent_algo, options.agent, "cpu")
    recorded = load_dataset(options.dataset)
    parts = split(recorded, options.fraction, options.dataset_seed)
    print(f"{options.dataset}: {share_at_bounds(recorded):.1%} of the recorded actions' numbers are at a bound")
    found: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for path in options.models:
        policy = ALGORITHMS[algorithm_of(path)].load(path, device="cpu").policy
        for name, buffer in parts.items():
            for where, ends in window_ends(buffer).items():
                batch = buffer.windows(ends, policy.context_length)
                targets = {}
                if agent is not None:
                    wanted, _ = agent.predict(batch.observations[:, -1].numpy(), deterministic=True)
                    targets["the agent's"] = th.as_tensor(wanted)
                targets["the recorded"] = batch.actions[:, -1]
                generator = th.Generator().manual_seed(0)
                errors = {}
                for whose, actions in targets.items():
                    target = batch._replace(actions=th.cat((batch.actions[:, :-1], actions.unsqueeze(1)), dim=1))
                    errors[whose] = policy.action_mse(target, generator) ** 0.5
                report = ", ".join(f"{error:.4f} from {whose}" for whose, error in errors.items())
                print(f"{path}: {name}, {where}: {report}", flush=True)
                found.setdefault(str(path), {}).setdefault(name, {})[where] = {
                    whose: round(float(error), 4) for whose, error in errors.items()
                }
    if options.output is not None:
        about = {"dataset": options.dataset, "fraction": options.fraction, "commit": commit()}
        options.output.write_text(json.dumps({**about, "models": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
