"""
Pictures of the flow: noise on its way to actions, where the data have two.

Demonstrations go left or right, whatever is seen. DTFM and DT learn from them for some seconds.

    python studies/flow.py --output docs/images/flow.png
"""

import argparse
from pathlib import Path

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dtfm import DT, DTFM
from sb3_dtfm.callbacks import draw_flow
from sb3_dtfm.data import Trajectory, TrajectoryBuffer

N_EPISODES = 400
N_STEPS = {DTFM: 1500, DT: 300}
LEFT, RIGHT, SPREAD = (-0.8, 0.3), (0.8, 0.3), 0.07
TRUNK = dict(embed_dim=32, n_layers=1, n_heads=1, dropout=0.0)


def demonstrations() -> TrajectoryBuffer:
    """Episodes of one step, half of them to either side."""
    rng = np.random.default_rng(0)
    sides = np.array([LEFT, RIGHT])[rng.integers(2, size=N_EPISODES)]
    actions = np.clip(sides + rng.normal(0.0, SPREAD, (N_EPISODES, 2)), -1.0, 1.0)
    positions = rng.normal(0.0, 0.1, (N_EPISODES, 2))
    episodes = [Trajectory(positions[[i]], actions[[i]], np.ones(1), True) for i in range(N_EPISODES)]
    return TrajectoryBuffer.from_trajectories(episodes, spaces.Box(-1.0, 1.0, (2,)), source="two ways")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/images/flow.png"))
    options = parser.parse_args()
    settings = dict(
        dataset=demonstrations(),
        context_length=1,
        batch_size=128,
        learning_rate=2e-3,
        learning_rate_schedule="cosine",
        seed=0,
        device="cpu",
    )
    flow = dict(flow_hidden_dim=64, flow_n_layers=2, one_step_policy=False)
    models = {
        algorithm: algorithm("MultiInputPolicy", **settings, policy_kwargs={**TRUNK, **kwargs}).learn(N_STEPS[algorithm])
        for algorithm, kwargs in ((DTFM, flow), (DT, {}))
    }
    window = models[DTFM].buffer.windows(th.zeros(1, dtype=th.int64), 1)
    observation = {
        "observation": window.observations[0, 0].numpy(),
        "return_to_go": window.returns_to_go[0].numpy(),
        "timestep": window.timesteps[0].numpy(),
    }
    action, _ = models[DT].predict(observation, deterministic=True)
    figure = draw_flow(models[DTFM].policy, window)
    (axis,) = figure.axes
    axis.scatter(*action, s=90, marker="*", color="#D55E00", label="DT's action", zorder=4)
    axis.legend(frameon=False, fontsize="small", loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=3)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.output, dpi=130)
    print(options.output)


if __name__ == "__main__":
    main()
