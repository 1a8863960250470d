"""A stand-in for the part of gpiod v2 that is used, on a turned clock.

Enums and LineSettings are the real ones, so that a misspelt or impossible setting fails here too.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import gpiod as real
from gpiod import line

SET_VALUES = 3 << 30 | 16 << 16 | 0xB4 << 8 | 0x0F  # <linux/gpio.h>: _IOWR(0xB4, 0x0F, two 64-bit words)


class FakeChip:
    def __init__(self, path: str = "/dev/gpiochip0", lines: int = 28, label: str = "pinctrl-bcm2835") -> None:
        self.path, self.label = path, label
        self.level = [0] * lines
        self.owner: list[Any] = [None] * lines
        self.log: list[tuple[int, int, int]] = []
        self.t = 0
        self.vanished = False

    def now_ns(self) -> int:
        return self.t

    def sleep_until(self, t_ns: int) -> None:
        self.t = max(self.t, t_ns)

    def ioctl(self, fd: int, what: int, values: bytes) -> None:
        """Set or clear lines of the request with this descriptor: bit n is its n-th line."""
        assert what == SET_VALUES
        bits, mask = struct.unpack("=QQ", values)
        (request,) = {r for r in self.owner if r and r.fd == fd}
        assert mask == (1 << len(request.settings)) - 1
        request.set_values({n: line.Value(bits >> i & 1) for i, n in enumerate(request.settings)})

    def drive(self, n: int, value: int, t_ns: int) -> None:
        """The outside world drives an input."""
        self.t = max(self.t, t_ns)
        if self.level[n] != value:
            self.level[n] = value
            if self.owner[n]:
                self.owner[n].on_edge(n, value, t_ns)

    @property
    def module(self) -> SimpleNamespace:
        return SimpleNamespace(
            line=line, LineSettings=real.LineSettings, request_lines=self.request_lines, Chip=self.open
        )

    @contextmanager
    def open(self, path: str) -> Iterator[FakeChip]:
        assert path == self.path
        yield self

    def get_line_info(self, n: int) -> SimpleNamespace:
        return SimpleNamespace(used=bool(self.owner[n]), consumer="polysight")

    def request_lines(self, path: str, config: Any, consumer: str, event_buffer_size: Any = None) -> FakeRequest:
        assert consumer
        if path != self.path:
            raise FileNotFoundError(2, "No such file or directory")
        return FakeRequest(self, config, event_buffer_size)


class FakeRequest:
    def __init__(self, chip: FakeChip, config: dict[Any, real.LineSettings], buffer: int | None) -> None:
        self.fd = id(self)
        self.chip, self.settings = chip, {n: s for key, s in config.items() for n in key}
        self.events: deque[Any] = deque()
        self.capacity, self.seq = buffer or 16 * len(self.settings), 0
        for n, s in self.settings.items():
            if n >= len(chip.level):
                raise ValueError("line offset out of range")
            if chip.owner[n]:
                raise OSError(16, "Device or resource busy")
            if s.direction == line.Direction.OUTPUT:
                chip.level[n] = s.output_value.value
        for n in self.settings:
            chip.owner[n] = self

    def on_edge(self, n: int, value: int, t_ns: int) -> None:
        wanted = self.settings[n].edge_detection
        if wanted == line.Edge.BOTH or wanted == (line.Edge.RISING if value else line.Edge.FALLING):
            self.seq += 1
            if len(self.events) >= self.capacity:
                self.events.popleft()  # the kernel drops the oldest
            self.events.append(SimpleNamespace(timestamp_ns=t_ns, line_offset=n, line_seqno=self.seq))

    def _alive(self) -> None:
        if self.chip.vanished:
            raise OSError(19, "No such device")

    def wait_edge_events(self, timeout: timedelta) -> bool:
        assert timeout >= timedelta(0)
        self._alive()
        return bool(self.events)

    def read_edge_events(self, max_events: int | None = None) -> list[Any]:
        return [self.events.popleft() for _ in range(min(len(self.events), max_events or 64))]

    def set_values(self, values: dict[int, line.Value]) -> None:
        self._alive()
        for n, v in values.items():
            if self.settings[n].direction != line.Direction.OUTPUT:
                raise PermissionError(1, "Operation not permitted")
            if self.chip.level[n] != v.value:
                self.chip.level[n] = v.value
                self.chip.log.append((self.chip.t, n, v.value))

    def release(self) -> None:
        for n, s in self.settings.items():
            self.chip.owner[n] = None
            if s.direction == line.Direction.OUTPUT:
                self.chip.level[n] = 0
