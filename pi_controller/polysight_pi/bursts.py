"""Bursts: the SYNC_IN pulses of one position, sent one by one or as the bits of one SPI transfer.

The radar starts one frame on each rising edge. It accepts pulses of 25 ns .. 4 us and needs at least 300 us between
frames; an early pulse is a fatal fault of its RF core (TI mmWave Radar Interface Control, frame configuration).
So the spacing is checked before each pulse, and the width after it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError
from polysight_shared.faults import PiFault
from polysight_shared.raster import MAX_WIDTH_NS, MIN_PERIOD_NS, Burst
from polysight_shared.units import us_to_ns

MAX_HZ, MIN_HZ = 2_000_000, 500_000  # SPI clock for pulses of 0.5 .. 2 us
LEAD_BITS = 8  # low bits before the first pulse, and at least as many after the last: MOSI keeps the last bit's level
MIN_BYTES = 96  # shorter transfers have gaps: spi-bcm2835 writes them byte by byte, longer ones by DMA
DEFAULT_BUFSIZ = 4096
MIN_PART = 0.98  # of the nominal duration; a shorter transfer was clocked too fast, its frames too close


class Edge(NamedTuple):
    """A rising edge of the trigger line; a gap in `seqno` means lost edges."""

    t_ns: int  # on the clock of the lines
    seqno: int


class BurstSpec(NamedTuple):
    """Number, period and width of the pulses at one position."""

    pulses: int
    period_ns: int
    width_ns: int

    @staticmethod
    def of(burst: Burst) -> BurstSpec:
        """Return the burst of the rig file."""
        return BurstSpec(burst.pulses, us_to_ns(burst.period_us), us_to_ns(burst.width_us))


class SpiBurst(NamedTuple):
    """A burst as one SPI transfer on MOSI: each pulse is one set bit, within half a bit of its exact time."""

    data: bytes  # most significant bit first
    clock_hz: int
    bits: tuple[int, ...]  # index of each set bit

    @property
    def bit_ns(self) -> float:
        """Duration of a bit, which is the pulse width."""
        return 1e9 / self.clock_hz

    @property
    def duration_ns(self) -> float:
        """Duration of the transfer."""
        return 8 * len(self.data) * self.bit_ns


class BurstRecord(NamedTuple):
    """Result of sending a burst."""

    pulses: int
    first_ns: int  # rising edge of the first pulse: the clock just before the line was set
    last_ns: int
    end_ns: int  # end of the last pulse
    width_max_ns: int = 0  # upper bound: from before the line was set until after it was cleared
    jitter_ns: int = 0  # largest delay of a rising edge after its deadline
    fault: int = 0  # PiFault; 0: none


class _Lines(Protocol):
    """Trigger input and SYNC_IN output (lines.py, sim_lines.py). Methods raise DeviceError when the lines are lost."""

    name: str
    check_width: bool  # True without a hardware one-shot: a pulse that may have been too long is a fault

    def now_ns(self) -> int:
        """Return the time on the clock of edges and pulses, nanoseconds."""
        ...

    def sleep_until(self, t_ns: int) -> None:
        """Return at `t_ns`, never before it."""
        ...

    def wait_edge(self, timeout_s: float) -> Edge | None:
        """Return the next rising edge of the trigger line, or None after a timeout of `timeout_s` (wall time)."""
        ...

    def close(self) -> None:
        """Set SYNC_IN low and release the lines."""
        ...


class PulseLines(_Lines, Protocol):
    """Lines whose pulses are timed by this program, one by one."""

    def pulse(self, width_ns: int) -> tuple[int, int]:
        """Set SYNC_IN, clear it after `width_ns` or as soon as possible; return the times before and after."""
        ...


@runtime_checkable
class BitLines(_Lines, Protocol):
    """Lines whose bursts are SPI transfers of at most `bufsiz` bytes."""

    bufsiz: int

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send a burst; return the times before and after."""
        ...


Lines = PulseLines | BitLines


@lru_cache(maxsize=16)
def spi_burst(spec: BurstSpec, bufsiz: int = DEFAULT_BUFSIZ) -> SpiBurst:
    """Return the SPI transfer of a burst, for a spidev buffer of `bufsiz` bytes.

    One bit lasts one pulse width, with the clock within MIN_HZ .. MAX_HZ; MIN_HZ if the burst does not fit
    otherwise. Raises ConfigError, with the `bufsiz` to set, if it does not fit even then.
    """
    size = 0
    for clock_hz in (min(max(round(1e9 / spec.width_ns), MIN_HZ), MAX_HZ), MIN_HZ):
        bits = tuple(LEAD_BITS + round(k * spec.period_ns * clock_hz / 1e9) for k in range(spec.pulses))
        size = max(MIN_BYTES, (bits[-1] + LEAD_BITS) // 8 + 1)
        if size <= bufsiz:
            data = bytearray(size)
            for bit in bits:
                data[bit // 8] |= 0x80 >> bit % 8
            return SpiBurst(bytes(data), clock_hz, bits)
    room = max(4096, 1 << (size - 1).bit_length())
    raise ConfigError(
        f"a burst of {spec.pulses} pulses every {spec.period_ns / 1e3:g} us needs an SPI transfer of {size} bytes,"
        f" spidev allows {bufsiz}",
        "spidev's buffer has 4096 bytes by default",
        f"write `options spidev bufsiz={room}` into /etc/modprobe.d/spidev.conf (a kernel with spidev built in:"
        f" `spidev.bufsiz={room}` in /boot/firmware/cmdline.txt) and reboot the Pi; or use fewer pulses",
        code=ErrorCode.VALUES_CONFLICT,
    )


def send_burst(
    lines: Lines,
    spec: BurstSpec,
    start_ns: int,
    previous_rise_ns: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> BurstRecord:
    """Send the pulses at `start_ns + k * period`, k = 0 .. pulses - 1.

    If `start_ns` has passed, all deadlines shift with the first pulse: the period matters, not the phase. All deadlines
    are computed from the first, so a late pulse never shifts the next one.

    `previous_rise_ns` is the last rising edge before this burst. `stop` is called before each pulse, or transfer; True
    ends the burst. The record's fault is PERIOD_TOO_SHORT if a pulse was skipped because it would have come too early
    for the radar, PULSE_TOO_LONG if one may have been longer than 4 us.
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
    """Send the burst as one SPI transfer, which cannot be interrupted once it has begun.

    The duration of the system call gives an upper bound of the bit length, so every transfer checks the SPI clock: a
    wrong clock (a Pi whose core clock changes) is a fault before it spoils a scan.
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
    spare_ns = max(0, took_ns - round(burst.duration_ns))  # the controller began at an unknown moment within it
    first_ns = before_ns + spare_ns // 2 + lead_ns
    last_ns = first_ns + round((burst.bits[-1] - burst.bits[0]) * burst.bit_ns)
    width_ns = round(max(burst.bit_ns, took_ns / (8 * len(burst.data))))
    jitter_ns = before_ns - begin_ns + (spare_ns + 1) // 2
    if spec.period_ns * burst.clock_hz % 10**9:  # pulses are up to half a bit away from their exact times
        jitter_ns += round(burst.bit_ns / 2)
    fault = 0
    if took_ns < MIN_PART * burst.duration_ns:
        fault = int(PiFault.PERIOD_TOO_SHORT)
    elif lines.check_width and width_ns > MAX_WIDTH_NS:
        fault = int(PiFault.PULSE_TOO_LONG)
    return BurstRecord(spec.pulses, first_ns, last_ns, after_ns, width_ns, jitter_ns, fault)


def send_bench(
    lines: Lines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """Send a burst without a trigger edge, in several transfers if the SPI buffer is too small for one.

    The pause between two transfers is at least one period; the record's jitter does not cover it.
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
