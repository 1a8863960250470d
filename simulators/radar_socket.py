"""A simulated radar's USB chip at a TCP address: what `usb_serial = "tcp://address:port"` in a rig file reaches.

Requests: channel (A..D), `W` or `R`, size (u16, little-endian), and the bytes of a write. A read is answered with a u16
count and the bytes that are there.
"""

from __future__ import annotations

import select
import socket
import struct

from polysight.shared.errors import DeviceError
from polysight.simulators.radar_board import RadarBoard
from polysight.simulators.radar_usb import UsbChip

_HEAD = struct.Struct("<ccH")


class RadarSocket:
    """One chip, for one client at a time.

    Raises
    ------
    DeviceError
        when the address cannot be taken.
    """

    def __init__(self, address: str, board: RadarBoard) -> None:
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        try:
            self._listener = socket.create_server((host, int(port)))
        except OSError as e:
            raise DeviceError(
                f"simulated radar: cannot take {address}: {e.strerror}", "another program listens there"
            ) from None
        self._listener.setblocking(False)
        self.address = f"tcp://{host}:{self._listener.getsockname()[1]}"
        self.chip = UsbChip(board)
        self._client: socket.socket | None = None
        self._unread = b""
        self._ready = select.epoll()
        self._ready.register(self._listener, select.EPOLLIN)

    def fileno(self) -> int:
        """One descriptor for the listener and its client."""
        return self._ready.fileno()

    def serve(self) -> None:
        """Do what was asked for."""
        for descriptor, _ in self._ready.poll(0):
            if descriptor == self._listener.fileno():
                self._drop()  # a new one takes the chip over
                self._client = self._listener.accept()[0]
                self._ready.register(self._client, select.EPOLLIN)
            elif self._client is not None:
                self._read(self._client)

    def _read(self, client: socket.socket) -> None:
        try:
            data = client.recv(65536)
            if data:
                self._unread = self._obey(client, self._unread + data)
                return
        except (OSError, DeviceError):
            pass  # gone, or unplugged: both close the connection
        self._drop()

    def _obey(self, client: socket.socket, data: bytes) -> bytes:
        while len(data) >= _HEAD.size:
            channel, what, size = _HEAD.unpack_from(data)
            port = channel.decode("ascii")
            if what == b"R":
                found = self.chip.give(port, size)
                client.sendall(struct.pack("<H", len(found)) + found)
                data = data[_HEAD.size :]
                continue
            if len(data) < _HEAD.size + size:
                break
            self.chip.take(port, data[_HEAD.size : _HEAD.size + size])
            data = data[_HEAD.size + size :]
        return data

    def _drop(self) -> None:
        if self._client is not None:
            self._ready.unregister(self._client)
            self._client.close()
            self._client, self._unread = None, b""

    def close(self) -> None:
        """Close all sockets."""
        self._drop()
        self._listener.close()
        self._ready.close()
