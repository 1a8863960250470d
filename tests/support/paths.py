"""Paths of the repository and of its parts."""

import sys
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
RIG_FILE = REPO / "instrument.toml"
EXAMPLES = REPO / "examples"
BIN = Path(sys.executable).parent  # of the environment that runs the tests
POLYSIGHT = BIN / "polysight"
# Packets of a real card, where somebody has them
REAL_CAPTURES = REPO.parent / "shared/data/dca1000-real"
