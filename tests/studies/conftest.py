"""Studies are scripts; those in folders are imported from here."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "studies"))
