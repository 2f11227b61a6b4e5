"""Processor's time of a call, whatever else the machine and the tests before it do."""

import gc
import time
from collections.abc import Callable


def takes_less(seconds: float, call: Callable[[], object], attempts: int = 3) -> bool:
    """
    Whether at least one call takes less of the processor's time: neighbours on its caches, waiting threads and the
    garbage of earlier tests only add to it.

    :param call: to be timed, once if it is fast enough
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        for _ in range(attempts):
            start = time.thread_time()
            call()
            if time.thread_time() - start < seconds:
                return True
        return False
    finally:
        if collecting:
            gc.enable()
