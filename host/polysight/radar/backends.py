"""The backends `Endless` and `LineServers`, and `radar_control`, which creates the backend of a rig file.

`LineServers` re-arms the radars for each row over TCP: a server for each board receives the line `Retrigger` and never
replies. The published rig works so: a MATLAB server beside mmWave Studio configures a radar for the frames of one row,
and restarts it at each line. The kernel of the server's machine acknowledges the line; only the data of the row shows
that the server read it and that the radar started.
"""

from __future__ import annotations

import fcntl
import select
import socket
import struct
import termios
import time
from collections.abc import Mapping

from polysight.radar.interface import BoardState, RadarControl, RadarState
from polysight.radar.native import NativeRadars
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError

LINE = b"Retrigger\n"
_POLL_MS = 5
_START_SERVER = (
    "start the control server of this board (beside mmWave Studio), or correct radar.servers in instrument.toml"
    " (then continue the scan: `polysight resume SCAN --config instrument.toml`)"
)


class LineServers(RadarControl):
    """A connection to each board's control server, kept open between rows, and reopened if its server closed it.

    `servers` has the `address:port` of each board's server; `timeout_s` limits connecting, and the acknowledgement of a
    line. Raises DeviceError if a server cannot be reached.
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
        """Send the line to every server and wait for the acknowledgement of its machine. Raises DeviceError.

        The number of frames is set in the server's own configuration. `states` reports connections that were reset.
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
                    "the program there hangs: the lines of many rows fill its connection",
                    "restart it, then `polysight resume SCAN`",
                    code=ErrorCode.NO_ANSWER,
                ) from None
            except ConnectionError:
                self._reset.add(board)
        deadline = time.monotonic() + self._timeout_s
        for board in self._servers:
            self._wait_taken(board, deadline)

    def states(self) -> dict[str, BoardState]:
        """Return `FAULT` for boards whose server reset the connection, otherwise `UNKNOWN` with its address."""
        found = {}
        for board, address in self._servers.items():
            self._is_closed(board)
            found[board] = (
                BoardState(RadarState.FAULT, f"its control server at {address} reset the connection")
                if board in self._reset
                else BoardState(RadarState.UNKNOWN, f"re-armed through {address}, which never replies")
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
        """Return True if the server closed or reset the connection; data that it sent is discarded."""
        try:
            while self._sockets[board].recv(4096):
                pass
        except BlockingIOError:
            return False
        except OSError:
            self._reset.add(board)
        return True

    def _wait_taken(self, board: str, deadline: float) -> None:
        """Wait until the other machine acknowledged the line, or the connection ended."""
        connection = self._sockets[board]
        ended = select.poll()
        ended.register(connection, 0)  # a reset, or the end of both directions
        while _unacknowledged(connection):
            if ended.poll(_POLL_MS):
                return
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"{board}: its control server at {self._servers[board]} did not acknowledge the line within"
                    f" {self._timeout_s:g} s",
                    "the connection is half-open: that machine was switched off, or the network is cut",
                    "check that machine and the cable, then `polysight resume SCAN`",
                    code=ErrorCode.NO_ANSWER,
                )

    def _unreachable(self, board: str, e: OSError) -> DeviceError:
        what = f"{board}: cannot reach its control server at {self._servers[board]}"
        if isinstance(e, ConnectionRefusedError):
            return DeviceError(
                f"{what}: connection refused",
                "that machine is running, but no server listens",
                _START_SERVER,
                code=ErrorCode.NO_ANSWER,
            )
        if isinstance(e, TimeoutError):
            return DeviceError(
                f"{what} within {self._timeout_s:g} s",
                "that machine is off, or a firewall drops the connection",
                _START_SERVER,
                code=ErrorCode.NO_ANSWER,
            )
        return DeviceError(
            f"{what}: {e.strerror or e}",
            "the address is wrong, or there is no route to it",
            _START_SERVER,
            code=ErrorCode.NO_ANSWER,
        )


def _unacknowledged(connection: socket.socket) -> int:
    """Return the sent bytes that the other kernel has not acknowledged (SIOCOUTQ, tcp(7))."""
    return struct.unpack("=i", fcntl.ioctl(connection, termios.TIOCOUTQ, b"\0\0\0\0"))[0]


class Endless(RadarControl):
    """Radars that another program started with an infinite number of frames; nothing is done for a row."""

    def arm(self, frames: int) -> None:
        """Do nothing."""

    def states(self) -> dict[str, BoardState]:
        """Return no states; they are not known."""
        return {}


def radar_control(instrument: Instrument) -> RadarControl:
    """Connect to the radars of a rig with the backend of its file. Raises ConfigError, DeviceError."""
    if instrument.radar.control == "line_server":
        return LineServers(instrument.radar.servers, instrument.limits.command_timeout_s)
    if instrument.radar.control == "native":
        return NativeRadars(instrument)
    return Endless()
