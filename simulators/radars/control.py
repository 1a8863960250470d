r"""How a host reaches the simulated radars: through a board's USB chip, or by a control server that takes lines.

:class:`UsbChip` is the FT4232H between host and board: byte streams of its four channels, decoded to lines and words.
Channel A and B understand the MPSSE commands of FTDI's application note AN_108 that SPI needs, and answer an unknown
one as the chip does (0xFA and the command). C and D are bit-bang ports. What the streams do wrong is collected in
`errors`. A stand-in: USB's own timing is not shown.

:class:`RadarSocket` puts that chip at a TCP address: what `usb_serial = "tcp://address:port"` in a rig file reaches.
Requests: channel (A..D), `W` or `R`, size (u16, little-endian), and the bytes of a write. A read is answered with a u16
count and the bytes that are there.

:class:`LineServer` stands for the published rig's MATLAB servers beside mmWave Studio: TCP, takes the line
`Retrigger\n`, arms the radar, and never answers. What goes wrong with those is drawn from the `[faults]` table: a line
that changes nothing (`retrigger_fails`), a connection broken at a line (`retrigger_resets`). Specification:
docs/spec/simulated-rig.md.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable

from polysight.shared.errors import DeviceError
from polysight.simulators.faults import Faults
from polysight.simulators.radars.board import RadarBoard

_CLOCK, _OUT, _SELECT = 1 << 0, 1 << 1, 1 << 3
_BARE = (0x85, 0x87, 0x8A, 0x8C, 0x8D, 0x97)
_CHANNELS = "ABCD"
_PIN_S = 0.2e-6  # one pin command holds its pins so long (FTDI AN_114)
_CLOCKS_S = 0.2e-6  # two clocks, the least before and between chip selects (ICD 3.2.4); twice that is beyond doubt
_HEAD = struct.Struct("<ccH")
LINE = b"Retrigger"
_LINGER_NONE = struct.pack("ii", 1, 0)  # closing sends a reset


class UsbChip:
    """One chip. `channel("A")` and so on are ports with `write`, `read`, `close`."""

    def __init__(self, board: RadarBoard) -> None:
        self._board = board
        self.errors: list[str] = []
        self.words_written: list[int] = []
        self.spi_hz = 0.0
        self._fast, self._pins, self._latched = False, 0, 0
        self._high_s, self._low_s = float("inf"), 0.0  # how long chip select has been so
        self._answers = {name: bytearray() for name in _CHANNELS}
        self._pending = {name: bytearray() for name in _CHANNELS}
        self._sense = 0

    def channel(self, name: str) -> UsbChannel:
        """One of the four channels."""
        return UsbChannel(self, name)

    def take(self, name: str, data: bytes) -> None:
        """Bytes from the host for a channel. Raises DeviceError when unplugged."""
        self._check()
        if name == "D":
            pins = data[-1]
            self._sense = {0b100: 4}.get(pins >> 2 & 0b111, 0)
            self._board.sense(self._sense)
        elif name == "C":
            for pins in data:
                self._board.reset(held=not (pins >> 6 & 1 and pins >> 7 & 1))
        else:
            self._high_s = float("inf") if name == "A" and self._pins & _SELECT else self._high_s  # USB is slow
            self._pending[name] += data
            commands: dict[str, Callable[[bytearray], int]] = {"A": self._spi, "B": self._gpio}
            while self._pending[name]:
                used = commands[name](self._pending[name])
                if used == 0:
                    return  # the rest of a command comes with the next bytes
                del self._pending[name][:used]

    def give(self, name: str, size: int) -> bytes:
        """Bytes of a channel for the host. Raises DeviceError when unplugged."""
        self._check()
        found = bytes(self._answers[name][:size])
        del self._answers[name][:size]
        return found

    def _check(self) -> None:
        if not self._board.plugged:
            raise DeviceError("no such USB device", "it was unplugged", "plug it in")

    def _spi(self, data: bytearray) -> int:
        code = data[0]
        if code in _BARE:
            self._fast = self._fast or code == 0x8A
            return 1
        if code == 0x86:
            if len(data) < 3:
                return 0
            self.spi_hz = (60e6 if self._fast else 12e6) / (2 * (1 + int.from_bytes(data[1:3], "little")))
            return 3
        if code == 0x80:
            return self._set_pins(data)
        if code not in (0x11, 0x20):
            return self._unknown("A", code)
        if len(data) < 3:
            return 0
        count = 1 + int.from_bytes(data[1:3], "little")
        if code == 0x11 and len(data) < 3 + count:
            return 0
        if count != 2 or self._pins & _SELECT:
            self.errors.append(f"{count} bytes at once, chip select {'high' if self._pins & _SELECT else 'low'}")
        if self._latched:
            self.errors.append("two words under one chip select")
        elif self._low_s < 2 * _CLOCKS_S - 1e-9:
            self.errors.append(f"the clock starts {self._low_s * 1e9:.0f} ns after chip select")
        self._latched = 1
        if code == 0x20:
            self._answers["A"] += self._board.read_word().to_bytes(2, "big")
            return 3
        word = int.from_bytes(data[3:5], "big")
        self.words_written.append(word)
        self._board.write_word(word)
        return 3 + count

    def _set_pins(self, data: bytearray) -> int:
        if len(data) < 3:
            return 0
        pins, direction = data[1], data[2]
        if direction & (_CLOCK | _OUT | _SELECT) != _CLOCK | _OUT | _SELECT:
            self.errors.append(f"clock, data or chip select is not driven (direction {direction:08b})")
        if pins & _CLOCK:
            self.errors.append("the clock rests high: not SPI mode 0")
        was_high = self._pins & _SELECT
        if pins & _SELECT:
            self._latched = 0
            self._high_s = self._high_s + _PIN_S if was_high else _PIN_S
        else:
            if was_high and self._high_s < 2 * _CLOCKS_S - 1e-9:
                self.errors.append(f"chip select is high for {self._high_s * 1e9:.0f} ns between words")
            self._low_s = _PIN_S if was_high else self._low_s + _PIN_S
        self._pins = pins
        return 3

    def _gpio(self, data: bytearray) -> int:
        code = data[0]
        if code in _BARE:
            return 1
        if code == 0x80:
            if len(data) < 3:
                return 0
            if data[2] >> 5 & 1:
                self.errors.append("the host drives the interrupt line")
            return 3
        if code == 0x81:
            self._answers["B"].append(self._board.interrupt << 5)
            return 1
        return self._unknown("B", code)

    def _unknown(self, name: str, code: int) -> int:
        self.errors.append(f"unknown command 0x{code:02X} on channel {name}")
        self._answers[name] += bytes((0xFA, code))
        return 1


class UsbChannel:
    """A port of one channel."""

    def __init__(self, chip: UsbChip, name: str) -> None:
        self._chip, self._name = chip, name
        self.closed = False

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._chip.take(self._name, data)

    def read(self, size: int) -> bytes:
        """Up to so many bytes."""
        return self._chip.give(self._name, size)

    def close(self) -> None:
        """Let go of it."""
        self.closed = True


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
