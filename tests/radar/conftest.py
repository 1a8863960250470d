"""Boards under native control, in virtual time."""

import pytest
from tests.support.radar.boards import BoardWords, VirtualClock, make_native_rig

from polysight_shared.config import Instrument
from polysight_simulators.radars import RadarBoard, make_image


@pytest.fixture
def rig() -> Instrument:
    return make_native_rig()


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def board(clock: VirtualClock) -> RadarBoard:
    """A board with firmware in its flash."""
    return RadarBoard(lambda: clock.time, flash=make_image())


@pytest.fixture
def words(board: RadarBoard, clock: VirtualClock) -> BoardWords:
    return BoardWords(board, clock)
