"""Studies are scripts; those in folders are imported from here."""

import sys
from pathlib import Path

STUDIES = Path(__file__).parents[2] / "studies"
sys.path += [str(STUDIES), str(STUDIES / "ogbench")]
