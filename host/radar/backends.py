"""The simple radar backends, and `radar_control`, which makes the backend that a rig file names.

`LineServers` re-arms radars for each row over TCP: one server a board takes the line `Retrigger` and never answers.
That is how the published rig does it: a MATLAB server beside mmWave Studio configures a radar for the frames of one
row, and starts it again at each line. What can be known here is that the server's machine took the line (its kernel
acknowledged it). Whether the server read it, and the radar obeyed, shows by the data of the row.

`Endless` is for radars that were started once and need nothing for a row. `native.py` holds the third backend.
"""

from __future__ import annotations

import fcntl
import select
import socket
import struct
import termios
import time
from collections.abc import Mapping

from polysight.host.radar.interface import BoardState, RadarControl, RadarState
from polysight.host.radar.native import NativeRadars
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError

LINE = b"Retrigger\n"
_LOOK_MS = 5
_START = (
    "start the control server of this board (beside mmWave Studio), or correct radar.servers in instrument.toml"
    " (a scan that was begun: `polysight resume SCAN --config instrument.toml`)"
)


class LineServers(RadarControl):
    """One connection a board, kept open from row to row, and made anew when its server has closed it.

    Parameters
    ----------
    servers
        `address:port` of each board's server, by board name.
    timeout_s
        For connecting, and for the line to be acknowledged.

    Raises
    ------
    DeviceError
        when a server cannot be reached.
    """

    def __init__(self, servers: Mapping[str, str], timeout_s: float) -> None:
        self._servers = dict(servers)
        self._timeout_s = timeout_s
        self._sockets: dict[str, socket.socket] = {}
        self._reset: set[str] = set()  # boards whose server broke the connection since the last line
        try:
            for board in self._servers:
                self._connect(board)
        except DeviceError:
            self.close()
            raise

    def arm(self, frames: int) -> None:
        """Send every board's server the line, and wait until its machine has it.

        `frames` is for the server's own configuration to know. A connection that its server resets meanwhile shows in
        :meth:`states`. Raises DeviceError.
        """
        del frames
        self._reset.clear()
        for board in self._servers:
            if self._is_closed(board):
                self._connect(board)
            self._reset.discard(board)
            try:
                self._sockets[board].sendall(LINE)
            except BlockingIOError:
                raise DeviceError(
                    f"{board}: its control server at {self._servers[board]} does not read its lines",
                    "the program there hangs: what was sent to it for many rows fills its connection",
                    "start it again, then `polysight resume SCAN`",
                ) from None
            except ConnectionError:
                self._reset.add(board)
        deadline = time.monotonic() + self._timeout_s
        for board in self._servers:
            self._wait_taken(board, deadline)

    def states(self) -> dict[str, BoardState]:
        """`FAULT` of boards whose server has reset the connection; else unknown, with where they were asked."""
        found = {}
        for board, address in self._servers.items():
            self._is_closed(board)
            found[board] = (
                BoardState(RadarState.FAULT, f"its control server at {address} reset the connection")
                if board in self._reset
                else BoardState(RadarState.UNKNOWN, f"asked to re-arm at {address}, which never answers")
            )
        return found

    def close(self) -> None:
        """Close the connections."""
        for connection in self._sockets.values():
            connection.close()
        self._sockets.clear()

    def _connect(self, board: str) -> None:
        old = self._sockets.pop(board, None)
        if old is not None:
            old.close()
        address, _, port = self._servers[board].rpartition(":")
        try:
            connection = socket.create_connection((address, int(port)), self._timeout_s)
        except OSError as e:
            raise self._unreachable(board, e) from None
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setblocking(False)
        self._sockets[board] = connection

    def _is_closed(self, board: str) -> bool:
        """Whether the server has ended the connection, in order or by a reset; what it may have sent is dropped."""
        try:
            while self._sockets[board].recv(4096):
                pass
        except BlockingIOError:
            return False
        except OSError:
            self._reset.add(board)
        return True

    def _wait_taken(self, board: str, deadline: float) -> None:
        """Until the other machine has acknowledged the line, or the connection is gone."""
        connection = self._sockets[board]
        ended = select.poll()
        ended.register(connection, 0)  # a reset, or the end of both directions
        while _unacknowledged(connection):
            if ended.poll(_LOOK_MS):
                return
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"{board}: its control server at {self._servers[board]} has not taken the line within"
                    f" {self._timeout_s:g} s",
                    "the connection is half-open: that machine was switched off, or the network is cut",
                    "check that machine and the cable, then `polysight resume SCAN`",
                )

    def _unreachable(self, board: str, e: OSError) -> DeviceError:
        what = f"{board}: cannot reach its control server at {self._servers[board]}"
        if isinstance(e, ConnectionRefusedError):
            return DeviceError(f"{what}: connection refused", "that machine is there, but no server listens", _START)
        if isinstance(e, TimeoutError):
            return DeviceError(
                f"{what} within {self._timeout_s:g} s",
                "that machine is off, or a firewall drops the connection",
                _START,
            )
        return DeviceError(f"{what}: {e.strerror or e}", "the address is wrong, or there is no route to it", _START)


def _unacknowledged(connection: socket.socket) -> int:
    """Bytes sent that the other side's kernel has not acknowledged (SIOCOUTQ, tcp(7))."""
    return struct.unpack("=i", fcntl.ioctl(connection, termios.TIOCOUTQ, b"\0\0\0\0"))[0]


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
