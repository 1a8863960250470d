"""The published rig, and the stage of the simulators in virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest

from polysight.shared.config import Instrument, load_instrument

REPO = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def rig() -> Instrument:
    return load_instrument(REPO / "instrument.toml")
