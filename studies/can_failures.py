"""
Ends of trained models' episodes of Can that fail, to be looked at before a cure is chosen.

    python studies/can_failures.py logs/dtfm/robosuite-Can-v0_1/robosuite-Can-v0.zip ...

Plays the first hundred final episodes of `sb3-dtfm benchmark`, and sorts them by what happened: whether the can was
lifted at all, and where the hand first opened afterwards. If it let go on the way, 64 other draws of a DTFM at that
decision tell whether chance decided: printed is the share of them that lets go, too.
"""

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_dtfm.benchmark.evaluation import FINAL_STATES, make_seeded_envs
from sb3_dtfm.policies import SequencePolicy
from sb3_dtfm.recording.loading import algorithm_of, load_agent

N_EPISODES, N_ENVS, N_DRAWS = 100, 10, 64
SETTINGS = {"env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"target_return": 1.0}}]}
# Indices in an observation of the hand's position along the bins and of the can's height, in metres.
HAND_Y, CAN_Z = 1, 18
# Hand's position in metres; one of the script's 200 demonstrations lets go of the can further from the target.
RELEASED_Y = 0.3
LIFTED = 0.04
ON_THE_WAY = "let go on the way"
GRIPPER = -1  # of an action, negative to open


def sort(observations: np.ndarray, actions: np.ndarray, success: bool) -> str:
    """
    Name what an episode came to.

    :param observations: (T, O)
    :param actions: (T, A)
    :param success: whether it succeeded
    """
    if success:
        return "solved"
    if not lifted(observations).any():
        return "never lifted"
    opened = first_opened(observations, actions)
    if opened is None:
        return "never let go"
    return ON_THE_WAY if observations[opened, HAND_Y] < RELEASED_Y else "let go at the bin"


def lifted(observations: np.ndarray) -> np.ndarray:
    """(T,) bool, where the can is above its place."""
    return observations[:, CAN_Z] - observations[0, CAN_Z] > LIFTED


def first_opened(observations: np.ndarray, actions: np.ndarray) -> int | None:
    """The first step after lifting at which the hand opens."""
    lifting = np.argmax(lifted(observations))
    opened = np.flatnonzero(actions[lifting:, GRIPPER] < 0)
    return int(lifting + opened[0]) if len(opened) else None


def share_that_lets_go(policy: SequencePolicy, observation: dict[str, np.ndarray], state: tuple[np.ndarray, ...]) -> float:
    """
    Share of other draws at a decision that let go.

    :param policy: of a DTFM
    :param observation: of one row
    :param state: what it knew before
    """
    rows = np.zeros(N_DRAWS, int)
    repeated = {key: value[None][rows] for key, value in observation.items()}
    context, hidden = policy.encode(repeated, tuple(each[None][rows] for each in state), np.zeros(N_DRAWS, bool))
    noise = np.random.default_rng(0).standard_normal((N_DRAWS, policy.network.head.noise_dim))
    actions, _ = policy.decode(context, hidden, noise)
    return float((actions[:, :, GRIPPER] < 0).any(axis=1).mean())


def play(path: Path) -> tuple[Counter[str], list[float]]:
    """
    The episodes of a model, counted by what they came to.

    :param path: its zip file
    :return: the counts; and for each episode that a DTFM let go on the way, the share of other draws that did so, too
    """
    model = load_agent(algorithm_of(path), path, "cpu")
    envs = make_seeded_envs("robosuite/Can-v0", SETTINGS, N_ENVS)
    for row in range(N_ENVS):
        envs.env_method("set_episode_seeds", range(FINAL_STATES + row, FINAL_STATES + N_EPISODES, N_ENVS), indices=row)
    counts: Counter[str] = Counter()
    shares: list[float] = []
    left = np.full(N_ENVS, N_EPISODES // N_ENVS)
    steps: list[list[tuple[Any, ...]]] = [[] for _ in range(N_ENVS)]
    observations, state, starts = envs.reset(), None, np.ones(N_ENVS, bool)
    while left.any():
        known = state
        actions, state = model.predict(observations, state, starts, deterministic=True)
        for row in range(N_ENVS):
            seen = {key: value[row] for key, value in observations.items()}
            steps[row].append((seen, actions[row], None if known is None else [each[row] for each in known]))
        observations, _, starts, infos = envs.step(actions)
        for row in np.flatnonzero(starts & (left > 0)):
            seen, acted, knew = zip(*steps[row], strict=True)
            episode = np.stack([each["observation"] for each in seen]), np.stack(acted)
            kind = sort(*episode, infos[row]["is_success"])
            counts[kind] += 1
            if kind == ON_THE_WAY and model.policy.network.head.noise_dim:
                opened = first_opened(*episode)
                assert opened is not None
                decision = opened - opened % model.policy.options.n_action_steps
                shares.append(share_that_lets_go(model.policy, seen[decision], knew[decision]))
            left[row] -= 1
            steps[row] = []
    envs.close()
    return counts, shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    th.set_num_threads(1)
    for path in parser.parse_args().models:
        counts, shares = play(path)
        print(path, dict(counts.most_common()), *([f"let go, too: {np.round(shares, 2)}"] if shares else []), flush=True)


if __name__ == "__main__":
    main()
