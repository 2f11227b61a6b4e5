"""
Worth of the critic's choice for manipulation by how samples are drawn, and by whom (docs/studies/rollouts.md).

    python studies/action_samples.py --n 16 --noise 1.5 logs/dtfm/robosuite-Can-v0_7/robosuite-Can-v0.zip ...
    python studies/action_samples.py --together models --n 8 ONE.zip TWO.zip THREE.zip

Plays final episodes of `sb3-dtfm benchmark`, from the thousandth on with `--first 1000`. `--together models` takes the most
valuable of what all models draw, by the mean of their critics, `critics` of what the first one draws.
"""

import argparse
from pathlib import Path

import numpy as np
import torch as th
from several_models import N_ENVS, SETTINGS, newest_hidden, replace_choice

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.windows import Windows


def choose_together(policies: list[SequencePolicy], draws_of_all: bool) -> None:
    """
    Let the first policy carry out what the mean of all critics finds most valuable.

    :param policies: with critics, of the same sizes, without `kv_cache`
    :param draws_of_all: whose samples; the first one's alone otherwise
    """

    def decide(windows: Windows, rows: np.ndarray, deterministic: bool) -> th.Tensor:
        seen = windows.observations[:, -1]
        drawn = [
            each._best_of_n(newest_hidden(each, windows), seen, rows, deterministic)[0]
            for each in (policies if draws_of_all else policies[:1])
        ]
        samples = th.cat(drawn, dim=1)
        gains = th.zeros(samples.shape[:2])
        for each in policies:
            assert each.critic is not None
            gains += each.critic.gains(
                each.normalization.scale_observation(seen), samples[..., : each.critic_horizon * each.action_dim]
            )
        return samples[th.arange(len(rows)), gains.argmax(dim=1)]

    replace_choice(policies, decide)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--n", type=int, default=8, help="samples; 8 by default")
    parser.add_argument("--noise", type=float, default=1.0, help="sample_noise_std; 1 by default")
    parser.add_argument("--env", default="robosuite/Can-v0", help="robosuite/Can-v0 by default")
    parser.add_argument("--together", choices=("models", "critics"))
    parser.add_argument("--first", type=int, default=0, help="final episode to begin with")
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args()
    th.set_num_threads(1)
    models = [DTFM.load(path, device="cpu") for path in options.models]
    for model in models:
        model.policy.set_acting(n_action_samples=options.n, sample_noise_std=options.noise)
    if options.together:
        choose_together([model.policy for model in models], options.together == "models")
    envs = make_seeded_envs(options.env, SETTINGS, N_ENVS)
    states = range(FINAL_STATES + options.first, FINAL_STATES + options.first + options.episodes)
    for path, model in list(zip(options.models, models, strict=True))[: 1 if options.together else None]:
        found = evaluate(model, envs, states, lambda n: None)
        assert found.successes is not None
        print(f"{path}: {np.sum(found.successes):.0f} of {options.episodes} solved", flush=True)


if __name__ == "__main__":
    main()
