"""SYNC_IN on MOSI of an SPI controller (spidev), the trigger input through libgpiod. Not run on a Pi yet.

One burst is one transfer, one system call. The kernel ends a transfer that has begun also when this program is killed,
and its last bits are low; the line is low before, between and after.
Source of the ioctl: Linux, include/uapi/linux/spi/spidev.h.
"""

from __future__ import annotations

import array
import errno
import fcntl
import os
import struct
import time
from pathlib import Path
from typing import Any

from polysight.pi_controller.gpio import TriggerInput
from polysight.pi_controller.lines import DEFAULT_BUFSIZ, Clock, SpiBurst
from polysight.shared.config import Pi
from polysight.shared.errors import DeviceError
from polysight.shared.faults import PiFault
from polysight.shared.messages import SPI

BUFSIZ = Path("/sys/module/spidev/parameters/bufsiz")
# _IOW('k', 0, struct spi_ioc_transfer[1]), _IOW('k', 1, __u8): mode 0, without chip select where the driver can.
MESSAGE, WRITE_MODE = 0x40206B00, 0x40016B01
MODE_NO_CS, MODE_0 = 0x40, 0x00
_TRANSFER = struct.Struct("=QQIIHBBBBBB")  # tx, rx, len, speed_hz, delay_us, bits, cs_change, tx_nbits, rx_nbits, ...
_REASONS = {
    errno.ENOENT: ("SPI is off", "put `dtparam=spi=on` into /boot/firmware/config.txt and start the Pi again"),
    errno.EACCES: (
        "no permission",
        "add the user to the group spi; the udev rule 60-polysight.rules gives it the device",
    ),
    errno.EMSGSIZE: ("the transfer is longer than spidev's buffer", "raise bufsiz; `polysight-pi check` says to what"),
}


def read_bufsiz() -> int:
    """Longest transfer that spidev takes, bytes."""
    try:
        return int(BUFSIZ.read_text())
    except (OSError, ValueError):
        return DEFAULT_BUFSIZ


class SpiDevice:
    """A spidev device, low from the start. Raises DeviceError when it cannot be had."""

    def __init__(self, path: str) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as e:
            raise self._refused(e) from None
        try:
            try:
                fcntl.ioctl(self._fd, WRITE_MODE, bytes([MODE_NO_CS]))
            except OSError:
                fcntl.ioctl(self._fd, WRITE_MODE, bytes([MODE_0]))
            self.transfer(bytes(1), 1_000_000)
        except (OSError, DeviceError) as e:
            os.close(self._fd)
            raise (e if isinstance(e, DeviceError) else self._refused(e)) from None

    def transfer(self, data: bytes, clock_hz: int) -> tuple[int, int]:
        """Clock the bytes out; returns the times before and after the one system call. Raises DeviceError."""
        buffer = array.array("B", data)
        message = _TRANSFER.pack(buffer.buffer_info()[0], 0, len(data), clock_hz, 0, 8, 0, 0, 0, 0, 0)
        try:
            before = time.monotonic_ns()
            fcntl.ioctl(self._fd, MESSAGE, message)
            return before, time.monotonic_ns()
        except OSError as e:
            raise self._refused(e) from None

    def _refused(self, e: OSError) -> DeviceError:
        why, remedy = _REASONS.get(e.errno or 0, (f"the kernel says: {e.strerror}", "look at the kernel's log (dmesg)"))
        return DeviceError(f"fault {int(PiFault.TRIGGER_LINE_LOST)}: {self.path}: {e.strerror}", why, remedy)

    def close(self) -> None:
        """Let go of it."""
        os.close(self._fd)


class SpiLines(TriggerInput):
    """Trigger input with kernel time stamps; SYNC_IN on MOSI. Raises DeviceError when one cannot be had."""

    name: str = SPI

    def __init__(self, pi: Pi, gpiod: Any, chip_path: str | None = None, clock: Clock | None = None) -> None:
        self.bufsiz = read_bufsiz()
        self._device = SpiDevice(pi.spi_device)
        try:
            super().__init__(pi, gpiod, chip_path, clock)
        except DeviceError:
            self._device.close()
            raise

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send a burst. Raises DeviceError."""
        return self._device.transfer(burst.data, burst.clock_hz)

    def close(self) -> None:
        """Lines released; MOSI is low."""
        try:
            self._device.close()
        finally:
            super().close()
