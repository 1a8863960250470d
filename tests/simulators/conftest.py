"""Sockets that are closed after the test, and a rig on addresses of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from polysight.shared.config import Instrument, load_instrument
from polysight.simulators.loopback import on_free_subnet

ROOT = Path(__file__).parents[2]


@pytest.fixture
def sockets() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def rig() -> Instrument:
    return on_free_subnet(load_instrument(ROOT / "instrument.toml"))
