"""16-bit words as the byte stream of an FT4232H, the USB chip of a DCA1000 or DevPack (USB 0451:fd03).

Channel A: MPSSE, SPI mode 0 at 10 MHz; each word with chip select of its own, most significant byte first. B: MPSSE,
the host interrupt on bit 5. C: bit-bang, C6 reset, C7 warm reset. D: bit-bang, sense-on-power lines. Pins: TI's FTDI
port sources; commands: FTDI application note AN_108. Not run on hardware yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from polysight.shared.errors import DeviceError

SPI_DIRECTION = 0b0100_1011  # clock, data out, chip select, PMIC reset are outputs
SELECTED_WRITE, SELECTED_READ, IDLE = 0xC0, 0xC2, 0xC8
INTERRUPT_DIRECTION = 0b0101_1011  # bit 5, the interrupt, is an input
INTERRUPT_IDLE = 0b0001_0011
INTERRUPT_BIT = 5
RESET_DIRECTION, RESET_PIN, WARM_RESET_PIN = 0b1111_1001, 6, 7
SENSE_DIRECTION, FUNCTIONAL_MODE = 0b1111_1111, 0b0001_0000  # D4 = 1, D3 = D2 = 0
_PINS, _READ_PINS, _WRITE_BYTES, _READ_BYTES, _NOW = 0x80, 0x81, 0x11, 0x20, 0x87
_FULL_SPEED, _NO_ADAPTIVE, _NO_THREE_PHASE, _THREE_PHASE, _DIVISOR = 0x8A, 0x97, 0x8D, 0x8C, 0x86
_NO_LOOPBACK = 0x85
SPI_DIVISOR = 2  # 60 MHz / (2 x (2 + 1)) = 10 MHz
_RESET_S = 0.01


class Port(Protocol):
    """One channel of the chip, opened in its mode."""

    def write(self, data: bytes) -> None:
        """Send bytes to the channel. Raises DeviceError when the chip is gone."""
        ...

    def read(self, size: int) -> bytes:
        """Up to so many bytes from the channel. Raises DeviceError when the chip is gone."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


def set_up_spi() -> bytes:
    """What channel A is told first."""
    clock = bytes((_FULL_SPEED, _NO_ADAPTIVE, _NO_THREE_PHASE, _DIVISOR, SPI_DIVISOR, 0))
    return clock + bytes((_PINS, IDLE, SPI_DIRECTION, _NO_LOOPBACK))


def set_up_interrupt() -> bytes:
    """What channel B is told first."""
    return bytes((_FULL_SPEED, _NO_ADAPTIVE, _THREE_PHASE, _PINS, INTERRUPT_IDLE, INTERRUPT_DIRECTION, _NO_LOOPBACK))


def write_words(words: Sequence[int]) -> bytes:
    """Words out: chip select low, two bytes on the falling edge, chip select high, for each."""
    parts = bytearray()
    for word in words:
        parts += bytes((_PINS, SELECTED_WRITE, SPI_DIRECTION, _WRITE_BYTES, 1, 0, word >> 8, word & 0xFF))
        parts += bytes((_PINS, IDLE, SPI_DIRECTION))
    return bytes(parts) + bytes((_NOW,))


def read_words(count: int) -> bytes:
    """Words in: chip select low, two bytes on the rising edge, chip select high, for each."""
    select = bytes((_PINS, SELECTED_READ, SPI_DIRECTION, _READ_BYTES, 1, 0, _PINS, IDLE, SPI_DIRECTION))
    return select * count + bytes((_NOW,))


class UsbWords:
    """A board behind the four channels of one chip; satisfies :class:`polysight.host.radar.spi.WordLink`."""

    def __init__(
        self, spi: Port, interrupt: Port, reset: Port, sense: Port, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._spi, self._interrupt, self._reset, self._sense, self._sleep = spi, interrupt, reset, sense, sleep
        self._spi.write(set_up_spi())
        self._interrupt.write(set_up_interrupt())

    def write(self, words: Sequence[int]) -> None:
        """Shift words out. Raises DeviceError."""
        self._spi.write(write_words(words))

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError."""
        self._spi.write(read_words(count))
        data = _exactly(self._spi, 2 * count)
        return [int.from_bytes(data[at : at + 2], "big") for at in range(0, 2 * count, 2)]

    def interrupt(self) -> bool:
        """Whether the host interrupt is high. Raises DeviceError."""
        self._interrupt.write(bytes((_READ_PINS, _NOW)))
        return bool(_exactly(self._interrupt, 1)[0] >> INTERRUPT_BIT & 1)

    def reset(self, held: bool) -> None:
        """Sense lines to functional mode, then hold or release the reset. Raises DeviceError."""
        self._sense.write(bytes((FUNCTIONAL_MODE,)))
        self._reset.write(bytes((1 << WARM_RESET_PIN | (0 if held else 1 << RESET_PIN),)))
        self._sleep(_RESET_S)

    def close(self) -> None:
        """Let go of the chip."""
        for port in (self._spi, self._interrupt, self._reset, self._sense):
            port.close()


def _exactly(port: Port, size: int) -> bytes:
    data = port.read(size)
    if len(data) != size:
        raise DeviceError(f"{len(data)} of {size} bytes came over USB", "the cable is loose", "check the USB cable")
    return data
