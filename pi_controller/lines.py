"""Interfaces of the trigger lines, and a burst as the bits of one SPI transfer.

Backends: gpio.py (libgpiod), spi.py (bursts by an SPI controller), sim_lines.py (simulated wires).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

from polysight.shared.config import Burst
from polysight.shared.errors import ConfigError
from polysight.shared.units import us_to_ns

FASTEST_HZ, SLOWEST_HZ = 2_000_000, 500_000  # pulses of 0.5 .. 2 us: within what the radar takes, 25 ns .. 4 us
LEAD_BITS = 8  # low bits before the first pulse, and at least so many behind the last: the line idles as the last bit
SHORTEST_BYTES = 96  # below it spi-bcm2835 writes byte by byte, with gaps; from it on it uses DMA
DEFAULT_BUFSIZ = 4096


class Edge(NamedTuple):
    """A rising edge of the trigger line. A `seqno` that is not the last one + 1 is a lost edge."""

    t_ns: int  # on the clock of the lines
    seqno: int


class BurstSpec(NamedTuple):
    """Pulses of a position; `check_width` is off when a hardware one-shot makes the width."""

    pulses: int
    period_ns: int
    width_ns: int
    check_width: bool = True

    @staticmethod
    def of(burst: Burst, check_width: bool = True) -> BurstSpec:
        """From the rig file."""
        return BurstSpec(burst.pulses, us_to_ns(burst.period_us), us_to_ns(burst.width_us), check_width)


class SpiBurst(NamedTuple):
    """One burst as one SPI transfer: MOSI is SYNC_IN, one set bit a pulse, within half a bit of its place."""

    data: bytes  # most significant bit first
    clock_hz: int
    bits: tuple[int, ...]  # place of each pulse

    @property
    def bit_ns(self) -> float:
        """Length of a bit, and of a pulse."""
        return 1e9 / self.clock_hz

    @property
    def duration_ns(self) -> float:
        """Length of the transfer."""
        return 8 * len(self.data) * self.bit_ns


@lru_cache(maxsize=16)
def spi_burst(spec: BurstSpec, bufsiz: int = DEFAULT_BUFSIZ) -> SpiBurst:
    """The transfer that is a burst, for a spidev that takes `bufsiz` bytes.

    The clock is one bit a width, within SLOWEST_HZ .. FASTEST_HZ; SLOWEST_HZ where the burst would not fit otherwise.

    Raises
    ------
    ConfigError
        when it does not fit even then, with the bufsiz that it needs and where to set it.
    """
    size = 0
    for clock_hz in (min(max(round(1e9 / spec.width_ns), SLOWEST_HZ), FASTEST_HZ), SLOWEST_HZ):
        bits = tuple(LEAD_BITS + round(k * spec.period_ns * clock_hz / 1e9) for k in range(spec.pulses))
        size = max(SHORTEST_BYTES, (bits[-1] + LEAD_BITS) // 8 + 1)
        if size <= bufsiz:
            data = bytearray(size)
            for bit in bits:
                data[bit // 8] |= 0x80 >> bit % 8
            return SpiBurst(bytes(data), clock_hz, bits)
    room = max(4096, 1 << (size - 1).bit_length())
    raise ConfigError(
        f"a burst of {spec.pulses} pulses every {spec.period_ns / 1e3:g} us takes an SPI transfer of {size} bytes,"
        f" spidev {bufsiz}",
        "its buffer is 4096 bytes unless it is told otherwise",
        f"write `options spidev bufsiz={room}` into /etc/modprobe.d/spidev.conf (a kernel with spidev built in:"
        f" `spidev.bufsiz={room}` in /boot/firmware/cmdline.txt), and start the Pi again; or fewer pulses",
    )


class Clock(Protocol):
    """The time base of edges and pulses, nanoseconds."""

    def now_ns(self) -> int:
        """The time."""
        ...

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it."""
        ...


class _Lines(Clock, Protocol):
    """Trigger input and SYNC_IN. Every method raises DeviceError when the lines are gone."""

    name: str

    def wait_edge(self, limit_s: float) -> Edge | None:
        """The next rising edge of the trigger line, or None when none came within `limit_s` of wall time."""
        ...

    def flush(self) -> None:
        """Make sure that what was set has left this process. Called when a burst has ended."""
        ...

    def close(self) -> None:
        """Outputs low, lines released."""
        ...


class PulseLines(_Lines, Protocol):
    """Lines whose pulses this program makes, one by one."""

    def pulse(self, width_ns: int) -> tuple[int, int]:
        """Set all SYNC_IN lines and clear them, `width_ns` later or as soon as can be; the times before and after."""
        ...


@runtime_checkable
class BitLines(_Lines, Protocol):
    """Lines whose bursts hardware clocks out, each in one piece."""

    bufsiz: int

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send a burst; the times before and after. Raises DeviceError."""
        ...


TriggerLines = PulseLines | BitLines
