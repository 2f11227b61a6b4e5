"""
Baselines of fine-tuning: SAC from scratch, and SAC with the recorded episodes in its replay buffer from the start.

    OMP_NUM_THREADS=1 python studies/sac.py --like mine/robosuite-Can-v0_0.05_dtfm_seed0_small.jsonl -n 120000 \\
        --eval-freq 30000 --output mine [--with-data]

`--like` is a run of the model that is fine-tuned: its rows tell task, data and seed. Stable-Baselines3's SAC at its own
settings, in ten environments, with a gradient step for each step of one. Evaluations are those of `sb3-dtfm benchmark`, and
the rows' steps the environments'; both numbers of steps have to be multiples of ten. A run that is killed leaves no rows.
"""

import argparse
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_dtfm.benchmark.evaluation import EvaluationCallback
from sb3_dtfm.benchmark.rows import RunKey, read_rows
from sb3_dtfm.data import TrajectoryBuffer, load_dataset
from sb3_dtfm.files import replacing

N_ENVS = 10
N_FINAL_EPISODES = 100
SETTINGS = dict(gradient_steps=-1, learning_starts=1000)
OF_THE_DATA = ("dataset", "dataset_kwargs")


def fill(replay: ReplayBuffer, recorded: TrajectoryBuffer, agent: SAC) -> int:
    """
    Put recorded steps into a replay buffer, but for truncated episodes' last ones, whose next observation nobody recorded.

    :param replay: of so many environments as steps are put in at once
    :param recorded: what to put in
    :param agent: scales actions
    :return: how many steps were put in; less than one for each environment are left over
    """
    observations, actions, rewards = (getattr(recorded, name).numpy() for name in ("observations", "actions", "rewards"))
    actions = agent.policy.scale_action(actions)
    following = np.roll(observations, -1, axis=0)  # behind a terminated episode's last step nobody looks at it
    lasts = np.cumsum(recorded.episode_lengths) - 1
    done = np.zeros(len(recorded), bool)
    done[lasts] = recorded.terminated
    known = np.setdiff1d(np.arange(len(recorded)), lasts[~recorded.terminated])
    known = known[: len(known) - len(known) % replay.n_envs]
    for steps in known.reshape(-1, replay.n_envs):
        infos = [{} for _ in steps]
        replay.add(observations[steps], following[steps], actions[steps], rewards[steps], done[steps], infos)
    return len(known)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--like", type=Path, required=True)
    parser.add_argument("--with-data", action="store_true")
    parser.add_argument("-n", "--n-timesteps", type=int, required=True)
    parser.add_argument("--eval-freq", type=int, required=True)
    parser.add_argument("--eval-episodes", type=int, default=20)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    for name in ("n_timesteps", "eval_freq"):
        if vars(options)[name] % N_ENVS:
            parser.error(
                f"{name} is {vars(options)[name]}; a multiple of {N_ENVS} is accepted, one step of each environment."
            )
    th.set_num_threads(1)
    like = read_rows(options.like)[-1]
    of_the_task = {key: like["settings"][key] for key in ("env_kwargs",) if key in like["settings"]}
    of_the_data = {key: like["settings"][key] for key in OF_THE_DATA if key in like["settings"]}
    envs = make_vec_env(like["task"], N_ENVS, env_kwargs=of_the_task.get("env_kwargs"))
    agent = SAC("MlpPolicy", envs, seed=like["seed"], device="cpu", **SETTINGS)
    if options.with_data:
        recorded = load_dataset(of_the_data["dataset"], **of_the_data.get("dataset_kwargs", {}))
        print(f"{fill(agent.replay_buffer, recorded, agent)} recorded steps in the replay buffer")
    row = {
        **{key: like[key] for key in ("task", "data_share", "seed", "profile", "data")},
        "algo": "sac",
        "label": "sac-with-data" if options.with_data else "sac",
        "settings": {"n_envs": N_ENVS, **SETTINGS, **of_the_task, **(of_the_data if options.with_data else {})},
    }
    options.output.mkdir(parents=True, exist_ok=True)
    with replacing(options.output / f"{RunKey.of(row).file_name}.jsonl") as rows:
        evaluation = (options.eval_freq, options.eval_episodes, N_FINAL_EPISODES, N_ENVS)
        agent.learn(options.n_timesteps, EvaluationCallback(str(rows), row, *evaluation))


if __name__ == "__main__":
    main()
