"""What a row needs of the radars: to be armed for its pulses, and to say how they are.

`radar_control` gives the backend that the rig file names: `RadarControl` with nothing to do, a line server a board, or
`NativeRadars`, which configures and arms AWR2243 boards over USB (`board`, `bring_up`, `program`, `commands`,
mmWaveLink in `messages` and `spi`, the USB chip in `usb`, `firmware`). `constraints` checks a rig file against what the
chip can do. For a board's first days: `check_board`, and `TracedWords` with `ReplayedWords`.
"""

from polysight.host.radar.backends import radar_control
from polysight.host.radar.board import RadarBoard
from polysight.host.radar.check import Row, check_board
from polysight.host.radar.constraints import INTER_FRAME_US, constraints, direct_if_hz, require
from polysight.host.radar.firmware import Image, read_image
from polysight.host.radar.interface import BoardState, RadarControl, RadarState
from polysight.host.radar.native import firmware_of, open_board, plan_lines, radar_board
from polysight.host.radar.program import TRIGGER_MARGIN_US, chirp_us
from polysight.host.radar.spi import Clock, SystemClock, WordLink
from polysight.host.radar.trace import ReplayedWords, TracedWords, traced

__all__ = [
    "INTER_FRAME_US",
    "TRIGGER_MARGIN_US",
    "BoardState",
    "Clock",
    "Image",
    "RadarBoard",
    "RadarControl",
    "RadarState",
    "ReplayedWords",
    "Row",
    "SystemClock",
    "TracedWords",
    "WordLink",
    "check_board",
    "chirp_us",
    "constraints",
    "direct_if_hz",
    "firmware_of",
    "open_board",
    "plan_lines",
    "radar_board",
    "radar_control",
    "read_image",
    "require",
    "traced",
]
