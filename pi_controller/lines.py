"""Lines of the Raspberry Pi: trigger input and SYNC_IN through libgpiod v2, or SYNC_IN on MOSI through spidev.

Runs on any Linux GPIO chip; never run on a Pi by this project yet. Sources of the ioctls: Linux,
include/uapi/linux/gpio.h and include/uapi/linux/spi/spidev.h.
"""

from __future__ import annotations

import array
import errno
import fcntl
import os
import struct
import time
from collections import deque
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from polysight.pi_controller.bursts import DEFAULT_BUFSIZ, Edge, Lines, SpiBurst
from polysight.pi_controller.sim_lines import SpiWireLines, WireLines
from polysight.shared.config import Instrument, Pi
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.faults import PiFault
from polysight.shared.messages import GPIOD, SPI

EVENT_BUFFER = 1024  # the kernel keeps 16 events a line unless asked for more: a starved process would lose edges
SPIN_NS = 100_000  # a sleep may end this much late; the rest of a wait is spent looking at the clock
WARM_NS = 30_000
TWO_CALLS_NS = 1000  # a pulse not wanted longer is as short as two system calls make it
SET_VALUES = 0xC010B40F  # GPIO_V2_LINE_SET_VALUES_IOCTL, and its argument: bits, mask
_VALUES = struct.Struct("=QQ")
BUFSIZ = Path("/sys/module/spidev/parameters/bufsiz")
# _IOW('k', 0, struct spi_ioc_transfer[1]), _IOW('k', 1, __u8): mode 0, without chip select where the driver can.
MESSAGE, WRITE_MODE = 0x40206B00, 0x40016B01
MODE_NO_CS, MODE_0 = 0x40, 0x00
_TRANSFER = struct.Struct("=QQIIHBBBBBB")  # tx, rx, len, speed_hz, delay_us, bits, cs_change, tx_nbits, rx_nbits, ...
_RIGHTS = "60-polysight.rules gives it the device (udev), `sudo usermod -aG gpio,spi USER` the user its groups"
_REASONS = {
    errno.EBUSY: ("it is in use", "end that program; `systemctl stop polysight-pi` when it is polysight itself"),
    errno.EACCES: ("no permission", _RIGHTS),
    errno.EPERM: ("no permission", _RIGHTS),
    errno.ENOENT: ("there is no such device", "set pi.gpio_chip in instrument.toml to a label or path that exists"),
    errno.EINVAL: ("the chip has no such line, or cannot set it so", "correct [pi] in instrument.toml (see gpioinfo)"),
    errno.ENXIO: ("the chip reports no edges on this line", "use a line of the Pi's own header as pi.trigger_in"),
    errno.ENODEV: ("the chip is gone", "look at the kernel's log (dmesg)"),
}
_SPI_REASONS = {
    errno.ENOENT: ("SPI is off", "put `dtparam=spi=on` into /boot/firmware/config.txt and start the Pi again"),
    errno.EACCES: ("no permission", _RIGHTS),
    errno.EMSGSIZE: ("the transfer is longer than spidev's buffer", "raise bufsiz; `polysight-pi check` says to what"),
}


def open_lines(instrument: Instrument, wires: Path | None = None) -> Lines:
    """The rig's lines on GPIO, or on simulated wires. Raises ConfigError or DeviceError when they cannot be had."""
    pi = instrument.pi
    if wires is not None:
        return (SpiWireLines if pi.wiring == "spi" else WireLines)(wires, pi)
    if pi.wiring == "gpiomem" or len(pi.sync_out) > 1:
        raise ConfigError(
            f'wiring = "{pi.wiring}" with sync_out = {list(pi.sync_out)} is not driven any more',
            "a Pi sets its lines one after another, 50 to 200 ns apart: boards would differ by more IF than their band",
            'use wiring = "spi", or "fanout", with a clock buffer behind one line (docs/how-to/wiring.md)',
        )
    return (SpiLines if pi.wiring == "spi" else GpiodLines)(pi, load_gpiod())


def load_gpiod() -> ModuleType:
    """The gpiod module. Raises ConfigError when it is absent or the old v1 API."""
    try:
        import gpiod
    except ImportError:
        gpiod = None
    if gpiod is None or not hasattr(gpiod, "request_lines"):
        raise ConfigError(
            "the Python package gpiod " + ("is not installed" if gpiod is None else "has the old v1 API"),
            "GPIO needs the libgpiod v2 bindings; the distribution's packages are older",
            "pip install 'gpiod>=2.1' into the program's own environment, or run with --wires on simulated wires",
        )
    return gpiod


def find_chip(name: str, gpiod: Any, devices: Path = Path("/dev")) -> str:
    """Path of a GPIO chip by label (numbers change between kernels) or path. Raises DeviceError with the labels."""
    if name.startswith("/"):
        return name
    labels = []
    for path in sorted(devices.glob("gpiochip*")):
        try:
            with gpiod.Chip(str(path)) as chip:
                label = chip.get_info().label
        except OSError as e:
            labels.append(f"{path} ({e.strerror})")
            continue
        if label == name:
            return str(path)
        labels.append(f"{path} is {label!r}")
    raise DeviceError(
        f"no GPIO chip has the label {name!r}: found {', '.join(labels) or 'none'}",
        "another Pi model, no GPIO on this machine, or no permission (group gpio)",
        "set pi.gpio_chip in instrument.toml to one of these labels or to a path",
    )


def _request(gpiod: Any, path: str, line: int, buffer: int | None = None, **settings: Any) -> Any:
    """Request a line of a chip. Raises DeviceError with the reason in plain words."""
    config = {(line,): gpiod.LineSettings(**settings)}
    try:
        return gpiod.request_lines(path, config, consumer="polysight", event_buffer_size=buffer)
    except (OSError, ValueError) as e:
        number = (e.errno if isinstance(e, OSError) else errno.EINVAL) or 0
        why, remedy = _REASONS.get(number, (f"the kernel says: {e}", "gpioinfo shows what the chip can do"))
        if number == errno.EBUSY:
            with gpiod.Chip(path) as chip:
                why = f"it is held by {chip.get_line_info(line).consumer!r}"
        where = f"fault {int(PiFault.TRIGGER_LINE_LOST)}: GPIO line {line} of {path}: {why}"
        raise DeviceError(where, str(e), remedy) from None


def request_output(gpiod: Any, path: str, line: int) -> Any:
    """Request a SYNC_IN line: an output, low from the start. Raises DeviceError."""
    low = gpiod.line.Value.INACTIVE
    return _request(gpiod, path, line, direction=gpiod.line.Direction.OUTPUT, output_value=low)


def _gone(e: OSError) -> DeviceError:
    return DeviceError(
        f"GPIO lines are gone: {e.strerror}", "the chip vanished or its driver was unloaded", "`polysight-pi check`"
    )


class TriggerInput:
    """The trigger input: rising edges, stamped by the kernel with CLOCK_MONOTONIC, with bias and debouncing.

    `gpiod` is the module, or a stand-in; `path` replaces the search for the configured label; `clock` has `now_ns` and
    `sleep_until` of a stand-in. Raises DeviceError when the chip or the line cannot be had.
    """

    def __init__(self, pi: Pi, gpiod: Any, path: str | None = None, clock: Any = None) -> None:
        self.check_width = not pi.one_shot
        self.now_ns: Callable[[], int] = clock.now_ns if clock else time.monotonic_ns
        self._sleep_until: Callable[[int], None] = clock.sleep_until if clock else _sleep_until
        self._events: deque[Any] = deque()
        line = gpiod.line
        self._input = _request(
            gpiod, path or find_chip(pi.gpio_chip, gpiod), pi.trigger_in, EVENT_BUFFER,
            direction=line.Direction.INPUT, edge_detection=line.Edge.RISING, event_clock=line.Clock.MONOTONIC,
            bias=line.Bias[pi.trigger_bias.upper().replace("-", "_")],
            debounce_period=timedelta(microseconds=pi.trigger_debounce_us),
        )  # fmt: skip

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it."""
        self._sleep_until(t_ns)

    def wait_edge(self, limit_s: float) -> Edge | None:
        """The next rising edge. Raises DeviceError when the line is gone."""
        try:
            if not self._events and self._input.wait_edge_events(timedelta(seconds=limit_s)):
                self._events.extend(self._input.read_edge_events())
        except OSError as e:
            raise _gone(e) from None
        if not self._events:
            return None
        event = self._events.popleft()
        return Edge(event.timestamp_ns, event.line_seqno)

    def close(self) -> None:
        """Release the line."""
        self._input.release()


def _sleep_until(t_ns: int) -> None:
    """Sleep most of the way, watch the clock for the rest."""
    left = t_ns - time.monotonic_ns() - SPIN_NS
    if left > 0:
        time.sleep(left * 1e-9)
    while time.monotonic_ns() < t_ns:
        pass


class GpiodLines(TriggerInput):
    """The trigger input, and a SYNC_IN output that is low from the start and, through the kernel, after this program.

    A pulse is two system calls on the request's descriptor, prepared beforehand (`ioctl`: a stand-in's). Other
    parameters and errors are those of :class:`TriggerInput`.
    """

    name: str = GPIOD

    def __init__(
        self, pi: Pi, gpiod: Any, path: str | None = None, clock: Any = None, ioctl: Callable[..., object] = fcntl.ioctl
    ) -> None:
        path = path or find_chip(pi.gpio_chip, gpiod)
        self._output = request_output(gpiod, path, pi.sync_out[0])
        self._set, self._clear = (partial(ioctl, self._output.fd, SET_VALUES, _VALUES.pack(v, 1)) for v in (1, 0))
        try:
            super().__init__(pi, gpiod, path, clock)
        except DeviceError:
            self._output.release()
            raise

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it.

        After a sleep, the call that will make the pulse is made once to no effect: that brings it back into the
        processor's caches (measured on a busy machine: periods off by 0.8 instead of 5 us).
        """
        if t_ns - self.now_ns() > SPIN_NS + WARM_NS:
            super().sleep_until(t_ns - WARM_NS)
            self.pulse(0, self._clear)
        super().sleep_until(t_ns)

    def pulse(self, width_ns: int, first: Callable[[], object] | None = None) -> tuple[int, int]:
        """Set SYNC_IN and clear it; the times before and after. Raises DeviceError when the line is gone.

        Up to TWO_CALLS_NS nothing is between the two calls. `first` replaces the call that sets.
        """
        now, rise, fall = self.now_ns, first or self._set, self._clear
        try:
            before = now()
            rise()
            if width_ns > TWO_CALLS_NS:
                super().sleep_until(before + width_ns)
            fall()
            return before, now()
        except OSError as e:
            raise _gone(e) from None

    def measure(self) -> int:
        """Time that :meth:`pulse` takes when both of its calls leave the line low, nanoseconds."""
        before, after = self.pulse(0, self._clear)
        return after - before

    def close(self) -> None:
        """SYNC_IN low, lines released."""
        try:
            self.pulse(0, self._clear)
        finally:
            self._output.release()
            super().close()


class SpiDevice:
    """A spidev device whose MOSI is SYNC_IN: low from the start. Raises DeviceError when it cannot be had.

    The kernel ends a transfer that has begun also when this program is killed, and its last bits are low.
    """

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

    @property
    def bufsiz(self) -> int:
        """Longest transfer that spidev takes, bytes."""
        try:
            return int(BUFSIZ.read_text())
        except (OSError, ValueError):
            return DEFAULT_BUFSIZ

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
        unknown = f"the kernel says: {e.strerror}", "look at the kernel's log (dmesg)"
        why, remedy = _SPI_REASONS.get(e.errno or 0, unknown)
        return DeviceError(f"fault {int(PiFault.TRIGGER_LINE_LOST)}: {self.path}: {e.strerror}", why, remedy)

    def close(self) -> None:
        """Let go of it."""
        os.close(self._fd)


class SpiLines(TriggerInput):
    """Trigger input with kernel time stamps; SYNC_IN on MOSI, low before, between and after bursts."""

    name: str = SPI

    def __init__(self, pi: Pi, gpiod: Any, path: str | None = None, clock: Any = None) -> None:
        self._device = SpiDevice(pi.spi_device)
        self.bufsiz = self._device.bufsiz
        try:
            super().__init__(pi, gpiod, path, clock)
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
