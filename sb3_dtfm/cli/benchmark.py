"""`sb3-dtfm benchmark`."""

from sb3_dtfm.benchmark.runner import main

__all__ = ["main"]
