"""Sockets that are closed after the test, and a rig on its own addresses."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from tests.support.rigs import load_published_rig

from polysight_shared.config import Instrument
from polysight_simulators.loopback import move_to_free_subnet


@pytest.fixture
def sockets() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def rig() -> Instrument:
    return move_to_free_subnet(load_published_rig())
