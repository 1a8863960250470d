"""The trigger loop: a thread of its own that turns each trigger edge into a burst, and waits for nothing else.

A burst is the SYNC_IN pulses of one position, on absolute deadlines, each one measured. The radar starts one frame on
each rising edge. It takes pulses of 25 ns .. 4 us, and frames at least 300 us apart; an early pulse is a fatal fault of
its RF core (TI mmWave Radar Interface Control, frame configuration). So the spacing is checked before a pulse is made,
and the width after.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import NamedTuple

from polysight.pi_controller.lines import BitLines, BurstSpec, Edge, TriggerLines, spi_burst
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.faults import PiFault
from polysight.shared.messages import Pulsed, Timing
from polysight.shared.raster import FIRST_PULSE_DELAY_S, MAX_WIDTH_NS, MIN_PERIOD_NS

# From edge to first pulse. A fixed delay longer than the usual wake-up keeps the pulses of all positions at the same
# place behind their edges; 200 us are 4 um of travel at 20 mm/s.
FIRST_PULSE_DELAY_NS = round(FIRST_PULSE_DELAY_S * 1e9)
# A transfer that is over sooner than this part of its length was clocked too fast: the frames came too soon.
SHORTEST_PART = 0.98
# How often the loop looks whether it shall end. Edges are not delayed by it.
LOOK_UP_S = 0.1
SILENT_STATUSES = 2  # statuses of the stage without an edge between them ...
SILENT_POINTS = 2  # ... in which it passed so many points: the wire is off


class BurstRecord(NamedTuple):
    """What was sent."""

    pulses: int
    first_ns: int  # rising edge of the first pulse: the time read just before the line was set
    last_ns: int
    end_ns: int  # when the last pulse was over
    width_max_ns: int = 0  # upper bound: from before the line was set until after it was cleared
    jitter_ns: int = 0  # largest lateness of a rising edge against its deadline
    fault: int = 0  # number of what went wrong


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

    `previous_rise_ns` is the last rising edge before this burst; `stop` is asked before each pulse, or transfer, and
    ends the burst early. The record's fault is PERIOD_TOO_SHORT when a pulse was left out that would have come too
    early for the radar, PULSE_TOO_LONG when one may have been longer than 4 us.
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
        if previous_rise_ns is not None and lines.now_ns() - previous_rise_ns < MIN_PERIOD_NS:
            fault = PiFault.PERIOD_TOO_SHORT
            break
        rise, end = lines.pulse(spec.width_ns)
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
    lines.flush()
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
    elif spec.check_width and width_ns > MAX_WIDTH_NS:
        fault = int(PiFault.PULSE_TOO_LONG)
    return BurstRecord(spec.pulses, first_ns, last_ns, after_ns, width_ns, jitter_ns, fault)


def send_bench(
    lines: TriggerLines, spec: BurstSpec, start_ns: int, previous_rise_ns: int | None, stop: Callable[[], bool]
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


def send_bursts(lines: TriggerLines, spec: BurstSpec, bursts: int, pause_ns: int) -> list[BurstRecord]:
    """Send bursts without a stage, `pause_ns` after one another."""
    sent: list[BurstRecord] = []
    for _ in range(bursts):
        sent.append(send_burst(lines, spec, (sent[-1].end_ns if sent else lines.now_ns()) + pause_ns))
    return sent


class RowJob(NamedTuple):
    """The row whose edges are answered: `points` edges are expected, later than `armed_ns`."""

    row_index: int
    take: int
    points: int
    spec: BurstSpec
    armed_ns: int = 0


class BurstSent(NamedTuple):
    """The burst of the `point`-th edge of a row."""

    job: RowJob
    point: int
    edge_ns: int
    record: BurstRecord


class BenchBurst(NamedTuple):
    """A burst that no edge asked for has been sent."""

    record: BurstRecord
    timed_by: Timing

    def told(self) -> Pulsed:
        """What the host that asked for it is told."""
        r = self.record
        return Pulsed(
            pulses=r.pulses, width_max_ns=r.width_max_ns, jitter_ns=r.jitter_ns, fault=r.fault, timed_by=self.timed_by
        )


class LoopFault(NamedTuple):
    """The row of this job (None: any) cannot go on. The loop is disarmed."""

    job: RowJob | None
    number: int
    detail: str


class Counts(NamedTuple):
    """Of the row that was armed last."""

    edges: int = 0
    bursts: int = 0
    pulses: int = 0


class TriggerLoop:
    """Answers edges of the armed row with bursts.

    Parameters
    ----------
    lines
        The lines; after :meth:`start` they belong to the loop's thread, which closes them at its end.
    post
        Takes :class:`BurstSent`, :class:`BenchBurst` and :class:`LoopFault`. Must return at once.
    prepare
        Run first in the thread, for example to ask for real-time scheduling.
    """

    def __init__(
        self,
        lines: TriggerLines,
        post: Callable[[BurstSent | BenchBurst | LoopFault], None],
        prepare: Callable[[], object],
    ) -> None:
        self._lines, self._post, self._prepare = lines, post, prepare
        self._lock = threading.Lock()  # held while an edge is answered: arm and disarm wait for the burst to end
        self._stop = threading.Event()
        self._job: RowJob | None = None
        self._bench: BurstSpec | None = None
        self._last_seqno: int | None = None
        self._last_rise_ns: int | None = None
        self._busy_until_ns = self.strays = 0
        self.counts = Counts()
        self._thread = threading.Thread(target=self._run, name="trigger", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def arm(self, job: RowJob) -> RowJob:
        """From now on, edges belong to this row. Returns the job with its `armed_ns`."""
        with self._lock:
            self._job = job = job._replace(armed_ns=self._lines.now_ns())
            self.counts = Counts()
            return job

    def disarm(self) -> Counts:
        """Answer no more edges; a running burst ends after its pulse. Returns what was counted since :meth:`arm`."""
        self._job = None
        with self._lock:
            return self.counts

    def send(self, spec: BurstSpec) -> None:
        """Send one burst that no edge asks for, when the loop next looks up. Only while no row is armed."""
        self._bench = spec

    def check(self, spec: BurstSpec) -> None:
        """Raise ConfigError if the lines cannot send such a burst in one piece."""
        if isinstance(self._lines, BitLines):
            spi_burst(spec, self._lines.bufsiz)

    def timed_by(self, spec: BurstSpec) -> Timing:
        """What times the pulses of a burst."""
        if isinstance(self._lines, BitLines):
            return "spi"
        return "program" if spec.check_width else "one-shot"

    @property
    def alive(self) -> bool:
        """Whether the loop still serves its lines."""
        return self._thread.is_alive()

    def stop(self, limit_s: float = 0.5) -> bool:
        """End the thread; outputs go low, lines are released. Returns whether it ended within the limit."""
        first = not self._stop.is_set()
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(limit_s)
        elif first:
            self._lines.close()
        return not self._thread.is_alive()

    def _run(self) -> None:
        self._prepare()
        try:
            while not self._stop.is_set():
                edge = self._lines.wait_edge(LOOK_UP_S)
                with self._lock:
                    if edge is not None:
                        self._take(edge)
                    if self._bench is not None:
                        self._send(self._bench)
        except DeviceError as e:
            self._fail(None, PiFault.TRIGGER_LINE_LOST, e.what)
        except Exception as e:
            self._fail(None, PiFault.TRIGGER_LINE_LOST, f"a fault of this program: {e!r}")
            raise
        finally:
            with contextlib.suppress(DeviceError):  # gone already: the fault was posted above, or the process ends
                self._lines.close()

    def _take(self, edge: Edge) -> None:
        lost = 0 if self._last_seqno is None else edge.seqno - self._last_seqno - 1
        self._last_seqno = edge.seqno
        job = self._job
        if job is None or edge.t_ns <= job.armed_ns:
            self.strays += 1
            return
        point, bursts, pulses = self.counts
        self.counts = Counts(point + 1, bursts, pulses)
        if lost:
            return self._fail(job, PiFault.EDGE_LOST, f"{lost} edges lost before point {point}")
        if edge.t_ns < self._busy_until_ns:
            early_us = (self._busy_until_ns - edge.t_ns) / 1e3
            return self._fail(
                job, PiFault.EDGE_DURING_BURST, f"point {point}: {early_us:.0f} us before the burst's end"
            )
        if point >= job.points:
            return self._fail(job, PiFault.POINTS_MISMATCH, f"an edge more than the row's {job.points} points")
        start_ns = edge.t_ns + FIRST_PULSE_DELAY_NS
        record = self._sent(send_burst(self._lines, job.spec, start_ns, self._last_rise_ns, lambda: self._is_over(job)))
        self.counts = Counts(point + 1, bursts + (record.pulses > 0), pulses + record.pulses)
        self._post(BurstSent(job, point, edge.t_ns, record))
        if record.fault:
            detail = f"point {point}, pulse {record.pulses} of {job.spec.pulses}"
            if record.fault == PiFault.PULSE_TOO_LONG:
                detail += f": may have lasted {record.width_max_ns / 1e3:.1f} us"
            self._fail(job, record.fault, detail)

    def _send(self, spec: BurstSpec) -> None:
        self._bench = None
        start_ns = self._lines.now_ns()
        if self._last_rise_ns is not None:
            start_ns = max(start_ns, self._last_rise_ns + spec.period_ns)
        record = self._sent(send_bench(self._lines, spec, start_ns, self._last_rise_ns, self._stop.is_set))
        self._post(BenchBurst(record, self.timed_by(spec)))

    def _sent(self, record: BurstRecord) -> BurstRecord:
        if record.pulses:
            self._last_rise_ns, self._busy_until_ns = record.last_ns, record.end_ns
        return record

    def _is_over(self, job: RowJob) -> bool:
        return self._job is not job or self._stop.is_set()

    def _fail(self, job: RowJob | None, number: int, detail: str) -> None:
        self._job = None
        self._post(LoopFault(job, number, detail))


class TriggerWatch:
    """Notices a stage that passes points of which no edge arrives: the trigger wire is off."""

    def __init__(self) -> None:
        self._edges, self._points, self._statuses = -1, 0, 0

    def is_silent(self, points: int, edges: int) -> bool:
        """With each status: points passed by the stage, edges seen. Whether the wire is silent."""
        if edges != self._edges:
            self._edges, self._points, self._statuses = edges, points, 0
            return False
        self._points = min(self._points, points)  # the stage counts anew in each row
        self._statuses += 1
        return self._statuses >= SILENT_STATUSES and points - max(edges, self._points) >= SILENT_POINTS
