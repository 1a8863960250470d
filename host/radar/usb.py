"""Opens the four channels of a DCA1000's FT4232H by its serial number, with pyftdi (the host's extra `radar`).

Not run on hardware yet.
"""

from __future__ import annotations

import time
from typing import Any

from polysight.host.radar.mpsse import INTERRUPT_DIRECTION, RESET_DIRECTION, SENSE_DIRECTION, SPI_DIRECTION, UsbWords
from polysight.shared.errors import ConfigError, DeviceError

VENDOR, PRODUCT = 0x0451, 0xFD03
_READ_S = 0.5
_LATENCY_MS = 1
_CHECK = "check the cable and the board's power; `lsusb -v -d 0451:fd03 | grep iSerial` lists what is there"


class FtdiPort:
    """One channel, in MPSSE or bit-bang mode. Errors of the USB library become DeviceError."""

    def __init__(self, serial: str, interface: int, direction: int, bit_bang: bool) -> None:
        ftdi, self._errors = _library()
        self._serial = serial
        self._ftdi = ftdi()
        try:
            if VENDOR not in ftdi.PRODUCT_IDS:
                ftdi.add_custom_vendor(VENDOR, "ti")
                ftdi.add_custom_product(VENDOR, PRODUCT, "devpack")
            self._ftdi.open(VENDOR, PRODUCT, serial=serial, interface=interface)
            self._ftdi.set_bitmode(0, ftdi.BitMode.RESET)
            self._ftdi.set_latency_timer(_LATENCY_MS)
            self._ftdi.purge_buffers()
            self._ftdi.set_bitmode(direction, ftdi.BitMode.BITBANG if bit_bang else ftdi.BitMode.MPSSE)
        except self._errors as e:
            raise DeviceError(
                f"radar USB serial {serial}, channel {'ABCD'[interface - 1]}: cannot be opened: {e}",
                "unplugged, another serial number, no permission (a udev rule for 0451:fd03), or libusb is missing",
                _CHECK,
            ) from None

    def write(self, data: bytes) -> None:
        """Send bytes. Raises DeviceError."""
        try:
            self._ftdi.write_data(data)
        except self._errors as e:
            raise self._gone(e) from None

    def read(self, size: int) -> bytes:
        """Up to so many bytes, after half a second those that came. Raises DeviceError."""
        found, deadline = bytearray(), time.monotonic() + _READ_S
        try:
            while len(found) < size and time.monotonic() < deadline:
                found += self._ftdi.read_data_bytes(size - len(found), attempt=4)
        except self._errors as e:
            raise self._gone(e) from None
        return bytes(found)

    def close(self) -> None:
        """Let go of it, its pins as they are."""
        self._ftdi.close(freeze=True)

    def _gone(self, e: BaseException) -> DeviceError:
        return DeviceError(
            f"radar USB serial {self._serial}: {e}", "the cable was pulled, or the board lost power", _CHECK
        )


def open_usb(serial: str) -> UsbWords:
    """A board by the serial number of its USB chip.

    Raises
    ------
    ConfigError
        when pyftdi is not installed.
    DeviceError
        when the chip cannot be opened.
    """
    ports: list[FtdiPort] = []
    try:
        for interface, (direction, bit_bang) in enumerate(
            (
                (SPI_DIRECTION, False),
                (INTERRUPT_DIRECTION, False),
                (RESET_DIRECTION, True),
                (SENSE_DIRECTION, True),
            ),
            start=1,
        ):
            ports.append(FtdiPort(serial, interface, direction, bit_bang))
        spi, interrupt, reset, sense = ports
        return UsbWords(spi, interrupt, reset, sense)
    except (ConfigError, DeviceError):
        for port in ports:
            port.close()
        raise


def _library() -> tuple[Any, tuple[type[Exception], ...]]:
    """Class and errors of pyftdi; loaded only here, so that a host without radars does not need it."""
    try:
        from pyftdi.ftdi import Ftdi
        from pyftdi.usbtools import UsbToolsError
    except ImportError:
        raise ConfigError(
            'radar.control = "native" needs pyftdi, which is not installed',
            "it comes with the host's extra `radar`",
            "pip install 'polysight[radar]' (in this repository: .venv/bin/pip install -e '.[radar]')",
        ) from None
    return Ftdi, (OSError, ValueError, UsbToolsError)  # FtdiError and USBError are OSErrors
