"""Simulated wires: GPIO edges with timestamps between processes, over a local socket.

A hub (`polysight_simulators.wires`) relays between its clients: the stage raises the trigger, the Pi sends SYNC_IN
pulses, the radars listen. The protocol has ASCII lines:

    `S <t_ns> <line> <0|1>`                 a line changed at wire time t_ns
    `M <t_ns> <x_um> <y_um> <vx_um_s>`      the stage is at (x, y) and moves at vx from now on (stage coordinates)
    `L <line> [<line> ...]`                 client to hub: subscribe to changes of these lines
    `W`                                     client to hub: subscribe to M lines
    `J <line> <other>`                      client to hub: join two lines: changes of the first are the other's, too
    `X <line> <1|0>`                        client to hub: cut a line, or repair it (tests only)
    `K`                                     hub to client: confirms L, W, J or X

Wire time is the simulated stage's clock, which may be faster than the wall clock. Reactions to an edge are scheduled
relative to the edge's time, so that the intervals of a simulated scan are exact on a busy machine.
"""

from __future__ import annotations

import socket
import time
from pathlib import Path
from typing import NamedTuple

from polysight_shared.errors import DeviceError, ErrorCode, ProtocolError


class WireEdge(NamedTuple):
    """A line changed."""

    # Wire time.
    t_ns: int
    # Number of the GPIO line of the simulated Pi.
    line: int
    # The new level: 0 or 1.
    value: int


class WireMotion(NamedTuple):
    """Position (um, stage coordinates) and signed x speed (um/s) of the stage from the wire time `t_ns` on."""

    t_ns: int
    x_um: int
    y_um: int
    vx_um_s: int


WireMessage = WireEdge | WireMotion
_RIG_ENDED = "the simulated rig ended", "start it again"


def encode(message: WireMessage) -> bytes:
    """Encode a message as a line of the wire protocol."""
    tag = "S" if isinstance(message, WireEdge) else "M"
    return (" ".join([tag, *map(str, message)]) + "\n").encode("ascii")


def parse(line: str) -> WireMessage:
    """Parse an S or M line. Raises ProtocolError."""
    tag, *fields = line.split() or [""]
    try:
        values = [int(field) for field in fields]
        if tag == "S" and len(values) == 3 and values[2] in (0, 1):
            return WireEdge(*values)
        if tag == "M" and len(values) == 4:
            return WireMotion(*values)
    except ValueError:
        pass
    raise ProtocolError(f"not a wire line: {line!r}")


class WireClient:
    """Client of the hub at the Unix socket `path`, subscribed to the lines `listen` and, with `motion`, to M lines.

    `join` joins two lines: changes of the first are the second's, too. Raises DeviceError if there is no hub within
    `timeout_s`, ProtocolError if it does not confirm.
    """

    def __init__(
        self,
        path: Path,
        listen: tuple[int, ...] = (),
        motion: bool = False,
        timeout_s: float = 10.0,
        join: tuple[int, int] | None = None,
    ) -> None:
        self._path = path
        deadline = time.monotonic() + timeout_s
        while True:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                self._socket.connect(str(path))
                break
            except OSError as e:
                self._socket.close()
                if time.monotonic() > deadline:
                    raise DeviceError(
                        f"simulated wires: no connection to {path}: {e}",
                        "the simulated rig is not running",
                        "start it first",
                        code=ErrorCode.NO_ANSWER,
                    ) from None
                time.sleep(0.02)
        # The beginning of a line whose end has not come yet.
        self._buffer = b""
        # Lines that were received and not returned yet, the oldest last.
        self._pending: list[str] = []
        subscriptions = b""
        if listen:
            subscriptions += ("L " + " ".join(map(str, listen)) + "\n").encode("ascii")
        if motion:
            subscriptions += b"W\n"
        if join is not None:
            subscriptions += f"J {join[0]} {join[1]}\n".encode("ascii")
        if subscriptions:
            self._socket.sendall(subscriptions)
            deadline = time.monotonic() + timeout_s
            for _ in range(subscriptions.count(b"\n")):
                if self._read_line(max(0.0, deadline - time.monotonic())) != "K":
                    raise ProtocolError(f"simulated wires at {path}: no confirmation", code=ErrorCode.NO_ANSWER)

    def fileno(self) -> int:
        """Return the file descriptor, for select and poll; `receive` may have buffered messages besides."""
        return self._socket.fileno()

    def send(self, *messages: WireMessage) -> None:
        """Send messages in one write. Raises DeviceError if the hub is disconnected."""
        try:
            self._socket.sendall(b"".join(map(encode, messages)))
        except OSError as e:
            raise DeviceError(f"simulated wires at {self._path} broke: {e}", *_RIG_ENDED) from None

    def receive(self, timeout_s: float | None) -> WireMessage | None:
        """Return the next message, or None after `timeout_s`. Raises DeviceError if the hub is disconnected."""
        line = self._read_line(timeout_s)
        return None if line is None else parse(line)

    def _read_line(self, timeout_s: float | None) -> str | None:
        """Return the next line, or None after `timeout_s` (None: wait for ever). Raises DeviceError without a hub."""
        while not self._pending:
            # A timeout of 0 would make the socket non-blocking.
            if timeout_s is not None:
                timeout_s = max(timeout_s, 1e-6)
            self._socket.settimeout(timeout_s)
            try:
                data = self._socket.recv(1 << 16)
            except (TimeoutError, BlockingIOError):
                return None
            except OSError as e:
                raise DeviceError(f"simulated wires at {self._path} broke: {e}", *_RIG_ENDED) from None
            finally:
                if self._socket.fileno() >= 0:
                    self._socket.settimeout(None)
            if not data:
                raise DeviceError(f"simulated wires at {self._path} were closed", *_RIG_ENDED)
            lines = (self._buffer + data).split(b"\n")
            self._buffer = lines.pop()
            self._pending = [line.decode("ascii", "replace") for line in reversed(lines)]
        return self._pending.pop()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
