"""
Ways in which a critic's two values may choose among draws (docs/studies/random-walks.md).

    python studies/choosing.py MODEL --env AdroitHandDoor-v1 --target-return 3000 --ways one gain smaller >> choosing.jsonl

`one` asks no critic; `gain` is what the package does; `smaller` takes the draw whose smaller value is largest, `mean` that
of the largest mean; `margin` takes another draw than the first only for a gain above the spread of advantages in the data.
Episodes are final ones of `sb3-dtfm benchmark` from `--first` on, the same for all ways.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.policies.critic import Critic
from sb3_dtfm.zoo.arguments import import_packages, key_values

WAYS = ("one", "gain", "smaller", "mean", "margin")
N_ENVS = 10


def change(critic: Critic, way: str) -> None:
    """Let a critic's gains be what another way would take the largest of."""
    plain = critic.gains

    def gains(observations: th.Tensor, actions: th.Tensor) -> th.Tensor:
        if way == "margin":
            found = plain(observations, actions)
            found[:, 1:] -= critic.advantage_std
            return found
        pairs = th.cat((observations.unsqueeze(1).expand(-1, actions.shape[1], -1), actions), dim=-1)
        values = th.stack([q(pairs).squeeze(-1) for q in critic.q_target])
        return values.amin(dim=0) if way == "smaller" else values.mean(dim=0)

    if way not in ("one", "gain"):
        critic.gains = gains  # type: ignore[method-assign]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--env", required=True)
    parser.add_argument("--env-kwargs", nargs="+", default=[])
    parser.add_argument("--target-return", type=float, required=True)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--acting", nargs="+", default=["n_action_samples:8"], help="as in sb3-dtfm sweep")
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--episodes", type=int, default=300)
    options = parser.parse_args()
    th.set_num_threads(1)
    import_packages(options.gym_packages)
    wrapper = {"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": options.target_return}}
    settings: dict[str, Any] = {"env_wrapper": [wrapper], "env_kwargs": key_values("--env-kwargs", options.env_kwargs)}
    envs = make_seeded_envs(options.env, settings, N_ENVS)
    states = range(FINAL_STATES + options.first, FINAL_STATES + options.first + options.episodes)
    acting = key_values("--acting", options.acting)
    for way in options.ways:
        policy = (model := DTFM.load(options.model, device="cpu")).policy
        assert policy.critic is not None
        policy.set_acting(**(acting if way != "one" else {"n_action_samples": 1}))
        change(policy.critic, way)
        found = evaluate(model, envs, states, lambda n: None)
        successes = None if found.successes is None else int(np.sum(found.successes))
        about = {"env": options.env, "way": way, "acting": acting, "first": options.first, "episodes": options.episodes}
        print(json.dumps({**about, "successes": successes, "mean_return": float(np.mean(found.returns))}), flush=True)


if __name__ == "__main__":
    main()
