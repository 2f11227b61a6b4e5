"""
Push-T of gym-pusht (`pip install gym-pusht`) from its state or from images, and the demonstrations of Diffusion Policy
(Chi et al., 2023).

    PYTHONPATH=studies python -m pusht pusht_cchi_v7_lowdim.npz pusht.npz
    PYTHONPATH=studies python -m pusht pusht_cchi_v7_replay.zarr.zip pusht_images.npz     # needs the extra `zarr`
    PYTHONPATH=studies python -m pusht pusht_cchi_v7_lowdim.npz     # how well people did; that mirroring changes nothing
    PYTHONPATH=studies sb3-dtfm benchmark --gym-packages pusht --env PushT-v0 --profile studies/pusht.yml ...

The block's angle is told by its sine and cosine, since it jumps from 2 pi to 0. A step's reward is by how much the overlap
with the target surpasses the largest so far: an episode's return is its largest overlap, as a share of the 95 % that count
as success.

Walls and target stay where they are when the scene is mirrored at the target's axis, and so does the task: demonstrations
are written as they were recorded, and mirrored.
"""

import argparse
import os
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

EPISODE_STEPS = 300
SIZE = 512  # pixels of the square; the target's axis is the diagonal on which x + y is as much


def features(state: np.ndarray) -> np.ndarray:
    """
    :param state: (..., 5), pixels and rad: position of the tool, position and angle of the block
    :return: (..., 6) float32
    """
    angle = state[..., 4:]
    return np.concatenate((state[..., :4], np.sin(angle), np.cos(angle)), axis=-1).astype(np.float32)


def mirrored_images(images: np.ndarray) -> np.ndarray:
    """
    :param images: (..., side, side, channels)
    :return: those of the scene mirrored at the target's axis
    """
    return images[..., ::-1, ::-1, :].swapaxes(-3, -2)


def mirrored(state: np.ndarray) -> np.ndarray:
    """
    :param state: (..., 5), pixels and rad, or only the tool's position, (..., 2)
    :return: the same of the scene mirrored at the target's axis
    """
    positions = [SIZE - state[..., i : i + 2][..., ::-1] for i in range(0, state.shape[-1] - 1, 2)]
    return np.concatenate((*positions, np.pi / 2 - state[..., 4:]), axis=-1)


class LargestOverlap(gym.Wrapper):
    """Push-T whose returns are the largest overlap of the episode."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.largest = 0.0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.largest = 0.0
        return self.env.reset(**kwargs)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, overlap, terminated, truncated, info = self.env.step(action)
        gain = max(0.0, float(overlap) - self.largest)
        self.largest += gain
        return observation, gain, terminated, truncated, info


def make_simulator(obs_type: str = "state", **kwargs: Any) -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    from gym_pusht.envs import PushTEnv

    return PushTEnv(obs_type=obs_type, **kwargs)


def make(**kwargs: Any) -> gym.Env:
    """Push-T with :func:`features` for observations."""
    space = gym.spaces.Box(-np.inf, np.inf, (6,), np.float32)
    return gym.wrappers.TransformObservation(LargestOverlap(make_simulator(**kwargs)), features, space)


def make_with_images(**kwargs: Any) -> gym.Env:
    """Push-T with images of 96 x 96 and the tool's position for observations."""
    return LargestOverlap(make_simulator(obs_type="pixels_agent_pos", **kwargs))


def read_recorded(source: str) -> Any:
    """
    :param source: the published file, with images (`.zarr.zip`) or without (`.npz`)
    :return: its arrays by name, `episode_ends` and, where it holds them, `img` (N, 96, 96, 3) uint8 among them
    """
    if not source.endswith(".zip"):
        with np.load(source) as recorded:
            return dict(recorded)
    import zarr

    published = zarr.open_group(zarr.storage.ZipStore(source, mode="r"), mode="r")
    arrays = {name: published["data"][name][:] for name in ("state", "action")}
    images = published["data"]["img"]
    frames = np.empty(images.shape, np.uint8)
    for start in tqdm(range(0, len(frames), 1000), desc="images"):
        frames[start : start + 1000] = images[start : start + 1000]
    return {**arrays, "img": frames, "episode_ends": published["meta"]["episode_ends"][:]}


def simulated_overlaps(states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """
    Return what the simulator rewards each recorded step with, put into the recorded state before each.

    :param states: (T, 5) of one episode
    :param actions: (T, 2)
    :return: (T,), overlaps as shares of the 95 % that count as success
    """
    simulator = make_simulator()
    simulator.reset(seed=0)
    overlaps = []
    for state, action in zip(states.astype(float), actions.astype(float), strict=True):
        simulator.agent.position, simulator.block.angle = tuple(state[:2]), state[4]
        simulator.block.position = tuple(state[2:4])  # after the angle, which turns it about another point
        simulator.block.velocity, simulator.block.angular_velocity = (0.0, 0.0), 0.0
        overlaps.append(simulator.step(action)[1])
    return np.array(overlaps)


gym.register("PushT-v0", entry_point=make, max_episode_steps=EPISODE_STEPS)
gym.register("PushTImages-v0", entry_point=make_with_images, max_episode_steps=EPISODE_STEPS)


def main(source: str, target: str | None = None) -> None:
    """Write the dataset, or print how well people did."""
    recorded = read_recorded(source)
    states, actions, ends = recorded["state"], recorded["action"], recorded["episode_ends"]
    if target is None:
        episodes = list(zip(np.split(states, ends[:-1]), np.split(actions, ends[:-1]), strict=True))
        overlaps = [simulated_overlaps(*episode) for episode in tqdm(episodes)]
        images = [simulated_overlaps(*map(mirrored, episode)) for episode in tqdm(episodes, desc="mirrored")]
        largest = np.array([each.max() for each in overlaps])
        print(f"largest overlap {largest.mean():.3f}, solved {np.sum(largest >= 1.0)} of {len(largest)}")
        difference = np.abs(np.concatenate(images) - np.concatenate(overlaps)).max()
        print(f"largest difference of an overlap when mirrored {difference:.2g}")
        return
    observations = features(np.concatenate((states, mirrored(states))))
    images = {}
    if "img" in recorded:
        images["image:pixels"] = np.concatenate((recorded["img"], mirrored_images(recorded["img"])))
        observations = observations[:, :2]  # the tool's position
    np.savez(
        target,
        **images,
        observations=observations,
        actions=np.concatenate((actions, mirrored(actions))),
        episode_ends=np.concatenate((ends, ends[-1] + ends)),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="recorded by people, .npz or .zarr.zip")
    parser.add_argument("target", nargs="?", help=".npz file to write")
    main(**vars(parser.parse_args()))
