"""The trigger loop: a thread of its own that turns each trigger edge into a burst, and waits for nothing else."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from polysight.pi_controller.bursts import (
    BitLines,
    BurstRecord,
    BurstSpec,
    Edge,
    Lines,
    send_bench,
    send_burst,
    spi_burst,
)
from polysight.shared.errors import DeviceError
from polysight.shared.faults import PiFault
from polysight.shared.messages import Pulsed, Timing
from polysight.shared.raster import FIRST_PULSE_DELAY_S

# From edge to first pulse. A fixed delay longer than the usual wake-up keeps the pulses of all positions at the same
# place behind their edges; 200 us are 4 um of travel at 20 mm/s.
FIRST_PULSE_DELAY_NS = round(FIRST_PULSE_DELAY_S * 1e9)
LOOK_UP_S = 0.1  # how often the loop looks whether it shall end; edges are not delayed by it
SILENT_STATUSES = 2  # statuses of the stage without an edge between them ...
SILENT_POINTS = 2  # ... in which it passed so many points: the wire is off


@dataclass(frozen=True, eq=False)
class Job:
    """A row whose edges are answered: `points` edges are expected, later than `armed_ns`. Jobs differ by identity."""

    points: int
    spec: BurstSpec
    armed_ns: int


class BurstSent(NamedTuple):
    """The burst of the `point`-th edge of a row."""

    job: Job
    point: int
    edge_ns: int
    record: BurstRecord


class LoopFault(NamedTuple):
    """The row of this job (None: any) cannot go on. The loop is disarmed."""

    job: Job | None
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
        Takes :class:`BurstSent`, :class:`Pulsed` (a burst that no edge asked for) and :class:`LoopFault`. Must return
        at once.
    prepare
        Run first in the thread, for example to ask for real-time scheduling.
    """

    def __init__(
        self, lines: Lines, post: Callable[[BurstSent | Pulsed | LoopFault], None], prepare: Callable[[], object]
    ) -> None:
        self._lines, self._post, self._prepare = lines, post, prepare
        self._lock = threading.Lock()  # held while an edge is answered: arm and disarm wait for the burst to end
        self._stop = threading.Event()
        self._job: Job | None = None
        self._bench: BurstSpec | None = None
        self._last_seqno: int | None = None
        self._last_rise_ns: int | None = None
        self._busy_until_ns = self.strays = 0
        self.counts = Counts()
        self.backend = lines.name
        self.timed_by: Timing = "program" if lines.check_width else "one-shot"
        if isinstance(lines, BitLines):
            self.timed_by = "spi"
        self._thread = threading.Thread(target=self._run, name="trigger", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def arm(self, points: int, spec: BurstSpec) -> Job:
        """From now on, edges belong to this row."""
        with self._lock:
            self._job = Job(points, spec, self._lines.now_ns())
            self.counts = Counts()
            return self._job

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
            detail = f"point {point}: {early_us:.0f} us before the burst's end"
            return self._fail(job, PiFault.EDGE_DURING_BURST, detail)
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
        r = self._sent(send_bench(self._lines, spec, start_ns, self._last_rise_ns, self._stop.is_set))
        sent = Pulsed(
            pulses=r.pulses, width_max_ns=r.width_max_ns, jitter_ns=r.jitter_ns, fault=r.fault, timed_by=self.timed_by
        )
        self._post(sent)

    def _sent(self, record: BurstRecord) -> BurstRecord:
        if record.pulses:
            self._last_rise_ns, self._busy_until_ns = record.last_ns, record.end_ns
        return record

    def _is_over(self, job: Job) -> bool:
        return self._job is not job or self._stop.is_set()

    def _fail(self, job: Job | None, number: int, detail: str) -> None:
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
