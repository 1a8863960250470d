"""The four channels of an FT4232H over TCP: a chip on another machine's USB, or a simulated one.

Requests: channel (A..D), `W` or `R`, size (u16, little-endian), and the bytes of a write. A read is answered with a u16
count and the bytes that are there.
"""

from __future__ import annotations

import socket
import struct

from polysight.host.radar.mpsse import UsbWords
from polysight.shared.errors import DeviceError

SCHEME = "tcp://"
_HEAD = struct.Struct("<ccH")
_TIMEOUT_S = 30.0


class _TcpPort:
    """One channel on a connection that all four share."""

    def __init__(self, address: str, connection: socket.socket, channel: bytes) -> None:
        self._address, self._connection, self._channel = address, connection, channel

    def write(self, data: bytes) -> None:
        """Send bytes. Raises DeviceError."""
        self._send(_HEAD.pack(self._channel, b"W", len(data)) + data)

    def read(self, size: int) -> bytes:
        """Up to so many bytes. Raises DeviceError."""
        self._send(_HEAD.pack(self._channel, b"R", size))
        (count,) = struct.unpack("<H", self._receive(2))
        return self._receive(count)

    def close(self) -> None:
        """Close the connection, of all channels."""
        self._connection.close()

    def _send(self, data: bytes) -> None:
        try:
            self._connection.sendall(data)
        except OSError as e:
            raise self._gone(e.strerror or str(e)) from None

    def _receive(self, size: int) -> bytes:
        data = b""
        try:
            while len(data) < size:
                part = self._connection.recv(size - len(data))
                if not part:
                    raise self._gone("closed by the other side")
                data += part
        except OSError as e:
            raise self._gone(e.strerror or str(e)) from None
        return data

    def _gone(self, what: str) -> DeviceError:
        return DeviceError(
            f"radar at {self._address}: {what}", "its USB cable was pulled, or its program ended", "check that machine"
        )


def open_tcp(address: str) -> UsbWords:
    """A board by `tcp://address:port`. Raises DeviceError when nobody is there."""
    host, _, port = address.removeprefix(SCHEME).rpartition(":")
    try:
        connection = socket.create_connection((host, int(port)), _TIMEOUT_S)
    except (OSError, ValueError) as e:
        raise DeviceError(
            f"radar at {address}: cannot be reached: {e}", "nobody serves a USB chip there", "start it, or correct it"
        ) from None
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    spi, interrupt, reset, sense = (_TcpPort(address, connection, c) for c in (b"A", b"B", b"C", b"D"))
    return UsbWords(spi, interrupt, reset, sense)
