"""A stage driver without a stage, and trigger lines on a clock that tests turn."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any

from polysight_pi.trigger import Edge
from polysight_shared.config import Stage
from polysight_shared.errors import DeviceError
from polysight_shared.stage_line import Immediate, Reply


class FakeDriver:
    """Accepts every command and keeps the bytes sent."""

    def __init__(self) -> None:
        self.config = Stage("none")
        self.sent: list[Immediate] = []
        self.x_mm = self.y_mm = 0.0
        self.firmware = "fake"
        self.number = 0
        self.link = self  # what it asks of an open link

    def connect(self) -> None: ...
    def clear(self) -> None: ...
    def at_rest(self) -> None: ...
    def repeat(self) -> None: ...
    def note_position(self, _: Reply) -> None: ...

    def send_byte(self, byte: Immediate) -> None:
        self.sent.append(byte)

    def home(self) -> int:
        self.number += 1
        return self.number

    def row(self, *_: Any) -> int:
        self.number += 1
        return self.number


class FakeLines:
    """`late(n)`: how late the n-th sleep ends; `long(n)`: how long the n-th change of the output takes; nanoseconds."""

    name = "fake"

    def __init__(self, late: Callable[[int], int] = lambda _: 0, long: Callable[[int], int] = lambda _: 0) -> None:
        self.t, self.late, self.long = 0, late, long
        self.check_width = True
        self.sleeps = 0
        self.changes: list[tuple[int, bool]] = []
        self.level = False
        self.closed = False
        self.edges: queue.SimpleQueue[Edge | Exception] = queue.SimpleQueue()

    def now_ns(self) -> int:
        return self.t

    def sleep_until(self, t_ns: int) -> None:
        if t_ns > self.t:
            self.t = t_ns + self.late(self.sleeps)
            self.sleeps += 1

    def wait_edge(self, timeout_s: float) -> Edge | None:
        try:
            edge = self.edges.get(timeout=min(timeout_s, 0.01))
        except queue.Empty:
            return None
        if isinstance(edge, Exception):
            raise edge
        self.t = max(self.t, edge.t_ns)
        return edge

    def pulse(self, width_ns: int) -> tuple[int, int]:
        rise = self.t
        self.set_output(True)
        self.sleep_until(rise + width_ns)
        self.set_output(False)
        return rise, self.t

    def set_output(self, active: bool) -> None:
        self.t += self.long(len(self.changes))
        self.changes.append((self.t, active))
        self.level = active

    def close(self) -> None:
        self.set_output(False)
        self.closed = True

    @property
    def rises(self) -> list[int]:
        return [t for t, active in self.changes if active]


def gone() -> DeviceError:
    return DeviceError("the chip vanished")
