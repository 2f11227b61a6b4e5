"""
Measure d3rlpy's Decision Transformer; run by `compare.py` in an environment of its own, since d3rlpy pins another gymnasium.

`python d3rlpy_worker.py train|act WIDTH LAYERS N` prints one line of JSON.
"""

import json
import resource
import statistics
import sys
import time
from typing import Any

import d3rlpy
import numpy as np
import torch as th

OBSERVATION_DIM, ACTION_DIM, BATCH_SIZE, CONTEXT_LENGTH = 17, 6, 64, 20


def make_dataset() -> d3rlpy.dataset.ReplayBuffer:
    """Ten episodes of 1000 steps of noise, as `worker.py` makes them."""
    rng = np.random.default_rng(0)
    episodes = [
        d3rlpy.dataset.Episode(
            rng.normal(size=(1000, OBSERVATION_DIM)).astype(np.float32),
            rng.uniform(-1, 1, (1000, ACTION_DIM)).astype(np.float32),
            rng.normal(size=(1000, 1)).astype(np.float32),
            terminated=False,
        )
        for _ in range(10)
    ]
    return d3rlpy.dataset.create_infinite_replay_buffer(episodes)


def make_algorithm(width: int, n_layers: int) -> Any:
    """The Transformer's size and the dropout of the other worker; activation and optimiser are d3rlpy's own."""
    return d3rlpy.algos.DecisionTransformerConfig(
        batch_size=BATCH_SIZE,
        context_size=CONTEXT_LENGTH,
        max_timestep=1000,
        num_heads=2,
        num_layers=n_layers,
        encoder_factory=d3rlpy.models.VectorEncoderFactory([width], exclude_last_activation=True),
        optim_factory=d3rlpy.optimizers.AdamWFactory(weight_decay=1e-3),
    ).create(device="cpu")


def train(width: int, n_layers: int, n_steps: int) -> dict[str, float]:
    """Median of the time between two steps of `fit`, its sampling included."""
    stamps = []
    make_algorithm(width, n_layers).fit(
        make_dataset(),
        n_steps=n_steps + 2,
        n_steps_per_epoch=n_steps + 2,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
        callback=lambda *_: stamps.append((time.perf_counter(), time.process_time())),
    )
    wall, processor = (statistics.median(column) * 1e3 for column in np.diff(stamps[1:], axis=0).T)
    return {"wall_ms": wall, "processor_ms": processor}


def act(width: int, n_layers: int, n_steps: int) -> dict[str, float]:
    """Median time of an action with a full context."""
    algorithm = make_algorithm(width, n_layers)
    algorithm.build_with_dataset(make_dataset())
    actor = algorithm.as_stateful_wrapper(target_return=100.0)
    rng = np.random.default_rng(0)
    times = []
    for _ in range(CONTEXT_LENGTH + n_steps):
        observation = rng.normal(size=OBSERVATION_DIM).astype(np.float32)
        start = time.perf_counter()
        actor.predict(observation, 0.0)
        times.append(time.perf_counter() - start)
    return {"wall_ms": statistics.median(times[CONTEXT_LENGTH:]) * 1e3}


def main() -> None:
    what, width, n_layers, n = sys.argv[1], *map(int, sys.argv[2:5])
    result = {"train": train, "act": act}[what](width, n_layers, n)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({**result, "peak_mib": peak, "version": d3rlpy.__version__, "torch": th.__version__}))


if __name__ == "__main__":
    main()
