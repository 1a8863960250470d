"""The backend that the rig file names."""

from __future__ import annotations

from polysight.host.radar.interface import BoardState, RadarControl
from polysight.host.radar.line_server import LineServers
from polysight.host.radar.native import NativeRadars
from polysight.shared.config import Instrument


class Endless(RadarControl):
    """Radars that were started once, with frames without end: nothing has to be done for a row."""

    def arm(self, frames: int) -> None:
        """Nothing to do."""

    def states(self) -> dict[str, BoardState]:
        """Nobody tells."""
        return {}


def radar_control(instrument: Instrument) -> RadarControl:
    """Reach the radars of a rig as its file says. Raises ConfigError, DeviceError."""
    if instrument.radar.control == "line_server":
        return LineServers(instrument.radar.servers, instrument.limits.command_timeout_s)
    if instrument.radar.control == "native":
        return NativeRadars(instrument)
    return Endless()
