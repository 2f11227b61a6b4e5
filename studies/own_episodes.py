"""
What an arm may learn from attempts of its own: Can, from ten demonstrations (docs/studies/finetuning.md).

    python studies/own_episodes.py gather MODEL ... --episodes 60 --seed 5000 -o gathered.npz
    python studies/own_episodes.py weigh EPISODES.npz -o weighted.npz
    python studies/own_episodes.py turns MODEL --turns 12 -o turns.zip

`gather` has models attempt episodes and writes the ten demonstrations and what succeeded, or with `--failures` all; `weigh`
repeats successes whose neighbours fail; both are learned from anew by

    sb3-dtfm benchmark --dataset robosuite/Can-v0=FILE --env robosuite/Can-v0 --fractions 1 --target-return 1 --algo dtfm \
        --final-episodes 100

`turns` is `sb3-dtfm finetune --algo dtfm`, but that each turn begins from fresh weights of another seed.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, evaluate, make_seeded_envs
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.distributed import DataParallel
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import OnlineDTFM

TARGET: dict[str, Any] = {"target_return": 1.0}
N_ENVS, N_ATTEMPTS = 10, 50
TURNS = {"gradient_steps": 2000, "learning_rate": 1e-3, "learning_rate_schedule": "cosine", "warmup_steps": 100}
# Of an observation: the can's place beside the hand, and its turn, as an episode begins; places count twice.
PLACE, TURN, NEIGHBOURS = [9, 10], [12, 13, 14, 15], 10


class UntilEpisodes(BaseCallback):
    """
    Ends the training once there are so many own episodes.

    :param n_episodes: of all turns together
    """

    def __init__(self, n_episodes: int) -> None:
        super().__init__()
        self.n_episodes = n_episodes

    def _on_step(self) -> bool:
        assert isinstance(self.model, OnlineDTFM)
        return self.model.own is None or self.model.own.n_episodes < self.n_episodes


class Attempts(OnlineDTFM):
    """It acts, and learns nothing."""

    def _imitate(self, parallel: DataParallel) -> None:
        pass


class FreshTurns(OnlineDTFM):
    """Each turn is another model's."""

    began: float
    n_before = 0

    def _imitate(self, parallel: DataParallel) -> None:
        assert self.own is not None
        share, minutes = self.own.successes[self.n_before :].mean(), (time.monotonic() - self.began) / 60
        print(f"{self.own.n_episodes} own episodes, {share:.0%} of the new ones solved, {minutes:.1f} minutes", flush=True)
        self.n_before = self.own.n_episodes
        th.manual_seed(1000 * (self.seed or 0) + self._n_updates + 7)
        fresh = self._make_policy(ema=False).network.state_dict()
        for network in (self.policy.network, self.policy.ema_network):
            assert network is not None
            network.load_state_dict(fresh)
        self.policy.optimizer.state.clear()
        self.policy.update_ema = self._follow  # type: ignore[method-assign]
        super()._imitate(parallel)

    def _follow(self, decay: float) -> None:
        """The moving average begins with the turn, as it does with a training."""
        n_learned = self._n_updates - self._turn_start
        type(self.policy).update_ema(self.policy, min(decay, (1 + n_learned) / (10 + n_learned)))


def make_envs(seed: int) -> VecEnv:
    """Ten of them, whose episodes begin as the seed has it."""
    return make_vec_env("robosuite/Can-v0", N_ENVS, seed, wrapper_class=ReturnToGoWrapper, wrapper_kwargs=TARGET)


def gather(options: argparse.Namespace) -> None:
    """Attempts of each model, in the models' order from seeds 1,000 apart."""
    found = [load_dataset(options.dataset).random_fraction(options.fraction, 0)]
    for i, path in enumerate(options.models):
        envs = make_envs(options.seed + 1000 * i)
        settings = {"dataset_fraction": options.fraction, "n_episodes": options.episodes, "device": "cpu"}
        model = Attempts.load(path, envs, dataset=options.dataset, seed=options.seed + i, **settings)
        model.learn(10**9, callback=UntilEpisodes(options.episodes))
        assert model.own is not None
        print(f"{path}: {model.own.successes.sum():.0f} of {model.own.n_episodes} solved", flush=True)
        model.own.action_space = found[0].action_space  # a file's is of single precision, as its bounds
        found.append(model.own if options.failures else model.own.select(np.flatnonzero(model.own.successes == 1.0)))
        envs.close()
    TrajectoryBuffer.join(found, [1.0] * len(found)).save(options.output)


def weigh(options: argparse.Namespace) -> None:
    """Successes in inverse proportion to how often attempts from the nearest initial states succeed."""
    episodes = load_dataset(options.episodes)
    first = episodes.observations[episodes.episodes.starts].numpy()
    where = first[:, PLACE + TURN] / first[:, PLACE + TURN].std(axis=0).clip(1e-3) * ([2.0, 2.0] + [1.0] * len(TURN))
    distances = np.square(where[:, None] - where).sum(axis=-1)
    nearest = distances.argsort(axis=1)[:, : NEIGHBOURS + 1]
    likely = (episodes.successes[nearest].sum(axis=1) + 0.5) / (NEIGHBOURS + 2)
    weights = episodes.successes / likely
    copies = np.round(2 * weights / weights[weights > 0].min()).astype(int)
    episodes.select(np.arange(episodes.n_episodes).repeat(copies)).save(options.output)


def turns(options: argparse.Namespace) -> None:
    """And the last model's hundred final episodes."""
    settings = {"dataset_fraction": options.fraction, "n_episodes": N_ATTEMPTS, "device": "cpu", **TURNS}
    model = FreshTurns.load(
        options.model, make_envs(options.seed + 77), dataset=options.dataset, seed=options.seed, **settings
    )
    model.began = time.monotonic()
    model.learn(10**9, callback=UntilEpisodes(options.turns * N_ATTEMPTS))
    model.save(options.output)
    envs = make_seeded_envs("robosuite/Can-v0", {"env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": TARGET}]}, N_ENVS)
    final = evaluate(DTFM.load(options.output, device="cpu"), envs, range(FINAL_STATES, FINAL_STATES + 100), lambda n: None)
    assert final.successes is not None
    print(f"{sum(final.successes)} of 100 solved")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", default="datasets/can.hdf5", help="of the demonstrations")
    parser.add_argument("--fraction", type=float, default=0.05, help="of them; 0.05, ten of 200, by default")
    commands = parser.add_subparsers(required=True)
    for command in (gather, weigh, turns):
        sub = commands.add_parser(command.__name__)
        sub.set_defaults(command=command)
        sub.add_argument("-o", "--output", type=Path, required=True)
        if command is gather:
            sub.add_argument("models", nargs="+", type=Path)
            sub.add_argument("--episodes", type=int, default=60)
            sub.add_argument("--failures", action="store_true", help="keep them as well, for a critic")
        elif command is weigh:
            sub.add_argument("episodes", type=Path)
        else:
            sub.add_argument("model", type=Path)
            sub.add_argument("--turns", type=int, default=12)
        if command is not weigh:
            sub.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    th.set_num_threads(1)
    options.command(options)


if __name__ == "__main__":
    main()
