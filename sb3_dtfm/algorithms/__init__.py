"""`DT` and `DTFM`: one offline learn loop, two policies."""

from sb3_dtfm.algorithms.dt import DT
from sb3_dtfm.algorithms.dtfm import DTFM

__all__ = ["DT", "DTFM"]
