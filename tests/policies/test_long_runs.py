"""Acting for ever takes no more memory than acting for a while."""

import gc
import mmap
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_dtfm import DT
from tests.algorithms.small import make_model

RESIDENT_PAGES = Path("/proc/self/statm")
SMALLEST = dict(embed_dim=8, n_layers=1, n_heads=1, tokens_per_step=1)
LENGTHS = np.array([[50], [70]])  # of the two rows' episodes
MOST_BLOCKS, MOST_BYTES = 300, 2**22


def memory_in_use() -> tuple[int, int]:
    """Blocks of Python's allocator, at least one for each object, and bytes of the process, which are torch's too."""
    gc.collect()
    return sys.getallocatedblocks(), int(RESIDENT_PAGES.read_text().split()[1]) * mmap.PAGESIZE


# Ways of acting: the window at every fourth call, and kept keys and values; a million calls in all.
WAYS = {"chunks": (dict(chunk_size=4, n_action_steps=4), 700_000), "kept keys": (dict(kv_cache=True), 300_000)}
RUNS = [pytest.param(way, 2_500, id=way) for way in WAYS]
RUNS += [pytest.param(way, WAYS[way][1], id=f"{way}, slow", marks=pytest.mark.slow) for way in WAYS]


@pytest.mark.skipif(not RESIDENT_PAGES.exists(), reason="Linux tells how much memory a process has.")
@pytest.mark.parametrize(("way", "n_calls"), RUNS)
def test_any_number_of_calls_takes_no_more_memory(way, n_calls, cheetah_buffer):
    """A caller who passes a state, and one who is remembered, in turns."""
    model = make_model(DT, cheetah_buffer, policy_kwargs={**SMALLEST, **WAYS[way][0]})
    numbers = {"observation": np.zeros((2, 17), np.float32), "return_to_go": np.zeros((2, 1), np.float32)}
    state = None
    for call in range(n_calls):
        if call == n_calls // 5:
            blocks, n_bytes = memory_in_use()
        observation = {**numbers, "timestep": call // 2 % LENGTHS}
        if call % 2:
            model.predict(observation, deterministic=True)
        else:
            _, state = model.predict(observation, state, observation["timestep"][:, 0] == 0, deterministic=True)
    blocks_after, n_bytes_after = memory_in_use()
    assert blocks_after < blocks + MOST_BLOCKS
    assert n_bytes_after < n_bytes + MOST_BYTES
