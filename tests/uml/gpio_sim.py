"""A simulated GPIO chip of the kernel (gpio-sim): inputs driven from outside, and every setting of its outputs."""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import gpiod

CONFIG = Path("/sys/kernel/config/gpio-sim/chip")
DEVICES = Path("/sys/devices/platform")
TRACING = Path("/sys/kernel/tracing")
PAGE_BYTES = 4096
# Kinds of entries in the kernel's ring buffer (Linux, include/linux/ring_buffer.h). Smaller numbers than these are the
# length of an event's payload in words of 4 bytes; 0: the length follows.
PADDING = 29
TIME_EXTEND = 30
TIME_STAMP = 31
# Bits of the time in an entry's first word.
TIME_BITS = 27


class Change(NamedTuple):
    """A line was set; `t_ns` is the kernel's, on CLOCK_MONOTONIC."""

    t_ns: int
    line: int
    value: int


class SimChip:
    """A chip with this label, and a record of every line that is set on it."""

    def __init__(self, label: str, lines: int) -> None:
        bank = CONFIG / "bank0"
        bank.mkdir(parents=True)
        (bank / "num_lines").write_text(str(lines))
        (bank / "label").write_text(label)
        (CONFIG / "live").write_text("1")
        name = (bank / "chip_name").read_text().strip()
        self._folder = DEVICES / (CONFIG / "dev_name").read_text().strip() / name
        self._pulls: dict[int, int] = {}
        (TRACING / "trace_clock").write_text("mono")
        (TRACING / "buffer_size_kb").write_text("8192")
        (TRACING / "events/gpio/gpio_value/enable").write_text("1")
        self._trace = os.open(TRACING / "per_cpu/cpu0/trace_pipe_raw", os.O_RDONLY | os.O_NONBLOCK)
        # The record has the kernel's global numbers: the chip's first line says where they begin.
        output = gpiod.LineSettings(direction=gpiod.line.Direction.OUTPUT)
        with gpiod.request_lines(f"/dev/{name}", {0: output}) as request:
            request.set_value(0, gpiod.line.Value.INACTIVE)
        self._base = 0
        self._base = next(self.changes()).line

    def pull(self, line: int, high: bool) -> None:
        """Drive an input: its edge becomes an event."""
        if line not in self._pulls:
            self._pulls[line] = os.open(self._folder / f"sim_gpio{line}/pull", os.O_WRONLY)
        os.pwrite(self._pulls[line], b"pull-up" if high else b"pull-down", 0)

    def value(self, line: int) -> int:
        """The level of a line now."""
        return int((self._folder / f"sim_gpio{line}/value").read_text())

    def changes(self) -> Iterator[Change]:
        """Every setting of a line since the last call, from the kernel's trace event gpio_value."""
        while page := self._page():
            for t_ns, payload in _parse_events(page):
                number, get, value = struct.unpack_from("<Iii", payload, 8)
                if not get:
                    yield Change(t_ns, number - self._base, value)

    def _page(self) -> bytes:
        try:
            return os.read(self._trace, PAGE_BYTES)
        except BlockingIOError:
            return b""


def _parse_events(page: bytes) -> Iterator[tuple[int, bytes]]:
    """Time and payload of the events of a page of the ring buffer (Linux, Documentation/trace/ring-buffer-design)."""
    t_ns, committed = struct.unpack_from("<QQ", page)
    position = 16
    end = 16 + (committed & 0xFFFFFFFF)
    while position < end:
        head, word = struct.unpack_from("<II", page, position)
        kind = head & 31
        low_bits_ns = head >> 5
        position += 4
        if kind == PADDING:
            return
        if kind == TIME_STAMP:
            t_ns = low_bits_ns | word << TIME_BITS
            position += 4
            continue
        if kind == TIME_EXTEND:
            # More than 2^27 ns have passed since the last event: the next word has the upper bits.
            t_ns += low_bits_ns | word << TIME_BITS
            position += 4
            continue
        t_ns += low_bits_ns
        if kind:
            length = 4 * kind
        else:
            # The second word is the length of the payload and of itself.
            length = word - 4
            position += 4
        yield t_ns, page[position : position + length]
        position += length
