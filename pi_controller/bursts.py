"""Bursts: the SYNC_IN pulses of one position, made one by one or clocked out as the bits of one SPI transfer.

The radar starts one frame on each rising edge. It takes pulses of 25 ns .. 4 us, and frames at least 300 us apart; an
early pulse is a fatal fault of its RF core (TI mmWave Radar Interface Control, frame configuration). So the spacing is
checked before a pulse is made, and the width after.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

from polysight.shared.config import Burst
from polysight.shared.errors import ConfigError
from polysight.shared.faults import PiFault
from polysight.shared.raster import MAX_WIDTH_NS, MIN_PERIOD_NS
from polysight.shared.units import us_to_ns

FASTEST_HZ, SLOWEST_HZ = 2_000_000, 500_000  # SPI clock for pulses of 0.5 .. 2 us
LEAD_BITS = 8  # low bits before the first pulse, and at least so many behind the last: the line idles as the last bit
SHORTEST_BYTES = 96  # below it spi-bcm2835 writes byte by byte, with gaps; from it on it uses DMA
DEFAULT_BUFSIZ = 4096
SHORTEST_PART = 0.98  # a transfer that is over sooner was clocked too fast: the frames came too soon


class Edge(NamedTuple):
    """A rising edge of the trigger line. A `seqno` that is not the last one + 1 is a lost edge."""

    t_ns: int  # on the clock of the lines
    seqno: int


class BurstSpec(NamedTuple):
    """Pulses of a position."""

    pulses: int
    period_ns: int
    width_ns: int

    @staticmethod
    def of(burst: Burst) -> BurstSpec:
        """From the rig file."""
        return BurstSpec(burst.pulses, us_to_ns(burst.period_us), us_to_ns(burst.width_us))


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


class BurstRecord(NamedTuple):
    """What was sent."""

    pulses: int
    first_ns: int  # rising edge of the first pulse: the time read just before the line was set
    last_ns: int
    end_ns: int  # when the last pulse was over
    width_max_ns: int = 0  # upper bound: from before the line was set until after it was cleared
    jitter_ns: int = 0  # largest lateness of a rising edge against its deadline
    fault: int = 0  # number of what went wrong


class _Lines(Protocol):
    """Trigger input and SYNC_IN (lines.py, sim_lines.py). Methods raise DeviceError when the lines are gone."""

    name: str
    check_width: bool  # a pulse that may have been too long is a fault: no hardware one-shot makes the width

    def now_ns(self) -> int:
        """The time base of edges and pulses, nanoseconds."""
        ...

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it."""
        ...

    def wait_edge(self, limit_s: float) -> Edge | None:
        """The next rising edge of the trigger line, or None when none came within `limit_s` of wall time."""
        ...

    def close(self) -> None:
        """SYNC_IN low, lines released."""
        ...


class PulseLines(_Lines, Protocol):
    """Lines whose pulses this program makes, one by one."""

    def pulse(self, width_ns: int) -> tuple[int, int]:
        """Set SYNC_IN and clear it, `width_ns` later or as soon as can be; the times before and after."""
        ...


@runtime_checkable
class BitLines(_Lines, Protocol):
    """Lines whose bursts an SPI controller clocks out, each in one piece of at most `bufsiz` bytes."""

    bufsiz: int

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send a burst; the times before and after."""
        ...


Lines = PulseLines | BitLines


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


def send_burst(
    lines: Lines,
    spec: BurstSpec,
    start_ns: int,
    previous_rise_ns: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> BurstRecord:
    """Send the pulses at `start_ns + k * period`, k = 0 .. pulses - 1.

    When `start_ns` has passed already, all deadlines move with the first pulse: the period matters, not the phase. They
    are computed from the first, so that lateness of one pulse never shifts the next.

    `previous_rise_ns` is the last rising edge before this burst; `stop` is asked before each pulse, or transfer, and
    ends the burst early. The record's fault is PERIOD_TOO_SHORT when a pulse was left out that would have come too
    early for the radar, PULSE_TOO_LONG when one may have been longer than 4 us.
    """
    if isinstance(lines, BitLines):
        return _send_bits(lines, spec, start_ns, previous_rise_ns, stop)
    start_ns = max(start_ns, lines.now_ns())
    sent = width_max = jitter = fault = 0
    first = last = end = start_ns
    for k in range(spec.pulses):
        if stop():
            break
        deadline = start_ns + k * spec.period_ns
        lines.sleep_until(deadline)
        if previous_rise_ns is not None and lines.now_ns() - previous_rise_ns < MIN_PERIOD_NS:
            fault = PiFault.PERIOD_TOO_SHORT
            break
        last, end = lines.pulse(spec.width_ns)
        previous_rise_ns, first = last, last if k == 0 else first
        sent += 1
        jitter = max(jitter, last - deadline)
        width_max = max(width_max, end - last)
        if lines.check_width and end - last > MAX_WIDTH_NS:
            fault = PiFault.PULSE_TOO_LONG
            break
    return BurstRecord(sent, first, last, end, width_max, jitter, int(fault))


def _send_bits(
    lines: BitLines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """Send the burst as one transfer; once begun it goes to its end.

    The clock is measured by each transfer: a bit lasts at most the time that the system call took, by the number of its
    bits. A clock that is not the one asked for (a Pi whose core clock changes) is a fault before it spoils a scan.
    """
    burst = spi_burst(spec, lines.bufsiz)
    lead_ns = round(burst.bits[0] * burst.bit_ns)
    begin_ns = max(start_ns - lead_ns, lines.now_ns())
    if previous_rise_ns is not None and begin_ns + lead_ns - previous_rise_ns < MIN_PERIOD_NS:
        return BurstRecord(0, start_ns, start_ns, start_ns, fault=int(PiFault.PERIOD_TOO_SHORT))
    lines.sleep_until(begin_ns)
    if stop():
        return BurstRecord(0, start_ns, start_ns, start_ns)
    before_ns, after_ns = lines.transfer(burst)
    took_ns = after_ns - before_ns
    spare_ns = max(0, took_ns - round(burst.duration_ns))  # somewhere in it the controller began
    first_ns = before_ns + spare_ns // 2 + lead_ns
    last_ns = first_ns + round((burst.bits[-1] - burst.bits[0]) * burst.bit_ns)
    width_ns = round(max(burst.bit_ns, took_ns / (8 * len(burst.data))))
    jitter_ns = before_ns - begin_ns + (spare_ns + 1) // 2
    if spec.period_ns * burst.clock_hz % 10**9:  # pulses lie up to half a bit beside their places
        jitter_ns += round(burst.bit_ns / 2)
    fault = 0
    if took_ns < SHORTEST_PART * burst.duration_ns:
        fault = int(PiFault.PERIOD_TOO_SHORT)
    elif lines.check_width and width_ns > MAX_WIDTH_NS:
        fault = int(PiFault.PULSE_TOO_LONG)
    return BurstRecord(spec.pulses, first_ns, last_ns, after_ns, width_ns, jitter_ns, fault)


def send_bench(
    lines: Lines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """The same for pulses that no edge asks for: as many transfers as the lines' buffer makes of them.

    The pause between two transfers is at least a period; how exact it is the record's jitter does not say.
    """
    part = spec
    while isinstance(lines, BitLines) and part.pulses > 1:
        try:
            spi_burst(part, lines.bufsiz)
            break
        except ConfigError:
            part = part._replace(pulses=-(-part.pulses // 2))
    total = send_burst(lines, part, start_ns, previous_rise_ns, stop)
    while 0 < total.pulses < spec.pulses and not total.fault and not stop():
        part = part._replace(pulses=min(part.pulses, spec.pulses - total.pulses))
        more = send_burst(lines, part, total.last_ns + spec.period_ns, total.last_ns, stop)
        if not more.pulses:
            return total._replace(fault=more.fault)
        total = more._replace(
            pulses=total.pulses + more.pulses, first_ns=total.first_ns,
            width_max_ns=max(total.width_max_ns, more.width_max_ns), jitter_ns=max(total.jitter_ns, more.jitter_ns),
        )  # fmt: skip
    return total


def send_bursts(lines: Lines, spec: BurstSpec, bursts: int, pause_ns: int) -> list[BurstRecord]:
    """Send bursts without a stage, `pause_ns` after one another."""
    sent: list[BurstRecord] = []
    for _ in range(bursts):
        sent.append(send_burst(lines, spec, (sent[-1].end_ns if sent else lines.now_ns()) + pause_ns))
    return sent
