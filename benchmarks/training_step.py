"""
Time of one gradient step of DTFM on the CPU, at the small and at the paper's size: `python benchmarks/training_step.py`.

Prints medians over the steps: wall-clock and processor time. Compare two settings by running them in turn on the same
machine, for example with `OMP_WAIT_POLICY=ACTIVE` and without, or with `OMP_NUM_THREADS=1`.
"""

import statistics
import time

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dtfm import DTFM
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.optimization import has_fast_bfloat16

OBSERVATION_DIM, ACTION_DIM, BATCH_SIZE = 17, 6, 64
SIZES = {
    "width 128, 3 layers": (dict(embed_dim=128, n_layers=3, flow_hidden_dim=256), 20),
    "width 256, 10 layers": (dict(embed_dim=256, n_layers=10, flow_hidden_dim=512), 5),
}


def make_buffer() -> TrajectoryBuffer:
    """Ten episodes of 1000 steps of noise: the time of a step does not depend on what the numbers mean."""
    rng = np.random.default_rng(0)
    episodes = [
        Trajectory(rng.normal(size=(1000, OBSERVATION_DIM)), rng.uniform(-1, 1, (1000, ACTION_DIM)), rng.normal(size=1000))
        for _ in range(10)
    ]
    return TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1, 1, (ACTION_DIM,)))


def main() -> None:
    precision = "bfloat16" if has_fast_bfloat16(th.device("cpu")) else "float32"
    print(f"torch {th.__version__}, {th.get_num_threads()} threads, {precision}, batch {BATCH_SIZE}")
    buffer = make_buffer()
    for name, (policy_kwargs, n_steps) in SIZES.items():
        model = DTFM("MultiInputPolicy", dataset=buffer, batch_size=BATCH_SIZE, policy_kwargs=policy_kwargs, device="cpu")
        stamps: list[tuple[float, float]] = []
        model.learn(
            n_steps + 2,
            callback=lambda *_, stamps=stamps: stamps.append((time.perf_counter(), time.process_time())) is None,
            log_interval=None,
        )
        differences = np.diff(stamps[1:], axis=0) * 1e3
        wall, processor = (statistics.median(column) for column in differences.T)
        print(f"{name}: {wall:.0f} ms wall, {processor:.0f} ms processor")


if __name__ == "__main__":
    main()
