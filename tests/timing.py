"""Processor's time of a call, whatever else the machine and the tests before it do."""

import gc
import time
from collections.abc import Callable


def takes_less(seconds: float, call: Callable[[], object]) -> bool:
    """
    Whether one of three calls takes less of the process's time: neighbours on the processor's caches only add to it.

    :param call: to be timed, once if it is fast enough; what tests before it have left is no garbage of its own
    """
    gc.freeze()
    try:
        for _ in range(3):
            start = time.process_time()
            call()
            if time.process_time() - start < seconds:
                return True
        return False
    finally:
        gc.unfreeze()
