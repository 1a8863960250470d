r"""Control connections of the simulated radars: a board's USB chip, the same over TCP, or a control server.

`UsbChip` is the FT4232H between host and board: it decodes the byte streams of its four channels to lines and words.
Channels A and B have the MPSSE commands of FTDI's application note AN_108 that SPI needs, and answer an unknown one
with 0xFA and the command, as the chip does; C and D are bit-bang ports. `errors` collects protocol errors of the host.
The timing of USB is not simulated.

`RadarSocket` connects the chip to a TCP address, `usb_serial = "tcp://address:port"` in a rig file. Requests: channel
(A..D), `W` or `R`, size (u16, little-endian), and the bytes of a write. The answer to a read is a u16 count and the
available bytes.

`LineServer` simulates the published rig's MATLAB servers, which run next to mmWave Studio: over TCP it receives the
line `Retrigger\n`, arms the radar, and never replies. Faults of the `[faults]` table: a line without effect
(`retrigger_fails`), a connection reset at a line (`retrigger_resets`). Specification: docs/spec/simulated-rig.md.
"""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Callable

from polysight_shared.errors import DeviceError, ErrorCode
from polysight_simulators.faults import Faults
from polysight_simulators.radars.board import RadarBoard

# Pins of channel A: clock, data to the board, chip select.
_CLOCK_PIN = 1 << 0
_OUT_PIN = 1 << 1
_SELECT_PIN = 1 << 3
# MPSSE commands (FTDI AN_108): set and read the pins, set the clock divisor, write and read bytes, and commands without
# arguments, of which one selects the clock of 60 MHz.
_SET_PINS = 0x80
_READ_PINS = 0x81
_SET_DIVISOR = 0x86
_WRITE_BYTES = 0x11
_READ_BYTES = 0x20
_FAST_CLOCK = 0x8A
_COMMANDS_WITHOUT_DATA = (0x85, 0x87, _FAST_CLOCK, 0x8C, 0x8D, 0x97)
# Bit of the host interrupt in the pins of channel B.
_INTERRUPT_BIT = 5
_CHANNELS = "ABCD"
# Duration of a pin command (FTDI AN_114).
_PIN_S = 0.2e-6
# Two clocks at 10 MHz, the minimum before and between chip selects (TI's interface control document, 3.2.4). The
# simulation requires twice that, a margin that is chosen.
_CLOCKS_S = 0.2e-6
# Channel, operation and size of a request.
_HEAD = struct.Struct("<ccH")
RETRIGGER_LINE = b"Retrigger"
# With this option, closing a connection sends a reset.
_NO_LINGER = struct.pack("ii", 1, 0)


class UsbChip:
    """The USB chip of a board; `channel("A")` to `channel("D")` return its ports."""

    def __init__(self, board: RadarBoard) -> None:
        self._board = board
        self.errors: list[str] = []
        self.words_written: list[int] = []
        self.spi_hz = 0.0
        self._fast = False
        self._pins = 0
        # 1 if a word was sent since chip select became low, else 0.
        self._latched = 0
        # Time for which chip select is high or low, by the duration of the pin commands.
        self._high_s = float("inf")
        self._low_s = 0.0
        self._answers = {name: bytearray() for name in _CHANNELS}
        self._pending = {name: bytearray() for name in _CHANNELS}
        self._sense = 0

    def channel(self, name: str) -> UsbChannel:
        """Return one of the four channels."""
        return UsbChannel(self, name)

    def receive_from_host(self, name: str, data: bytes) -> None:
        """Receive bytes from the host for a channel. Raises DeviceError if unplugged."""
        self._check()
        if name == "D":
            # Pins 2 to 4 are the sense-on-power pins: 0b100 is the functional mode, 4.
            sense_pins = data[-1] >> 2 & 0b111
            self._sense = 4 if sense_pins == 0b100 else 0
            self._board.set_sense_lines(self._sense)
        elif name == "C":
            # The board runs while pins 6 and 7, its reset lines, are both high.
            for pins in data:
                self._board.reset(held=pins >> 6 & 0b11 != 0b11)
        else:
            # USB delays each request: a chip select that is high between two of them has been so for long enough.
            if name == "A" and self._pins & _SELECT_PIN:
                self._high_s = float("inf")
            self._pending[name] += data
            commands: dict[str, Callable[[bytearray], int]] = {"A": self._transfer_spi, "B": self._set_gpio}
            while self._pending[name]:
                used_bytes = commands[name](self._pending[name])
                if used_bytes == 0:
                    # The command is incomplete: wait for the rest.
                    return
                del self._pending[name][:used_bytes]

    def send_to_host(self, name: str, size: int) -> bytes:
        """Return up to `size` bytes of a channel for the host. Raises DeviceError if unplugged."""
        self._check()
        answer = bytes(self._answers[name][:size])
        del self._answers[name][:size]
        return answer

    def _check(self) -> None:
        if not self._board.plugged:
            raise DeviceError("no such USB device", "it was unplugged", "plug it in", code=ErrorCode.NO_ANSWER)

    def _transfer_spi(self, data: bytearray) -> int:
        """Execute the first command of channel A; return its length in bytes, or 0 if it is incomplete."""
        code = data[0]
        if code in _COMMANDS_WITHOUT_DATA:
            self._fast = self._fast or code == _FAST_CLOCK
            return 1
        if code == _SET_DIVISOR:
            if len(data) < 3:
                return 0
            # Two periods of the chip's clock make one of SPI; the divisor is sent less one (AN_108).
            self.spi_hz = (60e6 if self._fast else 12e6) / (2 * (1 + int.from_bytes(data[1:3], "little")))
            return 3
        if code == _SET_PINS:
            return self._set_pins(data)
        if code not in (_WRITE_BYTES, _READ_BYTES):
            return self._refuse_code("A", code)
        if len(data) < 3:
            return 0
        # The number of bytes is sent less one.
        count = 1 + int.from_bytes(data[1:3], "little")
        if code == _WRITE_BYTES and len(data) < 3 + count:
            return 0
        if count != 2 or self._pins & _SELECT_PIN:
            self.errors.append(f"{count} bytes together, chip select {'high' if self._pins & _SELECT_PIN else 'low'}")
        if self._latched:
            self.errors.append("two words under one chip select")
        elif self._low_s < 2 * _CLOCKS_S - 1e-9:
            self.errors.append(f"the clock starts {self._low_s * 1e9:.0f} ns after chip select")
        self._latched = 1
        if code == _READ_BYTES:
            self._answers["A"] += self._board.read_word().to_bytes(2, "big")
            return 3
        word = int.from_bytes(data[3:5], "big")
        self.words_written.append(word)
        self._board.write_word(word)
        return 3 + count

    def _set_pins(self, data: bytearray) -> int:
        """Set clock, data and chip select of channel A; return the command's length, or 0 if it is incomplete."""
        if len(data) < 3:
            return 0
        pins = data[1]
        direction = data[2]
        if direction & (_CLOCK_PIN | _OUT_PIN | _SELECT_PIN) != _CLOCK_PIN | _OUT_PIN | _SELECT_PIN:
            self.errors.append(f"clock, data or chip select is not driven (direction {direction:08b})")
        if pins & _CLOCK_PIN:
            self.errors.append("the clock rests high: not SPI mode 0")
        was_high = self._pins & _SELECT_PIN
        if pins & _SELECT_PIN:
            self._latched = 0
            if was_high:
                self._high_s += _PIN_S
            else:
                self._high_s = _PIN_S
        else:
            if was_high and self._high_s < 2 * _CLOCKS_S - 1e-9:
                self.errors.append(f"chip select is high for {self._high_s * 1e9:.0f} ns between words")
            if was_high:
                self._low_s = _PIN_S
            else:
                self._low_s += _PIN_S
        self._pins = pins
        return 3

    def _set_gpio(self, data: bytearray) -> int:
        """Execute the first command of channel B; return its length in bytes, or 0 if it is incomplete."""
        code = data[0]
        if code in _COMMANDS_WITHOUT_DATA:
            return 1
        if code == _SET_PINS:
            if len(data) < 3:
                return 0
            if data[2] >> _INTERRUPT_BIT & 1:
                self.errors.append("the host drives the interrupt line")
            return 3
        if code == _READ_PINS:
            self._answers["B"].append(self._board.interrupt << _INTERRUPT_BIT)
            return 1
        return self._refuse_code("B", code)

    def _refuse_code(self, name: str, code: int) -> int:
        """Answer an unknown command as the chip does; return its length in bytes, 1."""
        self.errors.append(f"unknown command 0x{code:02X} on channel {name}")
        self._answers[name] += bytes((0xFA, code))
        return 1


class UsbChannel:
    """Port of one channel."""

    def __init__(self, chip: UsbChip, name: str) -> None:
        self._chip = chip
        self._name = name
        self.closed = False

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._chip.receive_from_host(self._name, data)

    def read(self, size: int) -> bytes:
        """Receive up to `size` bytes."""
        return self._chip.send_to_host(self._name, size)

    def close(self) -> None:
        """Close the port."""
        self.closed = True


class _Server:
    """A TCP server for an event loop that polls `fileno` and calls `serve`.

    `what` names it in errors. Raises DeviceError if it cannot listen at `address`, "host:port" or "tcp://host:port".
    """

    def __init__(self, address: str, what: str) -> None:
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        try:
            self._listener = socket.create_server((host, int(port)))
        except OSError as e:
            raise DeviceError(
                f"{what}: cannot listen at {address}: {e.strerror}",
                "another program uses this address",
                "end it, or change the address",
                code=ErrorCode.BUSY,
            ) from None
        self._listener.setblocking(False)
        self.address = f"tcp://{host}:{self._listener.getsockname()[1]}"
        # Connections by descriptor, with incomplete requests.
        self._clients: dict[int, tuple[socket.socket, bytes]] = {}
        self._ready = select.epoll()
        self._ready.register(self._listener, select.EPOLLIN)

    def fileno(self) -> int:
        """Return an epoll descriptor for the listener and its clients."""
        return self._ready.fileno()

    def serve(self) -> None:
        """Process pending connections and requests."""
        for descriptor, _ in self._ready.poll(0):
            if descriptor == self._listener.fileno():
                self._accept()
            elif descriptor in self._clients:
                client, rest = self._clients[descriptor]
                try:
                    data = client.recv(65536)
                    if data:
                        self._clients[descriptor] = client, self._execute(client, rest + data)
                        continue
                except (OSError, DeviceError):
                    # The client has disconnected, or the board is unplugged: close the connection.
                    pass
                self._drop(descriptor)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        self._clients[client.fileno()] = client, b""
        self._ready.register(client, select.EPOLLIN)

    def _execute(self, client: socket.socket, data: bytes) -> bytes:
        """Process the requests in `data` and return the incomplete rest. Raises OSError to close the connection."""
        raise NotImplementedError

    def _drop(self, descriptor: int) -> None:
        self._ready.unregister(descriptor)
        self._clients.pop(descriptor)[0].close()

    def close(self) -> None:
        """Close all sockets."""
        for descriptor in list(self._clients):
            self._drop(descriptor)
        self._listener.close()
        self._ready.close()


class RadarSocket(_Server):
    """A USB chip at a TCP address, for one client at a time."""

    def __init__(self, address: str, board: RadarBoard) -> None:
        super().__init__(address, "simulated radar")
        self.chip = UsbChip(board)

    def _accept(self) -> None:
        # The new client replaces the old one.
        for descriptor in list(self._clients):
            self._drop(descriptor)
        super()._accept()

    def _execute(self, client: socket.socket, data: bytes) -> bytes:
        """Execute whole requests: read from a port (R, answered) or write to it; return the bytes that are left."""
        while len(data) >= _HEAD.size:
            channel, operation, size = _HEAD.unpack_from(data)
            port = channel.decode("ascii")
            if operation == b"R":
                answer = self.chip.send_to_host(port, size)
                client.sendall(struct.pack("<H", len(answer)) + answer)
                data = data[_HEAD.size :]
                continue
            if len(data) < _HEAD.size + size:
                break
            self.chip.receive_from_host(port, data[_HEAD.size : _HEAD.size + size])
            data = data[_HEAD.size + size :]
        return data


class LineServer(_Server):
    """Control server of a board at `address:port`; it calls `rearm` for each line that arms the radar."""

    def __init__(self, address: str, rearm: Callable[[], None], faults: Faults) -> None:
        super().__init__(address, "simulated control server")
        self._rearm = rearm
        self._faults = faults
        self.lines = 0

    def _execute(self, client: socket.socket, data: bytes) -> bytes:
        """Rearm for each whole line, but as the faults say; return the bytes that are left."""
        *lines, unfinished_line = data.split(b"\n")
        for line in lines:
            if line.strip() != RETRIGGER_LINE:
                continue
            number = self.lines
            self.lines = self.lines + 1
            if number in self._faults.retrigger_resets:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
                raise ConnectionResetError
            if number not in self._faults.retrigger_fails:
                self._rearm()
        return unfinished_line
