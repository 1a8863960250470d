"""The burst: the SYNC_IN pulses of one position, on absolute deadlines, each one measured.

The radar starts one frame on each rising edge. It takes pulses of 25 ns .. 4 us, and frames at least 300 us apart; an
early pulse is a fatal fault of its RF core (TI mmWave Radar Interface Control, frame configuration). So the spacing is
checked before a pulse is made, and the width after.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from polysight.pi_controller.trigger_lines import TriggerLines
from polysight.shared.config import Burst
from polysight.shared.faults import PiFault
from polysight.shared.raster import FIRST_PULSE_DELAY_S, MAX_WIDTH_NS, MIN_PERIOD_NS
from polysight.shared.units import us_to_ns

# From edge to first pulse. A fixed delay longer than the usual wake-up keeps the pulses of all positions at the same
# place behind their edges; 200 us are 4 um of travel at 20 mm/s.
FIRST_PULSE_DELAY_NS = round(FIRST_PULSE_DELAY_S * 1e9)


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

    When `start_ns` has passed already, all deadlines move with the first pulse: the period matters, not the phase.
    Deadlines are computed from the first, so that lateness of one pulse never shifts the next.

    Parameters
    ----------
    lines
        The lines and their clock.
    spec
        How many pulses, how far apart, how wide.
    start_ns
        Deadline of the first pulse.
    previous_rise_ns
        Last rising edge before this burst, if any.
    stop
        Asked before each pulse; true ends the burst early.

    Returns
    -------
    BurstRecord
        with `fault` PERIOD_TOO_SHORT when a pulse was left out because it would have come too early for the radar, or
        PULSE_TOO_LONG when one may have been longer than 4 us. Either ends the burst.
    """
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
