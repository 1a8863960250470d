"""Bursts of SYNC_IN pulses, and the thread that answers each trigger edge with one.

The stage sends a trigger edge at each point of a row. The radar starts one frame on each rising edge of SYNC_IN. It
accepts pulses of 25 ns .. 4 us and needs at least 300 us between frames; an early pulse is a fatal fault of its RF core
(TI mmWave Radar Interface Control, frame configuration). So the spacing is checked before each pulse, and the width
after it.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

from polysight_shared.config import SPI_WIDTH_US
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.messages import Pulsed, Timing
from polysight_shared.raster import FIRST_PULSE_DELAY_S, MAX_WIDTH_NS, MIN_PERIOD_NS, Burst
from polysight_shared.stage_line import END_OF_TIME_NS
from polysight_shared.units import us_to_ns

# From edge to first pulse. A fixed delay, longer than the usual wake-up time, keeps the pulses of all positions at the
# same distance after their edges; 200 us are 4 um of travel at 20 mm/s.
FIRST_PULSE_DELAY_NS = round(FIRST_PULSE_DELAY_S * 1e9)
# Timeout of waiting for an edge, after which the loop checks if it has to stop or to send a burst without an edge;
# chosen.
LOOK_UP_S = 0.1
# The trigger wire is off if `SILENT_STATUSES` consecutive stage statuses came without an edge, while the stage passed
# at least `SILENT_POINTS` points; chosen: one status may come just before its edge.
SILENT_STATUSES = 2
SILENT_POINTS = 2
# Low bits before the first pulse, and at least as many after the last (a byte is chosen): MOSI keeps the last level.
LEAD_BITS = 8
# Shorter transfers have gaps: spi-bcm2835 writes them byte by byte, longer ones by DMA.
MIN_BYTES = 96
# Longest transfer of spidev in bytes, unless its module parameter `bufsiz` says otherwise.
DEFAULT_BUFSIZ = 4096
# Shortest duration of a transfer relative to the nominal one: a shorter one was clocked too fast, its frames are too
# close. 2 % is chosen.
MIN_DURATION_SHARE = 0.98


class Edge(NamedTuple):
    """A rising edge of the trigger line."""

    # Time on the clock of the lines.
    t_ns: int
    # The kernel's count of edges; a gap means lost edges.
    seqno: int


class BurstSpec(NamedTuple):
    """Number, period and width of the pulses at one position."""

    pulses: int
    period_ns: int
    width_ns: int

    @staticmethod
    def from_burst(burst: Burst) -> BurstSpec:
        """Return the burst of the rig file."""
        return BurstSpec(burst.pulses, us_to_ns(burst.period_us), us_to_ns(burst.width_us))


class SpiBurst(NamedTuple):
    """A burst as one SPI transfer on MOSI: each pulse is one set bit, within half a bit of its exact time."""

    # Bits of the SPI transfer, most significant bit first.
    data: bytes
    # Bits per second.
    clock_hz: int
    # Index of each set bit.
    bits: tuple[int, ...]

    @property
    def bit_ns(self) -> float:
        """Duration of a bit, which is the pulse width."""
        return 1e9 / self.clock_hz

    @property
    def duration_ns(self) -> float:
        """Duration of the transfer."""
        return 8 * len(self.data) * self.bit_ns


class BurstRecord(NamedTuple):
    """Result of sending a burst. Times are on the clock of the lines; those of an SPI transfer are estimates."""

    # Number of pulses that were sent, or seen by the return wire.
    pulses: int
    # Rising edge of the first pulse: the clock just before the line was set.
    first_ns: int
    # Rising edge of the last pulse, as `first_ns`.
    last_ns: int
    # Time after the last pulse, or after the SPI transfer.
    end_ns: int
    # Upper bound of the pulse widths: from before the line was set until after it was cleared.
    width_max_ns: int = 0
    # Largest delay of a rising edge after its deadline; for an SPI transfer an upper bound.
    jitter_ns: int = 0
    # Number of the PiFault; 0: none.
    fault: int = 0


class ReturnedPulses(NamedTuple):
    """Pulses seen at the connector, by the return wire."""

    pulses: int
    # Upper bound of the pulse widths; 0: not measured.
    width_max_ns: int = 0


class _Lines(Protocol):
    """Trigger input and SYNC_IN output (lines.py). Methods raise DeviceError when the lines are lost."""

    # Backend in messages: "gpiod", "spi" or "wires".
    name: str
    # True without a hardware one-shot: a pulse that may have been too long is a fault.
    check_width: bool
    # True if the lines' clock is CLOCK_MONOTONIC.
    is_real_time: bool

    # Time on the clock of edges and pulses.
    def now_ns(self) -> int: ...

    # Sleep until `t_ns`; never return before it.
    def sleep_until(self, t_ns: int) -> None: ...

    # The next rising edge of the trigger line, or None after `timeout_s` of wall time.
    def wait_edge(self, timeout_s: float) -> Edge | None: ...

    # The pulses that the return wire has seen since the last call; it waits briefly until all that were sent have come.
    # None without a return wire.
    def count_returned(self, sent: int) -> ReturnedPulses | None: ...

    # Sets SYNC_IN low and releases the lines.
    def close(self) -> None: ...


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
def make_spi_burst(spec: BurstSpec, bufsiz: int = DEFAULT_BUFSIZ) -> SpiBurst:
    """Return the SPI transfer of a burst, for a spidev buffer of `bufsiz` bytes.

    One bit lasts one pulse width. Raises ConfigError if the controller cannot make that width, or, with the `bufsiz` to
    set, if the burst does not fit.
    """
    low_us, high_us = SPI_WIDTH_US
    if not low_us <= spec.width_ns / 1e3 <= high_us:
        raise ConfigError(
            f"a pulse of {spec.width_ns / 1e3:g} us is outside {low_us:g}..{high_us:g} us",
            "the SPI controller makes a pulse of one bit, at 500 kHz to 2 MHz",
            f"set burst.width_us within {low_us:g}..{high_us:g}",
            code=ErrorCode.VALUES_CONFLICT,
        )
    clock_hz = round(1e9 / spec.width_ns)
    bits = tuple(LEAD_BITS + round(k * spec.period_ns * clock_hz / 1e9) for k in range(spec.pulses))
    size = max(MIN_BYTES, (bits[-1] + LEAD_BITS) // 8 + 1)
    if size <= bufsiz:
        data = bytearray(size)
        for bit in bits:
            data[bit // 8] |= 0x80 >> bit % 8
        return SpiBurst(bytes(data), clock_hz, bits)
    needed_bytes = max(4096, 1 << (size - 1).bit_length())
    raise ConfigError(
        f"a burst of {spec.pulses} pulses every {spec.period_ns / 1e3:g} us needs an SPI transfer of {size} bytes,"
        f" spidev allows {bufsiz}",
        "spidev's buffer has 4096 bytes by default",
        f"write `options spidev bufsiz={needed_bytes}` into /etc/modprobe.d/spidev.conf (a kernel with spidev built in:"
        f" `spidev.bufsiz={needed_bytes}` in /boot/firmware/cmdline.txt) and reboot the Pi; or use fewer pulses",
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
    for the radar, or if an SPI transfer was clocked too fast; PULSE_TOO_LONG if a pulse may have been longer than 4 us.
    """
    if isinstance(lines, BitLines):
        return _send_bits(lines, spec, start_ns, previous_rise_ns, stop)
    start_ns = max(start_ns, lines.now_ns())
    first = start_ns
    last = start_ns
    end = start_ns
    sent_pulses = 0
    width_max = 0
    jitter = 0
    fault = 0
    while sent_pulses < spec.pulses and not fault and not stop():
        deadline = start_ns + sent_pulses * spec.period_ns
        lines.sleep_until(deadline)
        if previous_rise_ns is not None and lines.now_ns() - previous_rise_ns < MIN_PERIOD_NS:
            fault = int(PiFault.PERIOD_TOO_SHORT)
            break
        last, end = lines.pulse(spec.width_ns)
        previous_rise_ns = last
        if sent_pulses == 0:
            first = last
        sent_pulses += 1
        jitter = max(jitter, last - deadline)
        width_max = max(width_max, end - last)
        if lines.check_width and end - last > MAX_WIDTH_NS:
            fault = int(PiFault.PULSE_TOO_LONG)
    return BurstRecord(sent_pulses, first, last, end, width_max_ns=width_max, jitter_ns=jitter, fault=fault)


def _send_bits(
    lines: BitLines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """Send the burst as one SPI transfer, which cannot be interrupted once it has begun. Arguments as `send_burst`.

    The duration of the system call gives an upper bound of the bit length, so every transfer checks the SPI clock: a
    wrong clock (a Pi whose core clock changes) is a fault before it spoils a scan.
    """
    burst = make_spi_burst(spec, lines.bufsiz)
    lead_ns = round(burst.bits[0] * burst.bit_ns)
    begin_ns = max(start_ns - lead_ns, lines.now_ns())
    nothing_sent = BurstRecord(0, start_ns, start_ns, start_ns)
    if previous_rise_ns is not None and begin_ns + lead_ns - previous_rise_ns < MIN_PERIOD_NS:
        return nothing_sent._replace(fault=int(PiFault.PERIOD_TOO_SHORT))
    lines.sleep_until(begin_ns)
    if stop():
        return nothing_sent
    before_ns, after_ns = lines.transfer(burst)
    took_ns = after_ns - before_ns
    # The controller began at an unknown moment within the system call.
    spare_ns = max(0, took_ns - round(burst.duration_ns))
    first_ns = before_ns + spare_ns // 2 + lead_ns
    last_ns = first_ns + round((burst.bits[-1] - burst.bits[0]) * burst.bit_ns)
    width_ns = round(max(burst.bit_ns, took_ns / (8 * len(burst.data))))
    jitter_ns = before_ns - begin_ns + (spare_ns + 1) // 2
    # Pulses are up to half a bit away from their exact times.
    if spec.period_ns * burst.clock_hz % 10**9:
        jitter_ns += round(burst.bit_ns / 2)
    fault = 0
    if took_ns < MIN_DURATION_SHARE * burst.duration_ns:
        fault = int(PiFault.PERIOD_TOO_SHORT)
    elif lines.check_width and width_ns > MAX_WIDTH_NS:
        fault = int(PiFault.PULSE_TOO_LONG)
    return BurstRecord(
        pulses=spec.pulses,
        first_ns=first_ns,
        last_ns=last_ns,
        end_ns=after_ns,
        width_max_ns=width_ns,
        jitter_ns=jitter_ns,
        fault=fault,
    )


def send_untriggered_burst(
    lines: Lines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
) -> BurstRecord:
    """Send a burst without a trigger edge, in several transfers if the SPI buffer is too small for one.

    The pause between two transfers is at least one period; the record's jitter does not cover it.
    """
    partial_spec = spec
    while isinstance(lines, BitLines) and partial_spec.pulses > 1:
        try:
            make_spi_burst(partial_spec, lines.bufsiz)
            break
        except ConfigError:
            partial_spec = partial_spec._replace(pulses=-(-partial_spec.pulses // 2))
    total = send_burst(lines, partial_spec, start_ns, previous_rise_ns, stop)
    while 0 < total.pulses < spec.pulses and not total.fault and not stop():
        partial_spec = partial_spec._replace(pulses=min(partial_spec.pulses, spec.pulses - total.pulses))
        record = send_burst(lines, partial_spec, total.last_ns + spec.period_ns, total.last_ns, stop)
        if not record.pulses:
            return total._replace(fault=record.fault)
        total = record._replace(
            pulses=total.pulses + record.pulses,
            first_ns=total.first_ns,
            width_max_ns=max(total.width_max_ns, record.width_max_ns),
            jitter_ns=max(total.jitter_ns, record.jitter_ns),
        )
    return total


# --- the trigger loop -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Job:
    """A row whose edges are answered. Compared by identity, so that a late result does not count for another row."""

    # Number of edges that are expected.
    points: int
    # The burst that answers each.
    spec: BurstSpec
    # Edges up to this time belong to no row, or to an earlier one.
    armed_ns: int


class BurstSent(NamedTuple):
    """The burst that answered an edge of a row."""

    job: Job
    # Number of the edge in the row, from 0.
    point: int
    # Time of the edge, on the clock of the lines.
    edge_ns: int
    record: BurstRecord


class LoopFault(NamedTuple):
    """The row of a job has failed; the loop is disarmed."""

    # None: the lines are lost, and the loop's thread has ended.
    job: Job | None
    # Number of the PiFault.
    number: int
    # Description of the event, for people.
    detail: str


class Counts(NamedTuple):
    """Counts of the row that was armed last."""

    # Trigger edges received since the row was armed.
    edges: int = 0
    # Bursts of at least one pulse.
    bursts: int = 0
    # Pulses of all bursts.
    pulses: int = 0


class TriggerLoop:
    """Answers the edges of the armed row with bursts.

    Parameters
    ----------
    lines
        The lines; after :meth:`start` only the loop's thread uses them, and closes them at its end.
    post
        Called with :class:`BurstSent`, :class:`Pulsed` (a burst without an edge) and :class:`LoopFault`; must return
        immediately.
    prepare
        Called first in the thread, for example to request real-time scheduling.
    """

    def __init__(
        self, lines: Lines, post: Callable[[BurstSent | Pulsed | LoopFault], None], prepare: Callable[[], object]
    ) -> None:
        self._lines = lines
        self._post = post
        self._prepare = prepare
        # The lock is held while an edge is answered: arm and disarm wait for the burst to end.
        self._lock = threading.Lock()
        self._stop = threading.Event()
        # The armed row; None: edges are not answered.
        self._job: Job | None = None
        # A burst to be sent without an edge.
        self._untriggered: BurstSpec | None = None
        self._last_seqno: int | None = None
        # Last rising edge of SYNC_IN, from which the shortest period is checked.
        self._last_rise_ns: int | None = None
        # End of the last burst: an edge before it came too early.
        self._busy_until_ns = 0
        # Number of edges while no row was armed.
        self.strays = 0
        self.counts = Counts()
        self.backend = lines.name
        # True if the last burst was counted at the connector by a return wire.
        self.sees_pulses = False
        self.timed_by: Timing = "program" if lines.check_width else "one-shot"
        if isinstance(lines, BitLines):
            self.timed_by = "spi"
        self._thread = threading.Thread(target=self._run, name="trigger", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def bound_now_ns(self) -> tuple[int, int]:
        """Return the earliest and the latest time that it can be now on the clock of the edges. From any thread."""
        if not self._lines.is_real_time:
            return 0, END_OF_TIME_NS
        now_ns = self._lines.now_ns()
        return now_ns, now_ns

    def arm(self, points: int, spec: BurstSpec) -> Job:
        """Answer the next `points` edges, each with the burst `spec`; return the row's job."""
        with self._lock:
            self._job = Job(points, spec, self._lines.now_ns())
            self.counts = Counts()
            return self._job

    def disarm(self) -> Counts:
        """Stop answering edges and return the counts since :meth:`arm`.

        Waits for a running burst, which ends after its current pulse (an SPI transfer is sent as a whole).
        """
        self._job = None
        with self._lock:
            return self.counts

    def send(self, spec: BurstSpec) -> None:
        """Send one burst without an edge, within LOOK_UP_S; `post` gets the result. Only while no row is armed."""
        self._untriggered = spec

    def check(self, spec: BurstSpec) -> None:
        """Raise ConfigError if the lines cannot send this burst in one piece."""
        if isinstance(self._lines, BitLines):
            make_spi_burst(spec, self._lines.bufsiz)

    @property
    def alive(self) -> bool:
        """True while the thread runs."""
        return self._thread.is_alive()

    def stop(self, timeout_s: float = 0.5) -> bool:
        """End the thread, set outputs low, release the lines. Return True if it ended within the limit."""
        stopped_before = self._stop.is_set()
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        elif not stopped_before:
            self._lines.close()
        return not self._thread.is_alive()

    def _run(self) -> None:
        """Answer edges until :meth:`stop`; a lost line or an internal error ends the loop with a LoopFault."""
        self._prepare()
        try:
            while not self._stop.is_set():
                edge = self._lines.wait_edge(LOOK_UP_S)
                with self._lock:
                    if edge is not None:
                        self._answer_edge(edge)
                    if self._untriggered is not None:
                        self._send_without_edge(self._untriggered)
        except DeviceError as e:
            self._fail(None, PiFault.TRIGGER_LINE_LOST, e.what)
        except Exception as e:
            self._fail(None, PiFault.TRIGGER_LINE_LOST, f"internal error: {e!r}")
            raise
        finally:
            # An error in closing has no new information: the lines are lost already, or the process ends.
            with contextlib.suppress(DeviceError):
                self._lines.close()

    def _answer_edge(self, edge: Edge) -> None:
        """Answer one edge with a burst and post the result, or post why the row has failed. Stray edges are counted."""
        edges_lost = 0
        if self._last_seqno is not None:
            edges_lost = edge.seqno - self._last_seqno - 1
        self._last_seqno = edge.seqno
        job = self._job
        if job is None or edge.t_ns <= job.armed_ns:
            self.strays += 1
            return
        point, bursts, pulses = self.counts
        self.counts = Counts(point + 1, bursts, pulses)
        if edges_lost:
            return self._fail(job, PiFault.EDGE_LOST, f"{edges_lost} edges lost before point {point}")
        if edge.t_ns < self._busy_until_ns:
            early_us = (self._busy_until_ns - edge.t_ns) / 1e3
            detail = f"point {point}: {early_us:.0f} us before the burst's end"
            return self._fail(job, PiFault.EDGE_DURING_BURST, detail)
        if point >= job.points:
            return self._fail(job, PiFault.POINTS_MISMATCH, f"one edge more than the row's {job.points} points")
        start_ns = edge.t_ns + FIRST_PULSE_DELAY_NS
        record = send_burst(self._lines, job.spec, start_ns, self._last_rise_ns, lambda: self._is_over(job))
        self._note_sent(record)
        record, unseen = self._count_returned(record)
        self.counts = Counts(point + 1, bursts + (record.pulses > 0), pulses + record.pulses)
        self._post(BurstSent(job, point, edge.t_ns, record))
        if record.fault:
            detail = f"point {point}, pulse {record.pulses} of {job.spec.pulses}"
            if record.fault == PiFault.PULSE_TOO_LONG:
                detail += f": may have lasted {record.width_max_ns / 1e3:.1f} us"
            self._fail(job, record.fault, detail)
        elif unseen:
            self._fail(job, PiFault.PULSES_UNSEEN, f"point {point}: {unseen}")

    def _count_returned(self, record: BurstRecord) -> tuple[BurstRecord, str]:
        """Return the record with the pulses seen by the return wire, and how they differ from those sent, or "".

        Without a return wire the record is not changed.
        """
        returned = self._lines.count_returned(record.pulses)
        self.sees_pulses = returned is not None
        if returned is None:
            return record, ""
        difference = ""
        if returned.pulses != record.pulses:
            difference = f"{record.pulses} pulses sent, {returned.pulses} seen"
        width_ns = returned.width_max_ns or record.width_max_ns
        fault = record.fault
        if returned.width_max_ns > MAX_WIDTH_NS:
            fault = fault or int(PiFault.PULSE_TOO_LONG)
        return record._replace(pulses=returned.pulses, width_max_ns=width_ns, fault=fault), difference

    def _send_without_edge(self, spec: BurstSpec) -> None:
        """Send a burst that `send` has requested, and post its result."""
        self._untriggered = None
        start_ns = self._lines.now_ns()
        if self._last_rise_ns is not None:
            start_ns = max(start_ns, self._last_rise_ns + spec.period_ns)
        record = send_untriggered_burst(self._lines, spec, start_ns, self._last_rise_ns, self._stop.is_set)
        self._note_sent(record)
        record, unseen = self._count_returned(record)
        result = Pulsed(
            pulses=record.pulses,
            width_max_ns=record.width_max_ns,
            jitter_ns=record.jitter_ns,
            fault=record.fault or (PiFault.PULSES_UNSEEN if unseen else 0),
            timed_by=self.timed_by,
            pulses_seen=self.sees_pulses,
        )
        self._post(result)

    def _note_sent(self, record: BurstRecord) -> None:
        if record.pulses:
            self._last_rise_ns = record.last_ns
            self._busy_until_ns = record.end_ns

    def _is_over(self, job: Job) -> bool:
        return self._job is not job or self._stop.is_set()

    def _fail(self, job: Job | None, number: int, detail: str) -> None:
        self._job = None
        self._post(LoopFault(job, number, detail))


class TriggerWatch:
    """Detects a trigger wire that is off: the stage passes points and no edges arrive."""

    def __init__(self) -> None:
        # Counts of edges and points when an edge was last new, and the number of statuses since.
        self._edges = -1
        self._points = 0
        self._statuses = 0

    def is_silent(self, points: int, edges: int) -> bool:
        """Update with a stage status (points passed, edges received, both in this row); True if the wire is off."""
        if edges != self._edges:
            self._edges = edges
            self._points = points
            self._statuses = 0
            return False
        # The stage counts from 0 in each row.
        self._points = min(self._points, points)
        self._statuses += 1
        # An edge can arrive before the status that counts its point: such points have not been passed without an edge.
        return self._statuses >= SILENT_STATUSES and points - max(edges, self._points) >= SILENT_POINTS
