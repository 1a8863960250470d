"""The burst: the SYNC_IN pulses of one position, on absolute deadlines, each one measured.

The radar starts one frame on each rising edge. It takes pulses of 25 ns .. 4 us, and frames at least 300 us apart; an
early pulse is a fatal fault of its RF core (TI mmWave Radar Interface Control, frame configuration). So the spacing is
checked before a pulse is made, and the width after.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

from polysight.pi_controller.spi_pulses import SpiBurst, longest_pause_ns, spi_burst
from polysight.pi_controller.trigger_lines import BitLines, TriggerLines
from polysight.shared.config import Burst
from polysight.shared.errors import ConfigError
from polysight.shared.faults import PiFault
from polysight.shared.raster import FIRST_PULSE_DELAY_S, MAX_WIDTH_NS, MIN_PERIOD_NS
from polysight.shared.units import us_to_ns

# From edge to first pulse. A fixed delay longer than the usual wake-up keeps the pulses of all positions at the same
# place behind their edges; 200 us are 4 um of travel at 20 mm/s.
FIRST_PULSE_DELAY_NS = round(FIRST_PULSE_DELAY_S * 1e9)


# A transfer that is over sooner than this part of its length was clocked too fast: the frames came too soon.
SHORTEST_PART = 0.98


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


class BurstRecord(NamedTuple):
    """What was sent.

    Attributes
    ----------
    pulses
        Pulses sent.
    first_ns, last_ns
        Rising edge of the first and the last pulse: the time read just before the line was set.
    end_ns
        When the last pulse was over.
    width_max_ns
        Upper bound of the longest pulse: from before the line was set until after it was cleared.
    jitter_ns
        Largest lateness of a rising edge against its deadline.
    fault
        Number of what went wrong, 0 when nothing did.
    """

    pulses: int
    first_ns: int
    last_ns: int
    end_ns: int
    width_max_ns: int
    jitter_ns: int
    fault: int = 0


def send_burst(
    lines: TriggerLines,
    spec: BurstSpec,
    start_ns: int,
    previous_rise_ns: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> BurstRecord:
    """Send the pulses at `start_ns + k * period`, k = 0 .. pulses - 1.

    When `start_ns` has passed already, all deadlines move with the first pulse: the period matters, not the phase. They
    are computed from the first, so that lateness of one pulse never shifts the next.

    Parameters
    ----------
    lines, spec
        The lines and their clock; how many pulses, how far apart, how wide.
    start_ns
        Deadline of the first pulse.
    previous_rise_ns
        Last rising edge before this burst, if any.
    stop
        Asked before each pulse; true ends the burst early.

    Returns
    -------
    BurstRecord
        `fault`: PERIOD_TOO_SHORT when a pulse was left out that would have come too early for the radar, or
        PULSE_TOO_LONG when one may have been longer than 4 us.
    """
    if isinstance(lines, BitLines):
        return _send_bits(lines, spec, start_ns, previous_rise_ns, stop)
    start_ns = max(start_ns, lines.now_ns())
    sent = width_max = jitter = 0
    first = last = end = start_ns
    fault = 0
    for k in range(spec.pulses):
        if stop():
            break
        deadline = start_ns + k * spec.period_ns
        lines.sleep_until(deadline)
        rise = lines.now_ns()
        if previous_rise_ns is not None and rise - previous_rise_ns < MIN_PERIOD_NS:
            fault = PiFault.PERIOD_TOO_SHORT
            break
        lines.set_output(True)
        lines.sleep_until(rise + spec.width_ns)
        lines.set_output(False)
        end = lines.now_ns()
        if k == 0:
            first = rise
        previous_rise_ns = last = rise
        sent += 1
        jitter = max(jitter, rise - deadline)
        width_max = max(width_max, end - rise)
        if spec.check_width and end - rise > MAX_WIDTH_NS:
            fault = PiFault.PULSE_TOO_LONG
            break
    lines.flush()
    return BurstRecord(sent, first, last, end, width_max, jitter, int(fault))


@lru_cache(maxsize=16)
def bits_of(spec: BurstSpec, bufsiz: int) -> SpiBurst:
    """The transfer of a burst, made once. Raises ConfigError when spidev does not take it."""
    return spi_burst(spec.pulses, spec.period_ns, spec.width_ns, bufsiz)


def send_bench(
    lines: TriggerLines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """The same for pulses that no edge asks for: as many transfers as the lines' buffer makes of them.

    The pause between two transfers is at least a period; how exact it is the record's jitter does not say.
    """
    part = spec
    if isinstance(lines, BitLines):
        while part.pulses > 1 and not _fits(part, lines.bufsiz):
            part = part._replace(pulses=-(-part.pulses // 2))
    total = send_burst(lines, part, start_ns, previous_rise_ns, stop)
    while total.pulses < spec.pulses and total.pulses and not total.fault and not stop():
        part = part._replace(pulses=min(part.pulses, spec.pulses - total.pulses))
        more = send_burst(lines, part, total.last_ns + spec.period_ns, total.last_ns, stop)
        if not more.pulses:
            return total._replace(fault=more.fault)
        total = more._replace(
            pulses=total.pulses + more.pulses, first_ns=total.first_ns,
            width_max_ns=max(total.width_max_ns, more.width_max_ns), jitter_ns=max(total.jitter_ns, more.jitter_ns),
        )  # fmt: skip
    return total


def _fits(spec: BurstSpec, bufsiz: int) -> bool:
    try:
        bits_of(spec, bufsiz)
    except ConfigError:
        return False
    return True


def _send_bits(
    lines: BitLines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """Send the burst as one transfer; once begun it goes to its end.

    The clock is measured by each transfer: a bit lasts at most the time that the system call took, by the number of its
    bits. A clock that is not the one asked for (a Pi whose core clock changes) is a fault before it spoils a scan.
    """
    burst = bits_of(spec, lines.bufsiz)
    lead_ns = round(burst.bits[0] * burst.bit_ns)
    begin_ns = max(start_ns - lead_ns, lines.now_ns())
    if previous_rise_ns is not None and begin_ns + lead_ns - previous_rise_ns < MIN_PERIOD_NS:
        return BurstRecord(0, start_ns, start_ns, start_ns, 0, 0, int(PiFault.PERIOD_TOO_SHORT))
    lines.sleep_until(begin_ns)
    if stop():
        return BurstRecord(0, start_ns, start_ns, start_ns, 0, 0)
    before_ns, after_ns = lines.transfer(burst)
    lines.flush()
    took_ns = after_ns - before_ns
    spare_ns = max(0, took_ns - round(burst.duration_ns))  # somewhere in it the controller began
    first_ns = before_ns + spare_ns // 2 + lead_ns
    last_ns = first_ns + round((burst.bits[-1] - burst.bits[0]) * burst.bit_ns)
    width_ns = round(max(burst.bit_ns, took_ns / (8 * len(burst.data))))
    jitter_ns = before_ns - begin_ns + (spare_ns + 1) // 2
    if any(
        round(k * spec.period_ns * burst.clock_hz / 1e9) * 1e9 != k * spec.period_ns * burst.clock_hz for k in (1, 2)
    ):
        jitter_ns += longest_pause_ns(burst)
    fault = 0
    if took_ns < SHORTEST_PART * burst.duration_ns:
        fault = int(PiFault.PERIOD_TOO_SHORT)
    elif spec.check_width and width_ns > MAX_WIDTH_NS:
        fault = int(PiFault.PULSE_TOO_LONG)
    return BurstRecord(spec.pulses, first_ns, last_ns, after_ns, width_ns, jitter_ns, fault)
