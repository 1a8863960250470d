"""The trigger loop: a thread that answers each trigger edge with a burst and does nothing else."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from polysight_pi.bursts import (
    BitLines,
    BurstRecord,
    BurstSpec,
    Edge,
    Lines,
    send_bench,
    send_burst,
    spi_burst,
)
from polysight_shared.errors import DeviceError
from polysight_shared.faults import PiFault
from polysight_shared.messages import Pulsed, Timing
from polysight_shared.raster import FIRST_PULSE_DELAY_S

# From edge to first pulse. A fixed delay, longer than the usual wake-up time, keeps the pulses of all positions at the
# same distance behind their edges; 200 us are 4 um of travel at 20 mm/s.
FIRST_PULSE_DELAY_NS = round(FIRST_PULSE_DELAY_S * 1e9)
LOOK_UP_S = 0.1  # timeout of waiting for an edge, after which the loop checks if it has to stop
SILENT_STATUSES = 2  # consecutive stage statuses without an edge ...
SILENT_POINTS = 2  # ... while at least this many points were passed: the trigger wire is off


@dataclass(frozen=True, eq=False)
class Job:
    """A row whose edges are answered: `points` edges are expected, later than `armed_ns`. Compared by identity."""

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
    """The row of this job (None: every row) has failed; the loop is disarmed."""

    job: Job | None
    number: int
    detail: str


class Counts(NamedTuple):
    """Counts of the row that was armed last."""

    edges: int = 0
    bursts: int = 0
    pulses: int = 0


class TriggerLoop:
    """Answers the edges of the armed row with bursts.

    Parameters
    ----------
    lines
        The lines; after :meth:`start` only the loop's thread uses them, and closes them at its end.
    post
        Called with :class:`BurstSent`, :class:`Pulsed` (a burst without an edge) and :class:`LoopFault`; must return
        at once.
    prepare
        Called first in the thread, for example to request real-time scheduling.
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
        """Answer the edges of this row from now on."""
        with self._lock:
            self._job = Job(points, spec, self._lines.now_ns())
            self.counts = Counts()
            return self._job

    def disarm(self) -> Counts:
        """Stop answering edges; a running burst ends after its pulse. Return the counts since :meth:`arm`."""
        self._job = None
        with self._lock:
            return self.counts

    def send(self, spec: BurstSpec) -> None:
        """Send one burst without an edge, within LOOK_UP_S. Only while no row is armed."""
        self._bench = spec

    def check(self, spec: BurstSpec) -> None:
        """Raise ConfigError if the lines cannot send this burst in one piece."""
        if isinstance(self._lines, BitLines):
            spi_burst(spec, self._lines.bufsiz)

    @property
    def alive(self) -> bool:
        """True while the thread runs."""
        return self._thread.is_alive()

    def stop(self, timeout_s: float = 0.5) -> bool:
        """End the thread, set outputs low, release the lines. Return True if it ended within the limit."""
        first = not self._stop.is_set()
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
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
            self._fail(None, PiFault.TRIGGER_LINE_LOST, f"internal error: {e!r}")
            raise
        finally:
            with contextlib.suppress(DeviceError):  # lost already: the fault was posted above, or the process ends
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
            return self._fail(job, PiFault.POINTS_MISMATCH, f"one edge more than the row's {job.points} points")
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
    """Detects a trigger wire that is off: the stage passes points and no edges arrive."""

    def __init__(self) -> None:
        self._edges, self._points, self._statuses = -1, 0, 0

    def is_silent(self, points: int, edges: int) -> bool:
        """Update with a stage status (points passed, edges received); True if the wire is off."""
        if edges != self._edges:
            self._edges, self._points, self._statuses = edges, points, 0
            return False
        self._points = min(self._points, points)  # the stage counts from 0 in each row
        self._statuses += 1
        return self._statuses >= SILENT_STATUSES and points - max(edges, self._points) >= SILENT_POINTS
