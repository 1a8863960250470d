"""The FT4232H between host and simulated radar board: byte streams of its four channels, decoded to lines and words.

Channel A and B understand the MPSSE commands of FTDI's application note AN_108 that SPI needs, and answer an unknown
one as the chip does (0xFA and the command). C and D are bit-bang ports. What the streams do wrong is collected in
`errors`. A stand-in: USB's own timing is not shown.
"""

from __future__ import annotations

from collections.abc import Callable

from polysight.shared.errors import DeviceError
from polysight.simulators.radar_board import RadarBoard

_CLOCK, _OUT, _SELECT = 1 << 0, 1 << 1, 1 << 3
_BARE = (0x85, 0x87, 0x8A, 0x8C, 0x8D, 0x97)
_CHANNELS = "ABCD"


class UsbChip:
    """One chip. `channel("A")` and so on are ports with `write`, `read`, `close`."""

    def __init__(self, board: RadarBoard) -> None:
        self._board = board
        self.errors: list[str] = []
        self.words_written: list[int] = []
        self.spi_hz = 0.0
        self._fast, self._pins, self._latched = False, 0, 0
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
        if pins & _SELECT:
            self._latched = 0
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
