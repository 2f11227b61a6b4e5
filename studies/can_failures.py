"""
Where trained models' attempts at Can end that fail: what to look at before a cure is chosen.

    python studies/can_failures.py logs/dtfm/robosuite-Can-v0_1/robosuite-Can-v0.zip ...

Plays the first hundred final episodes of `sb3-dtfm benchmark`, and sorts them by what is seen and done: whether the can was
lifted at all, and where the hand first opened afterwards.
"""

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
import torch as th

from sb3_dtfm.benchmark.evaluation import FINAL_STATES, make_seeded_envs
from sb3_dtfm.recording.loading import algorithm_of, load_agent

N_EPISODES, N_ENVS = 100, 10
SETTINGS = {"env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}]}
# Of an observation, in metres: the hand's place along the bins, and the can's height.
HAND_Y, CAN_Z = 1, 18
# Of the script's 200 demonstrations one lets go of the can further from the target.
RELEASED_Y = 0.3
LIFTED = 0.04
GRIPPER = -1  # of an action, negative to open


def sort(observations: np.ndarray, actions: np.ndarray, success: bool) -> str:
    """
    What an episode came to.

    :param observations: (T, O)
    :param actions: (T, A)
    :param success: whether it succeeded
    """
    if success:
        return "solved"
    lifted = np.flatnonzero(observations[:, CAN_Z] - observations[0, CAN_Z] > LIFTED)
    if not len(lifted):
        return "never lifted"
    opened = lifted[0] + np.flatnonzero(actions[lifted[0] :, GRIPPER] < 0)
    if not len(opened):
        return "never let go"
    return "let go on the way" if observations[opened[0], HAND_Y] < RELEASED_Y else "let go at the bin"


def play(path: Path) -> Counter[str]:
    """
    The episodes of a model, counted by what they came to.

    :param path: its zip file
    """
    model = load_agent(algorithm_of(path), path, "cpu")
    envs = make_seeded_envs("robosuite/Can-v0", SETTINGS, N_ENVS)
    for row in range(N_ENVS):
        envs.env_method("set_episode_seeds", range(FINAL_STATES + row, FINAL_STATES + N_EPISODES, N_ENVS), indices=row)
    counts: Counter[str] = Counter()
    left = np.full(N_ENVS, N_EPISODES // N_ENVS)
    steps: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in range(N_ENVS)]
    observations, state, starts = envs.reset(), None, np.ones(N_ENVS, bool)
    while left.any():
        actions, state = model.predict(observations, state, starts, deterministic=True)
        for row in range(N_ENVS):
            steps[row].append((observations["observation"][row], actions[row]))
        observations, _, starts, infos = envs.step(actions)
        for row in np.flatnonzero(starts & (left > 0)):
            counts[sort(*map(np.stack, zip(*steps[row], strict=True)), infos[row]["is_success"])] += 1
            left[row] -= 1
            steps[row] = []
    envs.close()
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    th.set_num_threads(1)
    for path in parser.parse_args().models:
        print(path, dict(play(path).most_common()), flush=True)


if __name__ == "__main__":
    main()
