"""Configure radars, arm them for the pulses of a row, and report their state.

`open_radar_control` returns the backend that the rig file selects, a `RadarControl`: `Endless` (radars that another
program started), `LineServers` (a control server for each board), or `NativeRadars`, which configures AWR2243 boards
over USB. The latter runs a `RadarBoard` for each board (`board`) with the commands of `commands`, which also checks a
rig file against the limits of the AWR2243 (`list_constraints`). Bytes go through `messages` (mmWaveLink), `link`
(retries, timeouts) and `usb` (the FT4232H chip). `diagnosis` shows the bring-up of one board step by step, logs its
traffic and replays it.
"""

from polysight.radar.board import RadarBoard
from polysight.radar.commands import (
    INTER_FRAME_US,
    TRIGGER_MARGIN_US,
    check_constraints,
    chirp_us,
    direct_if_hz,
    list_constraints,
)
from polysight.radar.control import (
    BoardState,
    RadarControl,
    RadarState,
    make_radar_board,
    open_board,
    open_radar_control,
    plan_lines,
    read_firmware,
)
from polysight.radar.diagnosis import ReplayedWords, StepResult, check_board, trace_words
from polysight.radar.firmware import Image, read_image
from polysight.radar.usb import Clock, SystemClock, WordLink
