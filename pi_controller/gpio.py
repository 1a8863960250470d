"""Lines of the Raspberry Pi through libgpiod v2. Runs on any Linux GPIO chip; never run on a Pi by this project yet."""

from __future__ import annotations

import errno
import fcntl
import struct
import time
from collections import deque
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from polysight.pi_controller.lines import Clock, Edge
from polysight.shared.config import Pi
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.faults import PiFault
from polysight.shared.messages import GPIOD

# The kernel keeps 16 events a line unless asked for more; a starved process would lose edges.
EVENT_BUFFER = 1024
# A sleep may end this much late, or more; the rest of a wait is spent looking at the clock.
SPIN_NS = 100_000
WARM_NS = 30_000
TWO_CALLS_NS = 1000  # a pulse not wanted longer is as short as two system calls make it
SET_VALUES = 0xC010B40F  # GPIO_V2_LINE_SET_VALUES_IOCTL of <linux/gpio.h>, and its argument: bits, mask
_VALUES = struct.Struct("=QQ")
CONSUMER = "polysight"
_NO_PERMISSION = ("no permission", "add the user to the group gpio; the udev rule 60-polysight.rules gives it the chip")
_REASONS = {
    errno.EBUSY: ("it is in use", "end that program; `systemctl stop polysight-pi` when it is polysight itself"),
    errno.EACCES: _NO_PERMISSION,
    errno.EPERM: _NO_PERMISSION,
    errno.ENOENT: ("there is no such device", "set pi.gpio_chip in instrument.toml to a label or path that exists"),
    errno.EINVAL: ("the chip has no such line, or cannot set it so", "correct [pi] in instrument.toml (see gpioinfo)"),
    errno.ENXIO: ("the chip reports no edges on this line", "use a line of the Pi's own header as pi.trigger_in"),
    errno.ENODEV: ("the chip is gone", "look at the kernel's log (dmesg)"),
}


def load_gpiod() -> ModuleType:
    """The gpiod module. Raises ConfigError when it is absent or the old v1 API."""
    try:
        import gpiod
    except ImportError:
        raise ConfigError(
            "the Python package gpiod is not installed",
            "GPIO needs the libgpiod bindings",
            "pip install 'gpiod>=2.1', or run with --wires on simulated wires",
        ) from None
    if not hasattr(gpiod, "request_lines"):
        raise ConfigError(
            "the Python package gpiod has the old v1 API",
            "it comes from the distribution's packages",
            "pip install 'gpiod>=2.1' into the program's own environment",
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


def trigger_settings(pi: Pi, gpiod: Any) -> Any:
    """Settings of the trigger input: rising edges, stamped by the kernel with CLOCK_MONOTONIC, bias, debouncing."""
    line = gpiod.line
    return gpiod.LineSettings(
        direction=line.Direction.INPUT,
        edge_detection=line.Edge.RISING,
        bias=line.Bias[pi.trigger_bias.upper().replace("-", "_")],
        debounce_period=timedelta(microseconds=pi.trigger_debounce_us),
        event_clock=line.Clock.MONOTONIC,
    )


def output_settings(gpiod: Any) -> Any:
    """Settings of SYNC_IN lines: outputs, low from the start."""
    line = gpiod.line
    return gpiod.LineSettings(direction=line.Direction.OUTPUT, output_value=line.Value.INACTIVE)


def request(gpiod: Any, path: str, lines: tuple[int, ...], settings: Any, buffer: int | None = None) -> Any:
    """Request lines of a chip, all in one. Raises DeviceError with the reason in plain words."""
    try:
        return gpiod.request_lines(path, {lines: settings}, consumer=CONSUMER, event_buffer_size=buffer)
    except (OSError, ValueError) as e:
        number = e.errno if isinstance(e, OSError) else errno.EINVAL
        why, remedy = _REASONS.get(number or 0, (f"the kernel says: {e}", "gpioinfo shows what the chip can do"))
        if number == errno.EBUSY:
            why = _holders(gpiod, path, lines)
        where = f"GPIO line {', '.join(map(str, lines))} of {path}"
        raise DeviceError(f"fault {int(PiFault.TRIGGER_LINE_LOST)}: {where}: {why}", str(e), remedy) from None


def _holders(gpiod: Any, path: str, lines: tuple[int, ...]) -> str:
    held = []
    with gpiod.Chip(path) as chip:
        for n in lines:
            info = chip.get_line_info(n)
            if info.used:
                held.append(f"line {n} is held by {info.consumer!r}")
    return ", ".join(held) or "a line was held a moment ago"


class MonotonicClock:
    """CLOCK_MONOTONIC, the clock of the kernel's edge time stamps."""

    def now_ns(self) -> int:
        """The time."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Sleep most of the way, watch the clock for the rest."""
        left = t_ns - time.monotonic_ns() - SPIN_NS
        if left > 0:
            time.sleep(left * 1e-9)
        while time.monotonic_ns() < t_ns:
            pass


class TriggerInput:
    """The trigger input: rising edges with kernel time stamps, on their clock.

    `gpiod` is the module, or a stand-in; `chip_path` replaces the search for the configured label.

    Raises DeviceError when the chip or the line cannot be had.
    """

    def __init__(self, pi: Pi, gpiod: Any, chip_path: str | None = None, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        self.now_ns = self._clock.now_ns
        self._events: deque[Any] = deque()
        path = chip_path or find_chip(pi.gpio_chip, gpiod)
        self._input = request(gpiod, path, (pi.trigger_in,), trigger_settings(pi, gpiod), EVENT_BUFFER)

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it."""
        self._clock.sleep_until(t_ns)

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

    def flush(self) -> None:
        """Nothing is buffered."""

    def close(self) -> None:
        """Release the line."""
        self._input.release()


class GpiodLines(TriggerInput):
    """The trigger input, and SYNC_IN outputs that are low from the start and, through the kernel, after this program.

    `wiring = "lines"` drives several outputs in one request; the kernel writes them one after another. A pulse is two
    system calls on the request's descriptor, prepared beforehand (`ioctl`: a stand-in's). Other parameters and errors
    are those of :class:`TriggerInput`.
    """

    name: str = GPIOD

    def __init__(
        self,
        pi: Pi,
        gpiod: Any,
        chip_path: str | None = None,
        clock: Clock | None = None,
        ioctl: Callable[..., object] = fcntl.ioctl,
    ) -> None:
        path = chip_path or find_chip(pi.gpio_chip, gpiod)
        self._output = request(gpiod, path, pi.sync_out, output_settings(gpiod))
        all_lines = (1 << len(pi.sync_out)) - 1
        self._set = partial(ioctl, self._output.fd, SET_VALUES, _VALUES.pack(all_lines, all_lines))
        self._clear = partial(ioctl, self._output.fd, SET_VALUES, _VALUES.pack(0, all_lines))
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
        """Set all SYNC_IN lines and clear them; the times before and after. Raises DeviceError when they are gone.

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
        """Time that :meth:`pulse` takes when both of its calls leave the lines low, nanoseconds."""
        before, after = self.pulse(0, self._clear)
        return after - before

    def close(self) -> None:
        """Outputs low, lines released."""
        try:
            self.pulse(0, self._clear)
        finally:
            self._output.release()
            super().close()


def _gone(e: OSError) -> DeviceError:
    return DeviceError(
        f"GPIO lines are gone: {e.strerror}", "the chip vanished or its driver was unloaded", "`polysight-pi check`"
    )
