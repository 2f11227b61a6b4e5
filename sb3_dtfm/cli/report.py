"""`sb3-dtfm report`."""

from sb3_dtfm.benchmark.report import main

__all__ = ["main"]
