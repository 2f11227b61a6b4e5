"""
Compare how well extractors locate tool and block of Push-T after the same seconds of learning, on one core:

    OMP_NUM_THREADS=1 PYTHONPATH=studies python studies/encoders.py pusht_cchi_v7_replay.zarr.zip

The features of an image are mapped to the positions by a small network that learns with the extractor. Each tenth
demonstration is held out. Seconds are of the processor, pixels those of the scene's 512. ResNet18 needs torchvision.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from pusht import read_recorded
from torch import nn

from sb3_dtfm.policies.images import EXTRACTORS

SCALE = 100.0  # pixels that count as one
FEATURES, BATCH_SIZE, LEARNING_RATE = 64, 64, 1e-3
KINDS: dict[str, dict[str, Any]] = {
    "ResidualExtractor": {},
    "ResidualExtractor, channels 64, 64, 64": {"channels": (64, 64, 64)},
    "ResidualExtractor, channels 32, 64": {"channels": (32, 64)},
    "ResidualExtractor, shift instead of crop": {"crop": 1.0, "shift": 4},
    "NatureCNN": {},
    "ResNet18": {},
}


def locate(name: str, images: np.ndarray, places: np.ndarray, held_out: np.ndarray, seconds: float, bf16: bool) -> str:
    """
    :param name: a key of `KINDS`
    :param images: (N, 3, side, side) uint8
    :param places: (N, 4), of tool and block, pixels
    :param held_out: (N,) bool
    :param seconds: of learning
    :param bf16: the extractor computes in bfloat16
    :return: a row of the table
    """
    th.manual_seed(0)
    rng, learned = np.random.default_rng(0), np.flatnonzero(~held_out)
    space = spaces.Box(0, 255, images.shape[1:], np.uint8)
    extractor = EXTRACTORS[name.partition(",")[0]](space, features_dim=FEATURES, **KINDS[name])
    head = nn.Sequential(nn.LayerNorm(FEATURES), nn.Linear(FEATURES, 128), nn.GELU(), nn.Linear(128, 4))
    optimizer = th.optim.AdamW([*extractor.parameters(), *head.parameters()], LEARNING_RATE, weight_decay=1e-3, fused=True)
    targets = th.from_numpy(((places - places.mean(axis=0)) / SCALE).astype(np.float32))

    def predict(rows: np.ndarray) -> th.Tensor:
        with th.autocast("cpu", dtype=th.bfloat16, enabled=bf16):
            features = extractor(th.from_numpy(images[rows]).float().div_(255.0))
        return head(features.float())

    n_steps, begin = 0, time.process_time()
    while (done := (time.process_time() - begin) / seconds) < 1.0:
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (0.5 + 0.5 * np.cos(np.pi * done))
        rows = rng.choice(learned, BATCH_SIZE)
        loss = (predict(rows) - targets[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        n_steps += 1
    extractor.eval()
    rest = np.flatnonzero(held_out)
    acting = _milliseconds(lambda: predict(rest[:1]))
    with th.no_grad():
        off = SCALE * th.cat([predict(rows) - targets[rows] for rows in np.array_split(rest, 20)])
    tool, block = (off[:, i : i + 2].norm(dim=1).median().item() for i in (0, 2))
    return f"| {name} | {n_steps * BATCH_SIZE / seconds:,.0f} | {acting:.1f} | {tool:.1f} | {block:.1f} |"


@th.no_grad()
def _milliseconds(call: Callable[[], Any]) -> float:
    times = []
    for _ in range(30):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return 1e3 * float(np.median(times))


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="the published demonstrations with images")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="NAME", help="all by default")
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--float32", action="store_true", help="instead of bfloat16")
    options = parser.parse_args()
    th.set_num_threads(1)
    recorded = read_recorded(options.source)
    images, ends = np.ascontiguousarray(recorded["img"].transpose(0, 3, 1, 2)), recorded["episode_ends"]
    held_out = np.searchsorted(ends, np.arange(len(images)), side="right") % 10 == 0
    print("| extractor | images a second | ms an image, acting | error of the tool | of the block |")
    print("| --- | --- | --- | --- | --- |")
    for name in options.kinds:
        where = recorded["state"][:, :4]
        print(locate(name, images, where, held_out, options.seconds, not options.float32), flush=True)


if __name__ == "__main__":
    main()
