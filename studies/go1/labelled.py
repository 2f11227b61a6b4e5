"""
Recordings whose actions are the teacher's, wherever another policy leads: a student that does not observe the velocity acts
(DAgger, Ross et al., 2011), or the teacher with noise (DART, Laskey et al., 2017), and the teacher tells what it would do.

    PYTHONPATH=studies python -m go1.labelled go1/labelled-v0 --onnx go1_policy.onnx --noise 0.1 --episodes 100
    PYTHONPATH=studies python -m go1.labelled go1/student4-v0 --onnx go1_policy.onnx \\
        --student 'logs/go1/dtfm-round 3 drag-20-0.zip' --episodes 150 --seed 34 --drag --damping

The observations hold the actions that were carried out, the dataset those of the teacher. So a model that learns from it has
to act without the past actions of its window: `go1.contexts run ... --hide-actions window`.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from go1.contexts import N_ENVS
from go1.teachers import Damping, Drag
from sb3_dtfm import DTFM
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.envs.go1 import ENV_ID
from sb3_dtfm.recording.agent import agent_actions, episode_seeds, show_progress
from sb3_dtfm.recording.episodes import EpisodeRecorder, RecordedEpisode, add_noise, run_episodes
from sb3_dtfm.recording.minari import write_minari
from sb3_dtfm.recording.onnx_agent import OnnxAgent

TEACHER = "teacher"  # key of the 48 numbers that the teacher observes


class TwoObservers(gym.Wrapper):
    """
    Adds what the teacher observes to what the student observes.

    :param env: Go1Velocity-v0 in an EpisodeRecorder, in a ReturnToGoWrapper
    """

    def reset(self, **kwargs: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        return self._both(observation, info), info

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._both(observation, info), reward, terminated, truncated, info

    def _both(self, observation: dict[str, Any], info: dict[str, Any]) -> dict[str, Any]:
        measured = self.get_wrapper_attr("recorded").observations[-1]
        return {**observation, TEACHER: np.concatenate((info["measured_velocity"], measured))}


def labelled_episodes(envs: Sequence[gym.Env], options: argparse.Namespace) -> Iterator[RecordedEpisode]:
    """
    :param envs: each in a :class:`TwoObservers`
    :param options: of the command line
    :return: the episodes, with the teacher's actions in place of those carried out
    """
    teacher, space = OnnxAgent(options.onnx), envs[0].action_space
    labels: dict[int, list[np.ndarray]] = defaultdict(list)
    student = agent_actions(DTFM.load(options.student, device="cpu"), None, True) if options.student else None

    def act(observations: dict[str, np.ndarray], starts: np.ndarray, numbers: Sequence[int]) -> np.ndarray:
        told = np.clip(teacher.predict(observations.pop(TEACHER))[0], space.low, space.high)
        for number, label in zip(numbers, told, strict=True):
            labels[number].append(label)
        return told if student is None else student(observations, starts, numbers)

    noisy = add_noise(act, space, options.noise, lambda episode: np.random.default_rng([options.seed, 2, episode]))
    for number, episode in enumerate(run_episodes(envs, noisy, episode_seeds(options.seed, options.episodes))):
        episode.actions = labels.pop(number)[: len(episode.actions)]  # finished environments stand still in their last row
        yield episode


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset_id", help="namespace/name-vN, replaced if it is there")
    parser.add_argument("--onnx", metavar="FILE", required=True, help="the teacher")
    parser.add_argument("--student", metavar="FILE", help="model that acts; the teacher by default")
    parser.add_argument("--noise", type=float, default=0.0, help="on the actions carried out, share of the action range")
    parser.add_argument("--drag", action="store_true", help="pull the robot, and hold it back or drive it on")
    parser.add_argument("--damping", action="store_true", help="joints that resist motion more")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=11)
    options = parser.parse_args()
    recorders = [EpisodeRecorder(gym.make(ENV_ID)) for _ in range(min(N_ENVS, options.episodes))]
    disturbances = [wrapper for wrapper, is_asked in ((Drag, options.drag), (Damping, options.damping)) if is_asked]
    robots: list[gym.Env] = [*recorders]
    for wrapper in disturbances:
        robots = [wrapper(robot) for robot in robots]
    envs = [TwoObservers(ReturnToGoWrapper(robot, target_return=0.0)) for robot in robots]
    who = options.student or "the teacher"
    who += " with " + " and ".join((f"noise {options.noise:g}", *(each.__name__.lower() for each in disturbances)))
    about = f"re-recorded: {options.episodes} episodes of {who}, labelled by {options.onnx}."
    metadata = {"algorithm_name": "OnnxAgent", "description": about, "ref_min_score": 0.0}
    metadata["num_episodes_average_score"] = options.episodes
    episodes = show_progress(labelled_episodes(envs, options), options.episodes, True)
    write_minari(options.dataset_id, episodes, recorders[0].env, metadata)


if __name__ == "__main__":
    main()
