"""What the trigger loop needs of the lines and their clock.

Backends: lines_gpiod.py (GPIO), lines_spi.py (bursts by an SPI controller) and lines_wires.py (simulated wires).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from polysight.pi_controller.spi_pulses import SpiBurst


class Edge(NamedTuple):
    """A rising edge of the trigger line.

    `t_ns` is on the clock of the lines. `seqno` counts the edges of this line: a step of more than one is a lost edge.
    """

    t_ns: int
    seqno: int


class Clock(Protocol):
    """The time base of edges and pulses, nanoseconds."""

    def now_ns(self) -> int:
        """The time."""
        ...

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it."""
        ...


class TriggerLines(Clock, Protocol):
    """Trigger input and SYNC_IN outputs. Every method raises DeviceError when the lines are gone."""

    name: str

    def wait_edge(self, limit_s: float) -> Edge | None:
        """The next rising edge of the trigger line, or None when none came within `limit_s` of wall time."""
        ...

    def set_output(self, active: bool) -> None:
        """Set all SYNC_IN lines."""
        ...

    def flush(self) -> None:
        """Make sure that what was set has left this process. Called when a burst has ended."""
        ...

    def close(self) -> None:
        """Outputs low, lines released."""
        ...


@runtime_checkable
class BitLines(TriggerLines, Protocol):
    """Lines whose bursts hardware clocks out, each in one piece."""

    bufsiz: int

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send a burst; the times before and after. Raises DeviceError."""
        ...
