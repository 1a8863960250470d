"""Trigger input and SYNC_IN output: libgpiod v2, SYNC_IN on MOSI through spidev, or simulated wires.

The hardware classes work on any Linux GPIO chip; not run on a Pi yet. Sources of the ioctls: Linux,
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
from typing import Any

from polysight_pi.trigger import DEFAULT_BUFSIZ, Edge, Lines, ReturnedPulses, SpiBurst
from polysight_shared.config import Instrument, Pi
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.messages import GPIOD, SPI, WIRES
from polysight_shared.wires import WireClient, WireEdge

# Edges kept by the kernel; its default of 16 would lose edges of a program without CPU time.
EVENT_BUFFER = 1024
# A sleep may end this much late (chosen), so the rest of a wait polls the clock.
SPIN_NS = 100_000
# Time before a pulse at which its code is loaded into the caches (`GpiodLines.sleep_until`); chosen, longer than a
# system call takes.
WARM_NS = 30_000
# Timeout for the pulses of simulated wires: a busy machine delivers them late.
SIMULATED_LOOK_BACK_S = 2.0
# Timeout for pulses that were sent and are not seen; the kernel reports them within microseconds.
LOOK_BACK_S = 0.05
# Pulses up to this width are as short as two system calls make them; longer ones wait in between.
TWO_CALLS_NS = 1000
# GPIO_V2_LINE_SET_VALUES_IOCTL, with the argument (bits, mask).
SET_VALUES = 0xC010B40F
_VALUES = struct.Struct("=QQ")
# The module parameter of spidev: longest transfer, bytes.
BUFSIZ_FILE = Path("/sys/module/spidev/parameters/bufsiz")
# Request of a transfer: _IOW('k', 0, struct spi_ioc_transfer[1]).
MESSAGE = 0x40206B00
# Request to set the SPI mode: _IOW('k', 1, __u8).
WRITE_MODE = 0x40016B01
# SPI mode 0, and the bit for a transfer without chip select, which not every driver has.
MODE_NO_CS = 0x40
MODE_0 = 0x00
# struct spi_ioc_transfer: tx, rx, len, speed_hz, delay_us, bits, cs_change, tx_nbits, rx_nbits, ...
_TRANSFER = struct.Struct("=QQIIHBBBBBB")
# Likely cause and remedy by error number, of GPIO lines and of SPI devices.
_RIGHTS_REMEDY = (
    "60-polysight.rules sets the device's group (udev), `sudo usermod -aG gpio,spi USER` adds the user to it"
)
_REASONS = {
    errno.EBUSY: ("it is in use", "end that program; `systemctl stop polysight-pi` if it is polysight itself"),
    errno.EACCES: ("no permission", _RIGHTS_REMEDY),
    errno.EPERM: ("no permission", _RIGHTS_REMEDY),
    errno.ENOENT: ("there is no such device", "set pi.gpio_chip in instrument.toml to a label or path that exists"),
    errno.EINVAL: ("the chip has no such line, or cannot set it so", "correct [pi] in instrument.toml (see gpioinfo)"),
    errno.ENXIO: ("the chip reports no edges on this line", "use a line of the Pi's own header as pi.trigger_in"),
    errno.ENODEV: ("the chip has disappeared", "look at the kernel's log (dmesg)"),
}
_SPI_REASONS = {
    errno.ENOENT: ("SPI is off", "put `dtparam=spi=on` into /boot/firmware/config.txt and reboot the Pi"),
    errno.EACCES: ("no permission", _RIGHTS_REMEDY),
    errno.EMSGSIZE: ("the transfer is longer than spidev's buffer", "raise bufsiz as `polysight-pi check` says"),
}


def check_wiring(pi: Pi) -> str:
    """Return how the SYNC_IN pulses are wired. Raises ConfigError for wirings of earlier rig files."""
    if pi.wiring == "gpiomem" or len(pi.sync_out) > 1:
        raise ConfigError(
            f'wiring = "{pi.wiring}" with sync_out = {list(pi.sync_out)} is no longer supported',
            "a Pi sets its lines one after another, 50 to 200 ns apart, which shifts the IF by more than its band",
            'use wiring = "spi", or "fanout", with a clock buffer behind one line (docs/how-to/wiring.md)',
            code=ErrorCode.VALUE_INVALID,
        )
    return f'wiring = "{pi.wiring}"'


def open_lines(instrument: Instrument, wires: Path | None = None) -> Lines:
    """Open the rig's lines on GPIO, or on the simulated wires of the hub at `wires`.

    Raises ConfigError or DeviceError if they cannot be opened.
    """
    pi = instrument.pi
    check_wiring(pi)
    is_spi = pi.wiring == "spi"
    if wires is not None:
        return SpiWireLines(wires, pi) if is_spi else WireLines(wires, pi)
    return SpiLines(pi) if is_spi else GpiodLines(pi)


def load_gpiod() -> Any:
    """Import gpiod. Raises ConfigError if it is missing or has the old v1 API."""
    try:
        import gpiod
    except ImportError:
        gpiod = None
    if gpiod is None or not hasattr(gpiod, "request_lines"):
        raise ConfigError(
            "the Python package gpiod " + ("is not installed" if gpiod is None else "has the old v1 API"),
            "GPIO needs the libgpiod v2 bindings; the distribution's packages are older",
            "pip install 'gpiod>=2.1' into the program's own environment, or run with --wires on simulated wires",
            code=ErrorCode.PACKAGE_MISSING,
        )
    return gpiod


def find_chip(name: str, devices: Path = Path("/dev")) -> str:
    """Return the path of a GPIO chip given its path or label (chip numbers differ between kernels).

    Raises DeviceError, with the labels found, if there is no such chip.
    """
    if name.startswith("/"):
        return name
    gpiod = load_gpiod()
    chips: list[str] = []
    for path in sorted(devices.glob("gpiochip*")):
        try:
            with gpiod.Chip(str(path)) as chip:
                label = chip.get_info().label
        except OSError as e:
            chips.append(f"{path} ({e.strerror})")
            continue
        if label == name:
            return str(path)
        chips.append(f"{path} is {label!r}")
    remedy = "set pi.gpio_chip in instrument.toml to one of these labels or to a path"
    if not chips:
        remedy = "run this on the Pi; with a simulated rig (docs/spec/simulated-rig.md) give the socket of its --wires"
    raise DeviceError(
        f"no GPIO chip has the label {name!r}: found {', '.join(chips) or 'none'}",
        "another Pi model, no GPIO on this machine, or no permission (group gpio)",
        remedy,
        code=ErrorCode.FILE_MISSING,
    )


def _request(pi: Pi, line: int, buffer: int | None = None, **settings: Any) -> Any:
    """Request a line of the rig's chip; `settings` are those of gpiod.LineSettings, `buffer` the number of events kept.

    Raises DeviceError with the reason.
    """
    gpiod = load_gpiod()
    path = find_chip(pi.gpio_chip)
    config = {(line,): gpiod.LineSettings(**settings)}
    try:
        return gpiod.request_lines(path, config, consumer="polysight", event_buffer_size=buffer)
    except (OSError, ValueError) as e:
        number = (e.errno if isinstance(e, OSError) else errno.EINVAL) or 0
        cause, remedy = _REASONS.get(number, (f"the kernel says: {e}", "gpioinfo shows what the chip can do"))
        if number == errno.EBUSY:
            with gpiod.Chip(path) as chip:
                cause = f"it is held by {chip.get_line_info(line).consumer!r}"
        summary = f"fault {int(PiFault.TRIGGER_LINE_LOST)}: GPIO line {line} of {path}: {cause}"
        raise DeviceError(summary, str(e), remedy) from None


def request_output(pi: Pi) -> Any:
    """Request the SYNC_IN line as an output that is low from the start. Raises DeviceError."""
    line = load_gpiod().line
    return _request(pi, pi.sync_out[0], direction=line.Direction.OUTPUT, output_value=line.Value.INACTIVE)


def _request_edges(pi: Pi, number: int, debounce_us: int = 0) -> Any:
    """Request GPIO line `number` as an input whose rising edges the kernel stamps (CLOCK_MONOTONIC) and counts.

    Raises DeviceError.
    """
    line = load_gpiod().line
    return _request(
        pi,
        number,
        EVENT_BUFFER,
        direction=line.Direction.INPUT,
        edge_detection=line.Edge.RISING,
        event_clock=line.Clock.MONOTONIC,
        bias=line.Bias[pi.trigger_bias.upper().replace("-", "_")],
        debounce_period=timedelta(microseconds=debounce_us),
    )


def _is_stamped_by_the_kernel(pi: Pi) -> bool:
    """True if edges have times of CLOCK_MONOTONIC; a chip with a timestamp engine of its own has another clock."""
    gpiod = load_gpiod()
    with gpiod.Chip(find_chip(pi.gpio_chip)) as chip:
        return chip.get_line_info(pi.trigger_in).event_clock == gpiod.line.Clock.MONOTONIC


def _line_lost_error(e: OSError) -> DeviceError:
    return DeviceError(
        f"GPIO lines are lost: {e.strerror}", "the chip vanished or its driver was unloaded", "`polysight-pi check`"
    )


class TriggerInput:
    """The trigger input: rising edges with kernel time stamps (CLOCK_MONOTONIC), bias and debouncing.

    `check_width` and `is_real_time` as in `Lines`. Raises DeviceError if the chip or the line is not available.
    """

    def __init__(self, pi: Pi) -> None:
        # A one-shot behind the output gives the pulses their width, however late the line is cleared.
        self.check_width = not pi.one_shot
        # Events that the kernel has delivered and `wait_edge` has not returned yet.
        self._events: deque[Any] = deque()
        self._input = _request_edges(pi, pi.trigger_in, pi.trigger_debounce_us)
        self.is_real_time = _is_stamped_by_the_kernel(pi)

    def now_ns(self) -> int:
        """Return the time of CLOCK_MONOTONIC, nanoseconds."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it: sleep most of the time, then poll the clock."""
        sleep_ns = t_ns - time.monotonic_ns() - SPIN_NS
        if sleep_ns > 0:
            time.sleep(sleep_ns * 1e-9)
        while time.monotonic_ns() < t_ns:
            pass

    def wait_edge(self, timeout_s: float) -> Edge | None:
        """Return the next rising edge, or None after a timeout. Raises DeviceError when the line is lost."""
        try:
            if not self._events and self._input.wait_edge_events(timedelta(seconds=timeout_s)):
                self._events.extend(self._input.read_edge_events())
        except OSError as e:
            raise _line_lost_error(e) from None
        if not self._events:
            return None
        event = self._events.popleft()
        return Edge(event.timestamp_ns, event.line_seqno)

    def close(self) -> None:
        """Release the line."""
        self._input.release()


class GpiodLines(TriggerInput):
    """The trigger input, and a SYNC_IN output that is low from the start.

    When the program dies the kernel releases the line. A pulse is two system calls on the request's descriptor, whose
    arguments are prepared beforehand. Raises DeviceError like :class:`TriggerInput`.
    """

    name: str = GPIOD

    def __init__(self, pi: Pi) -> None:
        self._output = request_output(pi)
        # The return wire, from SYNC_IN to another input: counts the pulses at the connector.
        self._return: Any = None
        self._set = partial(fcntl.ioctl, self._output.fd, SET_VALUES, _VALUES.pack(1, 1))
        self._clear = partial(fcntl.ioctl, self._output.fd, SET_VALUES, _VALUES.pack(0, 1))
        try:
            super().__init__(pi)
            if pi.pulses_in is not None:
                self._return = _request_edges(pi, pi.pulses_in)
        except DeviceError:
            self._output.release()
            raise

    def count_returned(self, sent: int) -> ReturnedPulses | None:
        """Count the rising edges of the return wire since the last call; wait for as many as were sent.

        None without a return wire. Raises DeviceError when the line is lost.
        """
        if self._return is None:
            return None
        pulses = 0
        try:
            # Once more with no time left: a pulse too many counts, too.
            while self._return.wait_edge_events(timedelta(seconds=LOOK_BACK_S if pulses < sent else 0)):
                pulses += len(self._return.read_edge_events())
        except OSError as e:
            raise _line_lost_error(e) from None
        return ReturnedPulses(pulses)

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it.

        After a sleep, one system call without effect brings the code of the pulse back into the processor's caches
        (measured on a busy machine: period errors of 0.8 instead of 5 us).
        """
        if t_ns - time.monotonic_ns() > SPIN_NS + WARM_NS:
            super().sleep_until(t_ns - WARM_NS)
            self._make_pulse(self._clear)
        super().sleep_until(t_ns)

    def pulse(self, width_ns: int) -> tuple[int, int]:
        """Set SYNC_IN and clear it; return the times before and after. Raises DeviceError when the line is lost."""
        return self._make_pulse(self._set, width_ns)

    def measure(self) -> int:
        """Return the duration of a pulse, nanoseconds, without sending one: both system calls leave the line low."""
        begin_ns, end_ns = self._make_pulse(self._clear)
        return end_ns - begin_ns

    def _make_pulse(self, set_line: Callable[[], object], width_ns: int = 0) -> tuple[int, int]:
        """Call `set_line`, wait until `width_ns` has passed, clear the line; return the times before and after.

        Raises DeviceError when the line is lost.
        """
        # Looked up before the line is set: nothing but the two calls is inside a pulse.
        now = time.monotonic_ns
        clear_request = self._clear
        try:
            begin_ns = now()
            set_line()
            if width_ns > TWO_CALLS_NS:
                super().sleep_until(begin_ns + width_ns)
            clear_request()
            return begin_ns, now()
        except OSError as e:
            raise _line_lost_error(e) from None

    def close(self) -> None:
        """Set SYNC_IN low and release the lines."""
        try:
            self._make_pulse(self._clear)
        finally:
            self._output.release()
            if self._return is not None:
                self._return.release()
            super().close()


class SpiDevice:
    """A spidev device whose MOSI is SYNC_IN, low from the start. Raises DeviceError if it is not available.

    The kernel completes a transfer that has begun even if this program is killed; the last bits are low.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        # Bits of MISO during the last transfer, as many as were sent.
        self.received = array.array("B")
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as e:
            raise self._line_error(e) from None
        try:
            try:
                fcntl.ioctl(self._fd, WRITE_MODE, bytes([MODE_NO_CS]))
            except OSError:
                fcntl.ioctl(self._fd, WRITE_MODE, bytes([MODE_0]))
            # A byte of zeros sets MOSI low, at any clock.
            self.transfer(bytes(1), 1_000_000)
        except OSError as e:
            os.close(self._fd)
            raise self._line_error(e) from None
        except DeviceError:
            os.close(self._fd)
            raise

    @property
    def bufsiz(self) -> int:
        """Longest transfer that spidev accepts, bytes."""
        try:
            return int(BUFSIZ_FILE.read_text())
        except (OSError, ValueError):
            return DEFAULT_BUFSIZ

    def transfer(self, data: bytes, clock_hz: int) -> tuple[int, int]:
        """Send the bytes and store those of MISO in `received`; return the times before and after the system call.

        Raises DeviceError.
        """
        buffer = array.array("B", data)
        self.received = array.array("B", bytes(len(data)))
        addresses = buffer.buffer_info()[0], self.received.buffer_info()[0]
        # No delay, words of 8 bits, and the default of every other field.
        message = _TRANSFER.pack(*addresses, len(data), clock_hz, 0, 8, 0, 0, 0, 0, 0)
        try:
            begin_ns = time.monotonic_ns()
            fcntl.ioctl(self._fd, MESSAGE, message)
            return begin_ns, time.monotonic_ns()
        except OSError as e:
            raise self._line_error(e) from None

    def _line_error(self, e: OSError) -> DeviceError:
        unknown = f"the kernel says: {e.strerror}", "look at the kernel's log (dmesg)"
        cause, remedy = _SPI_REASONS.get(e.errno or 0, unknown)
        return DeviceError(f"fault {int(PiFault.TRIGGER_LINE_LOST)}: {self.path}: {e.strerror}", cause, remedy)

    def close(self) -> None:
        """Close the device."""
        os.close(self._fd)


class SpiLines(TriggerInput):
    """The trigger input, and SYNC_IN on MOSI: low before, between and after bursts."""

    name: str = SPI

    def __init__(self, pi: Pi) -> None:
        self._device = SpiDevice(pi.spi_device)
        self.bufsiz = self._device.bufsiz
        self._has_return = pi.pulses_in is not None
        self._seen = ReturnedPulses(0)
        try:
            super().__init__(pi)
        except DeviceError:
            self._device.close()
            raise

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send a burst and count the pulses that MISO receives; return the times before and after. Raises DeviceError.

        The first bit on the wire is the most significant one of `high`, so that `high >> 1` has at each bit the one
        before it in time.
        """
        times = self._device.transfer(burst.data, burst.clock_hz)
        high = int.from_bytes(self._device.received.tobytes(), "big")
        # A pulse begins at a set bit after a clear one.
        starts = high & ~(high >> 1)
        # Each round takes the first bit from every pulse: the longest pulse has as many bits as there are rounds.
        longest = 0
        while high:
            high &= high >> 1
            longest += 1
        width_max_ns = max(self._seen.width_max_ns, round(longest * burst.bit_ns))
        self._seen = ReturnedPulses(self._seen.pulses + starts.bit_count(), width_max_ns)
        return times

    def count_returned(self, sent: int) -> ReturnedPulses | None:  # noqa: ARG002 - MISO was read with the transfers
        """Return the pulses that MISO has received since the last call; None without the wire."""
        returned = self._seen
        self._seen = ReturnedPulses(0)
        if not self._has_return:
            return None
        return returned

    def close(self) -> None:
        """Release the lines; MOSI is low."""
        try:
            self._device.close()
        finally:
            super().close()


# --- simulated wires --------------------------------------------------------------------------------------------------


class WireLines:
    """Lines on simulated wires; `path` is the hub's socket. Raises DeviceError if no hub listens there.

    Wire time is the simulated stage's clock. Here it is the latest of the received edges and of the deadlines slept
    until, so a burst takes no wall time and its pulses are exactly on their deadlines, however busy the machine is.
    """

    name: str = WIRES
    is_real_time = False

    def __init__(self, path: Path, pi: Pi) -> None:
        self.check_width = not pi.one_shot
        self._trigger = pi.trigger_in
        self._output = pi.sync_out[0]
        self._return = pi.pulses_in
        listen = (pi.trigger_in,)
        join = None
        # The simulated wire that returns SYNC_IN, for counting pulses.
        if pi.pulses_in is not None:
            listen += (pi.pulses_in,)
            join = (self._output, pi.pulses_in)
        self._client = WireClient(path, listen=listen, join=join)
        # Trigger edges that were received while waiting for other edges.
        self._waiting: deque[WireEdge] = deque()
        # Wire time.
        self._now_ns = 0
        # Number of the last trigger edge; here none is lost.
        self._seqno = 0
        # Level of SYNC_IN.
        self._active = False
        # Edges of SYNC_IN that the hub has not got yet.
        self._unsent: list[WireEdge] = []

    def now_ns(self) -> int:
        """Return the wire time."""
        return self._now_ns

    def sleep_until(self, t_ns: int) -> None:
        """Advance the wire time; return immediately."""
        self._now_ns = max(self._now_ns, t_ns)

    def wait_edge(self, timeout_s: float) -> Edge | None:
        """Send the edges of the last burst and wait for the next rising edge of the trigger line; None after a timeout.

        Raises DeviceError when the hub is lost.
        """
        self._flush()
        deadline = time.monotonic() + timeout_s
        while not self._waiting and (left_s := deadline - time.monotonic()) > 0:
            message = self._client.receive(left_s)
            if isinstance(message, WireEdge) and message.line == self._trigger and message.value:
                self._waiting.append(message)
        if not self._waiting:
            return None
        edge = self._waiting.popleft()
        self.sleep_until(edge.t_ns)
        self._seqno += 1
        return Edge(edge.t_ns, self._seqno)

    def count_returned(self, sent: int) -> ReturnedPulses | None:
        """Count the pulses that came back since the last call, and measure their widths on the wire; None: no wire."""
        if self._return is None:
            return None
        self._flush()
        rose_ns: list[int] = []
        widths_ns: list[int] = []
        deadline = time.monotonic() + SIMULATED_LOOK_BACK_S
        while len(widths_ns) < sent and (left_s := deadline - time.monotonic()) > 0:
            message = self._client.receive(left_s)
            if not isinstance(message, WireEdge):
                continue
            if message.line == self._trigger and message.value:
                self._waiting.append(message)
            elif message.line == self._return and message.value:
                rose_ns.append(message.t_ns)
            elif message.line == self._return and rose_ns:
                widths_ns.append(message.t_ns - rose_ns[-1])
        return ReturnedPulses(len(rose_ns), max(widths_ns, default=0))

    def pulse(self, width_ns: int) -> tuple[int, int]:
        """Send a pulse, starting now; return its times."""
        begin_ns = self._now_ns
        self._set_output(True)
        self.sleep_until(begin_ns + width_ns)
        self._set_output(False)
        return begin_ns, self._now_ns

    def _set_output(self, active: bool) -> None:
        if active != self._active:
            self._active = active
            self._unsent.append(WireEdge(self._now_ns, self._output, int(active)))

    def _flush(self) -> None:
        if self._unsent:
            self._client.send(*self._unsent)
            self._unsent.clear()

    def close(self) -> None:
        """Set the output low and disconnect from the hub."""
        try:
            self._set_output(False)
            self._flush()
        finally:
            self._client.close()


class SpiWireLines(WireLines):
    """Simulated wires whose SYNC_IN is MOSI: the bits of a transfer become edges at the wire time of their bit."""

    bufsiz = DEFAULT_BUFSIZ

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Make the edges of a transfer, most significant bit first; return the wire times before and after.

        The line keeps the level of the last bit.
        """
        begin_ns = self._now_ns
        for i, byte in enumerate(burst.data):
            if byte or self._active:
                for k in range(8):
                    self._now_ns = begin_ns + round((8 * i + k) * burst.bit_ns)
                    self._set_output(bool(byte << k & 0x80))
        self._now_ns = begin_ns + round(burst.duration_ns)
        return begin_ns, self._now_ns
