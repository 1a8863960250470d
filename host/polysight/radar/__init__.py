"""Configure radars, arm them for the pulses of a row, and report their state.

`radar_control` returns the backend that the rig file selects, a `RadarControl`: `Endless` (radars that another program
started), `LineServers` (a control server for each board), or `NativeRadars`, which configures AWR2243 boards over USB.
The latter runs a `RadarBoard` for each board, with the steps of `bring_up` and the commands of `program`; mmWaveLink
messages (`messages`, `spi`) go through the FT4232H chip (`usb`). `constraints` checks a rig file against the limits of
the AWR2243. `check_board` shows the bring-up of one board step by step; `TracedWords` logs its traffic, and
`ReplayedWords` replays such a trace.
"""

from polysight.radar.backends import radar_control
from polysight.radar.board import RadarBoard
from polysight.radar.check import Row, check_board
from polysight.radar.constraints import INTER_FRAME_US, constraints, direct_if_hz, require
from polysight.radar.firmware import Image, read_image
from polysight.radar.interface import BoardState, RadarControl, RadarState
from polysight.radar.native import firmware_of, open_board, plan_lines, radar_board
from polysight.radar.program import TRIGGER_MARGIN_US, chirp_us
from polysight.radar.spi import Clock, SystemClock, WordLink
from polysight.radar.trace import ReplayedWords, TracedWords, traced

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
