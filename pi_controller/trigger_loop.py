"""The trigger loop: a thread of its own that turns each trigger edge into a burst, and waits for nothing else.

What happened goes into a queue; whoever takes it out may be as slow as it likes.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import NamedTuple

from polysight.pi_controller.burst import FIRST_PULSE_DELAY_NS, BurstRecord, BurstSpec, send_bench, send_burst
from polysight.pi_controller.trigger_lines import BitLines, Edge, TriggerLines
from polysight.shared.errors import DeviceError
from polysight.shared.faults import PiFault
from polysight.shared.messages import Pulsed, Timing

# How often the loop looks whether it shall end. Edges are not delayed by it.
LOOK_UP_S = 0.1


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
        self._counts = Counts()
        self._last_seqno: int | None = None
        self._last_rise_ns: int | None = None
        self._busy_until_ns = 0
        self.strays = 0
        self._thread = threading.Thread(target=self._run, name="trigger", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def arm(self, job: RowJob) -> RowJob:
        """From now on, edges belong to this row. Returns the job with its `armed_ns`."""
        with self._lock:
            self._job = job = job._replace(armed_ns=self._lines.now_ns())
            self._counts = Counts()
            return job

    def timed_by(self, spec: BurstSpec) -> Timing:
        """What times the pulses of a burst."""
        if isinstance(self._lines, BitLines):
            return "spi"
        return "program" if spec.check_width else "one-shot"

    def send(self, spec: BurstSpec) -> None:
        """Send one burst that no edge asks for, when the loop next looks up. Only while no row is armed."""
        self._bench = spec

    def disarm(self) -> Counts:
        """Answer no more edges; a running burst ends after its pulse. Returns what was counted since :meth:`arm`."""
        self._job = None
        with self._lock:
            return self._counts

    @property
    def alive(self) -> bool:
        """Whether the loop still serves its lines."""
        return self._thread.is_alive()

    @property
    def counts(self) -> Counts:
        """Of the row that was armed last, so far."""
        return self._counts

    def stop(self, limit_s: float = 0.5) -> bool:
        """End the thread; outputs go low, lines are released. Returns whether it ended within the limit."""
        self._stop.set()
        if self._thread.ident is None:
            self._lines.close()
        else:
            self._thread.join(limit_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        self._prepare()
        try:
            while not self._stop.is_set():
                edge = self._lines.wait_edge(LOOK_UP_S)
                if edge is not None:
                    with self._lock:
                        self._take(edge)
                if self._bench is not None:
                    with self._lock:
                        self._send(self._bench)
        except DeviceError as e:
            self._job = None
            self._post(LoopFault(None, PiFault.TRIGGER_LINE_LOST, e.what))
        except Exception as e:
            self._job = None
            self._post(LoopFault(None, PiFault.TRIGGER_LINE_LOST, f"a fault of this program: {e!r}"))
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
        edges, bursts, pulses = self._counts
        self._counts = Counts(edges + 1, bursts, pulses)
        if lost:
            return self._fail(job, PiFault.EDGE_LOST, f"{lost} edges lost before point {edges}")
        if edge.t_ns < self._busy_until_ns:
            early_us = (self._busy_until_ns - edge.t_ns) / 1e3
            return self._fail(
                job, PiFault.EDGE_DURING_BURST, f"point {edges}: {early_us:.0f} us before the burst's end"
            )
        if edges >= job.points:
            return self._fail(job, PiFault.POINTS_MISMATCH, f"an edge more than the row's {job.points} points")
        start_ns = edge.t_ns + FIRST_PULSE_DELAY_NS
        record = send_burst(self._lines, job.spec, start_ns, self._last_rise_ns, lambda: self._is_over(job))
        if record.pulses:
            self._last_rise_ns, self._busy_until_ns = record.last_ns, record.end_ns
        self._counts = Counts(edges + 1, bursts + (record.pulses > 0), pulses + record.pulses)
        self._post(BurstSent(job, edges, edge.t_ns, record))
        if record.fault:
            detail = f"point {edges}, pulse {record.pulses} of {job.spec.pulses}"
            if record.fault == PiFault.PULSE_TOO_LONG:
                detail += f": may have lasted {record.width_max_ns / 1e3:.1f} us"
            self._fail(job, record.fault, detail)

    def _send(self, spec: BurstSpec) -> None:
        self._bench = None
        start_ns = self._lines.now_ns()
        if self._last_rise_ns is not None:
            start_ns = max(start_ns, self._last_rise_ns + spec.period_ns)
        record = send_bench(self._lines, spec, start_ns, self._last_rise_ns, self._stop.is_set)
        if record.pulses:
            self._last_rise_ns, self._busy_until_ns = record.last_ns, record.end_ns
        self._post(BenchBurst(record, self.timed_by(spec)))

    def _is_over(self, job: RowJob) -> bool:
        return self._job is not job or self._stop.is_set()

    def _fail(self, job: RowJob, number: int, detail: str) -> None:
        self._job = None
        self._post(LoopFault(job, number, detail))
