r"""A simulated radar's control server: TCP, takes the line `Retrigger\n`, arms the radar, and never answers.

It stands for the published rig's MATLAB servers beside mmWave Studio. What goes wrong with those is drawn from the
`[faults]` table: a line that changes nothing (`retrigger_fails`), a connection broken at a line (`retrigger_resets`).
Specification: docs/spec/simulated-rig.md.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable

from polysight.shared.errors import DeviceError
from polysight.simulators.card_faults import Faults

LINE = b"Retrigger"
_LINGER_NONE = struct.pack("ii", 1, 0)  # closing sends a reset


class LineServer:
    """One board's control server.

    Parameters
    ----------
    address
        `address:port` to listen at.
    rearm
        Called for each line that arms the radar.

    Raises
    ------
    DeviceError
        when the address cannot be taken.
    """

    def __init__(self, address: str, rearm: Callable[[], None], faults: Faults) -> None:
        host, _, port = address.rpartition(":")
        try:
            self._listener = socket.create_server((host, int(port)))
        except OSError as e:
            raise DeviceError(
                f"simulated control server: cannot take {address}: {e.strerror}", "another program listens there"
            ) from None
        self._listener.setblocking(False)
        self._rearm, self._faults = rearm, faults
        self._clients: dict[int, tuple[socket.socket, bytes]] = {}
        self._ready = select.epoll()
        self._ready.register(self._listener, select.EPOLLIN)
        self.lines = 0
        self.unknown_lines = 0

    def fileno(self) -> int:
        """One descriptor for the listener and all its clients."""
        return self._ready.fileno()

    def serve(self) -> None:
        """Take what has come."""
        for descriptor, _ in self._ready.poll(0):
            if descriptor == self._listener.fileno():
                client, _ = self._listener.accept()
                client.setblocking(False)
                self._clients[client.fileno()] = client, b""
                self._ready.register(client, select.EPOLLIN)
            else:
                self._read(descriptor)

    def _read(self, descriptor: int) -> None:
        client, rest = self._clients[descriptor]
        try:
            data = client.recv(4096)
        except OSError:
            data = b""
        *lines, rest = (rest + data).split(b"\n")
        self._clients[descriptor] = client, rest
        alive = bool(data)
        for line in lines:
            alive &= self._take(client, line)
        if not alive:
            self._drop(descriptor)

    def _take(self, client: socket.socket, line: bytes) -> bool:
        """Obey one line; whether the connection lives on."""
        if line.strip() != LINE:
            self.unknown_lines += 1
            return True
        number, self.lines = self.lines, self.lines + 1
        if number in self._faults.retrigger_resets:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NONE)
            return False
        if number not in self._faults.retrigger_fails:
            self._rearm()
        return True

    def _drop(self, descriptor: int) -> None:
        self._ready.unregister(descriptor)
        self._clients.pop(descriptor)[0].close()

    def close(self) -> None:
        """Close all sockets."""
        for descriptor in list(self._clients):
            self._drop(descriptor)
        self._listener.close()
        self._ready.close()
