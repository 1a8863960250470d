"""Trigger lines on a clock that tests turn, with lateness and interruptions on request."""

from __future__ import annotations

import queue
from collections.abc import Callable

from polysight.pi_controller.bursts import Edge
from polysight.shared.errors import DeviceError


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
