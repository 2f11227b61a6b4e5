"""
Time that learning and acting with two cameras of 84 x 84 takes, beside the encoder's products alone. On one core:

    OMP_NUM_THREADS=1 python studies/image_steps.py

Batches of 64 with the classes' defaults. Products are the convolutions and matrix products of a gradient step, of the same
shapes and layouts, computed once more and without anything else. Times are of the processor, medians of steps in turn.
"""

import argparse
import statistics
import time
from typing import Any

import numpy as np
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_dtfm import DTFM

CAMERAS, SIDE, BATCH_SIZE = ("agentview", "robot0_eye_in_hand"), 84, 64
EXTRACTORS = ("ResidualExtractor", "NatureCNN", "ResNet18")
NAMES = ("mm", "addmm", "bmm", "baddbmm", "convolution", "convolution_backward")
PRODUCTS = [getattr(th.ops.aten, name).default for name in NAMES]


class Products(TorchDispatchMode):
    """Keeps the arguments of all products and convolutions while it is on."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in PRODUCTS:
            self.calls.append((func, [each.detach() if isinstance(each, th.Tensor) else each for each in args]))
        return func(*args, **(kwargs or {}))

    def seconds(self) -> float:
        start = time.process_time()
        with th.no_grad():
            for func, args in self.calls:
                func(*args)
        return time.process_time() - start


def make_model(extractor: str, precision: str) -> DTFM:
    """A model of random images, with all else by the classes' rules."""
    rng = np.random.default_rng(0)

    def episode() -> dict[str, Any]:
        images = {camera: rng.integers(0, 256, (50, SIDE, SIDE, 3), np.uint8) for camera in CAMERAS}
        vectors = rng.normal(size=(50, 9)).astype(np.float32)
        actions = np.cumsum(rng.normal(0.0, 0.02, (50, 7)), axis=0).clip(-1, 1)
        return {"observations": {**images, "arm": vectors}, "actions": actions, "rewards": np.ones(50), "terminated": True}

    kwargs = dict(features_extractor_class=extractor, chunk_size=8, flow_steps=10, regression_coef=0.0)
    return DTFM(
        "MultiInputPolicy", dataset=[episode() for _ in range(10)], batch_size=BATCH_SIZE, precision=precision, seed=0,
        device="cpu", policy_kwargs=kwargs,
    )  # fmt: skip


def measure(extractor: str, precision: str, n_steps: int) -> tuple[float, float, float]:
    """Seconds of a gradient step, of its products, and of an action in a single environment."""
    model = make_model(extractor, precision)
    with Products() as products:
        model.learn(1, log_interval=None)
    alone, stamps = [products.seconds()], []

    def stamp(*_: Any) -> bool:
        stamps.append(time.process_time())
        alone.append(products.seconds())
        stamps.append(time.process_time())
        return True

    model.learn(n_steps, callback=stamp, log_interval=None, reset_num_timesteps=False)
    steps = [stamps[i + 1] - stamps[i] for i in range(1, len(stamps) - 1, 2)]
    seen = {camera: np.zeros((SIDE, SIDE, 3), np.uint8) for camera in CAMERAS}
    observation = {**seen, "observation": np.zeros(9), "return_to_go": np.ones(1), "timestep": np.zeros(1)}
    acting = []
    for number in range(100):
        start = time.process_time()
        model.predict({**observation, "timestep": np.array([number])})
        acting.append(time.process_time() - start)
    return statistics.median(steps), statistics.median(alone), max(acting[20:])


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument(
        "--extractors", nargs="+", choices=EXTRACTORS, default=EXTRACTORS[:2], help="ResNet18 needs torchvision"
    )
    options = parser.parse_args()
    print("| encoder | precision | products, ms | step, ms | step / products | images a second | action, ms at most |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for extractor in options.extractors:
        for precision in ("float32", "bfloat16"):
            step, alone, act = measure(extractor, precision, options.steps)
            times = f"{1e3 * alone:.0f} | {1e3 * step:.0f} | {step / alone:.2f}"
            rate = len(CAMERAS) * BATCH_SIZE / step
            print(f"| {extractor} | {precision} | {times} | {rate:,.0f} | {1e3 * act:.1f} |", flush=True)


if __name__ == "__main__":
    main()
