"""Paths of the repository and of its parts."""

import sys
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
RIG_FILE = REPO / "instrument.toml"
EXAMPLES = REPO / "examples"
# Commands of the environment that runs the tests.
BIN = Path(sys.executable).parent
POLYSIGHT = BIN / "polysight"
# Packets of a real card, which are not part of the repository and need not exist.
REAL_CAPTURES = REPO.parent / "shared/data/dca1000-real"
