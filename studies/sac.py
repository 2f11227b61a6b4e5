"""
What fine-tuning stands beside: SAC from scratch, and SAC with the recorded episodes in its replay buffer from the start.

    OMP_NUM_THREADS=1 python studies/sac.py --like mine/robosuite-Can-v0_0.05_dtfm_seed0_small.jsonl -n 120000 \\
        --eval-freq 30000 --output results/finetuning [--with-data]

`--like` is a cell of the model that is fine-tuned: its rows tell task, data and seed. Stable-Baselines3's SAC at its own
settings, in ten environments, with a gradient step for each step of one. The initial states of the evaluations are those of
`sb3-dtfm benchmark`, and the rows' steps the environments'.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_dtfm.benchmark import provenance
from sb3_dtfm.benchmark.evaluation import FINAL_STATES, TRAINING_STATES, evaluate, make_seeded_envs
from sb3_dtfm.benchmark.rows import Cell, Row, read_rows, write_row
from sb3_dtfm.data import TrajectoryBuffer, load_dataset

N_ENVS = 10
N_FINAL_EPISODES = 100
SETTINGS = dict(gradient_steps=-1, learning_starts=1000)


def fill(replay: ReplayBuffer, recorded: TrajectoryBuffer, agent: SAC) -> int:
    """
    Put recorded steps into a replay buffer, but for truncated episodes' last ones, whose next observation nobody recorded.

    :param replay: of so many environments as steps are put in at once
    :param recorded: what to put in
    :param agent: scales actions
    :return: how many steps were put in; less than one for each environment are left over
    """
    observations, actions, rewards = (
        getattr(recorded, name)[recorded.rows].numpy() for name in ("observations", "actions", "rewards")
    )
    stops = np.cumsum(recorded.episode_lengths) - 1
    done = np.zeros(len(recorded), bool)
    done[stops] = recorded.terminated
    known = np.flatnonzero(~np.isin(np.arange(len(recorded)), stops[~recorded.terminated]))
    following = np.where(done, np.arange(len(recorded)), np.minimum(np.arange(len(recorded)) + 1, len(recorded) - 1))
    actions = agent.policy.scale_action(actions)
    n_rows = len(known) // replay.n_envs
    for steps in known[: n_rows * replay.n_envs].reshape(n_rows, replay.n_envs):
        infos = [{} for _ in steps]
        replay.add(observations[steps], observations[following[steps]], actions[steps], rewards[steps], done[steps], infos)
    return n_rows * replay.n_envs


class Evaluate(BaseCallback):
    """
    Write a row before the first step, every `eval_freq` steps, and a final one.

    :param file: to append to
    :param row: what all rows say
    :param envs: to act in
    :param eval_freq: environment steps between two evaluations
    :param n_episodes: of each but the final one
    """

    def __init__(self, file: Path, row: Row, envs: VecEnv, eval_freq: int, n_episodes: int) -> None:
        super().__init__()
        self.file, self.row, self.envs, self.eval_freq, self.n_episodes = file, row, envs, eval_freq, n_episodes
        self.seconds, self.resumed = 0.0, 0.0

    def _on_training_start(self) -> None:
        self.resumed = time.perf_counter()
        self.evaluate(final=False)

    def _on_step(self) -> bool:
        if self.num_timesteps % self.eval_freq < self.training_env.num_envs:
            self.evaluate(final=False)
        return True

    def _on_training_end(self) -> None:
        self.evaluate(final=True)

    def evaluate(self, final: bool) -> None:
        """
        :param final: of the states that nobody could choose a model by
        """
        self.seconds += time.perf_counter() - self.resumed
        first, n_episodes = (FINAL_STATES, N_FINAL_EPISODES) if final else (TRAINING_STATES, self.n_episodes)
        episodes = evaluate(self.model, self.envs, range(first, first + n_episodes))
        speed = {
            "wall_s": round(self.seconds, 3),
            "steps_per_s": round(self.num_timesteps / max(self.seconds, 1e-9), 3),
            "hardware": provenance.hardware(self.model.device),
        }
        write_row(self.file, {**self.row, "step": self.num_timesteps, "final": final, **episodes._asdict(), **speed})
        self.resumed = time.perf_counter()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--like", type=Path, required=True)
    parser.add_argument("--with-data", action="store_true")
    parser.add_argument("-n", "--n-timesteps", type=int, required=True)
    parser.add_argument("--eval-freq", type=int, required=True)
    parser.add_argument("--eval-episodes", type=int, default=20)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    th.set_num_threads(1)
    like = read_rows(options.like)[-1]
    label = "sac-with-data" if options.with_data else "sac"
    task = {key: like["settings"][key] for key in ("env_kwargs",) if key in like["settings"]}
    data = {key: like["settings"][key] for key in ("dataset", "dataset_fraction", "dataset_seed") if key in like["settings"]}
    envs, evaluated = (make_seeded_envs(like["task"], task, N_ENVS) for _ in range(2))
    envs.seed(like["seed"])
    agent = SAC("MlpPolicy", envs, seed=like["seed"], device="cpu", **SETTINGS)
    if options.with_data:
        recorded = load_dataset(data["dataset"], **like["settings"].get("dataset_kwargs", {}))
        recorded = recorded.random_fraction(data.get("dataset_fraction", 1.0), data.get("dataset_seed", 0))
        print(f"{fill(agent.replay_buffer, recorded, agent)} recorded steps in the replay buffer")
    row = {
        **{key: like[key] for key in ("task", "regime", "seed", "profile", "data")},
        "algo": "sac",
        "label": label,
        "solver": None,
        "n_solver_steps": None,
        "settings": {"n_envs": N_ENVS, **SETTINGS, **task, **(data if options.with_data else {})},
        "commit": provenance.commit(),
        "versions": provenance.versions(),
    }
    options.output.mkdir(parents=True, exist_ok=True)
    file = options.output / f"{Cell.of(row).file_name}.jsonl"
    file.unlink(missing_ok=True)
    agent.learn(
        options.n_timesteps, Evaluate(file, row, evaluated, options.eval_freq, options.eval_episodes), progress_bar=True
    )


if __name__ == "__main__":
    main()
