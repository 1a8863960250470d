"""What a row needs of the radars: to be armed for its pulses, and to say how they are.

`radar_control` gives the backend that the rig file names: `RadarControl` with nothing to do, a line server a board, or
`NativeRadars`, which configures and arms AWR2243 boards over USB (`board`, `program`, `commands`, mmWaveLink in
`messages` and `spi`, the USB chip in `usb`). `constraints` checks a rig file against what the chip can do.
"""

from polysight.host.radar.backends import radar_control
from polysight.host.radar.constraints import INTER_FRAME_US, constraints, direct_if_hz, require
from polysight.host.radar.interface import BoardState, RadarControl, RadarState
from polysight.host.radar.program import TRIGGER_MARGIN_US, chirp_us

__all__ = [
    "INTER_FRAME_US",
    "TRIGGER_MARGIN_US",
    "BoardState",
    "RadarControl",
    "RadarState",
    "chirp_us",
    "constraints",
    "direct_if_hz",
    "radar_control",
    "require",
]
