"""
Several models that decide together: DTFMs of the same data and settings, trained from different seeds.

    python studies/several_models.py mean logs/0/robosuite-Can-v0.zip logs/1/robosuite-Can-v0.zip ...

Each model draws from the same noise for what has been seen and done so far. Carried out is the mean or median of the draws,
the one that is nearest to all others, or that of the model which episode and time step choose. Plays the first hundred final
episodes of `sb3-dtfm benchmark` at Can.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch as th

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.policies.context import Context
from sb3_dtfm.windows import Windows

N_EPISODES, N_ENVS = 100, 10
SETTINGS = {"env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}]}
Decide = Callable[[Windows, np.ndarray, bool], th.Tensor]
WAYS = ("mean", "median", "nearest", "one")


def agree(chunks: th.Tensor, way: str, rows: np.ndarray) -> th.Tensor:
    """
    :param chunks: (M, b, N) of M models
    :param way: one of `WAYS`
    :param rows: (b,) that choose a model
    :return: (b, N)
    """
    if way == "mean":
        return chunks.mean(dim=0)
    if way == "median":
        return chunks.median(dim=0).values
    if way == "nearest":
        distances = (chunks[:, None] - chunks[None]).abs().sum(dim=(1, 3))
        chosen = distances.argmin(dim=0)
    else:
        chosen = th.from_numpy(rows % len(chunks))
    return chunks[chosen, th.arange(chunks.shape[1])]


def replace_choice(policies: list[SequencePolicy], decide: Decide) -> None:
    """
    Let the first policy carry out what is decided otherwise.

    :param policies: of the same sizes, without `kv_cache`
    :param decide: from the windows of b rows, what chooses their noise (b,), and whether to be deterministic, to (b, N)
    """
    first = policies[0]
    for policy in policies:
        policy.set_training_mode(False)

    def choose(context: Context, due: np.ndarray, hidden: th.Tensor, deterministic: bool) -> th.Tensor:
        windows = Windows(*(th.from_numpy(each[due]) for each in context.windows))
        rows = context.timesteps[due, -1] + context.episode_keys[due]
        return decide(windows, rows, deterministic)

    first._choose = choose  # type: ignore[method-assign]


def newest_hidden(policy: SequencePolicy, windows: Windows) -> th.Tensor:
    """Hidden states of the newest steps, (b, D)."""
    return policy.acting_network.newest_hidden(policy.normalization(windows))


def decide_together(policies: list[SequencePolicy], way: str) -> None:
    """
    Let the first policy carry out what all of them decide.

    :param policies: of the same sizes, without `kv_cache`
    :param way: one of `WAYS`
    """

    def decide(windows: Windows, rows: np.ndarray, deterministic: bool) -> th.Tensor:
        noise = policies[0]._acting_noise(rows, deterministic)
        return agree(
            th.stack([each.acting_network.decode(newest_hidden(each, windows), noise) for each in policies]), way, rows
        )

    replace_choice(policies, decide)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("way", choices=WAYS)
    parser.add_argument("models", nargs="+", type=Path)
    options = parser.parse_args()
    th.set_num_threads(1)
    models = [DTFM.load(path, device="cpu") for path in options.models]
    decide_together([model.policy for model in models], options.way)
    envs = make_seeded_envs("robosuite/Can-v0", SETTINGS, N_ENVS)
    found = evaluate(models[0], envs, range(FINAL_STATES, FINAL_STATES + N_EPISODES), lambda n: None)
    assert found.successes is not None
    print(f"{options.way} of {len(models)} models: {np.sum(found.successes):.0f} of {N_EPISODES} solved")


if __name__ == "__main__":
    main()
