"""Main loop of a scan: wait for, record and commit every missing row, then record how the scan ended."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from polysight.acquisition.capture_rig import CaptureRig
from polysight.acquisition.control import StopRequest, stop_on_interrupt
from polysight.acquisition.pi_client import PiClient
from polysight.acquisition.progress import (
    OnProgress,
    OnRow,
    ProcessingQueue,
    ScanProgress,
    ScanResult,
    time_left,
    typical_row_s,
)
from polysight.acquisition.ready import check_between_rows, check_disk, make_ready, measure_lost_steps
from polysight.acquisition.row import RowState, RowTaker, RowTransaction
from polysight.acquisition.take import ON_REQUEST, Take, commit_row, reasons, reject_row, retakes_exhausted
from polysight.radar import RadarControl
from polysight.store import (
    EVENTS,
    EventWriter,
    ManifestWriter,
    RowCommitted,
    RowRejected,
    ScanContinued,
    ScanEnded,
    ScanFolder,
    ScanPaused,
    read_events,
    utc_now,
)
from polysight_shared.errors import PolysightError, advice
from polysight_shared.messages import AnyEvent, BeginRun, RowStarted, RunStarted
from polysight_shared.raster import Row

_POLL_S = 0.05
_LOST_STEPS_WARNING_MM = 0.05  # 9 degrees of phase at 77 GHz


class RunningScan:
    """A running scan; needs connected devices and a locked folder."""

    def __init__(
        self,
        scan: ScanFolder,
        writer: ManifestWriter,
        pi: PiClient,
        rig: CaptureRig,
        radars: RadarControl,
        on_row: OnRow | None,
        progress: OnProgress | None,
        keep_incomplete: bool,
        stop: StopRequest,
    ) -> None:
        self._scan, self._writer, self._pi, self._rig = scan, writer, pi, rig
        self._instrument, self._plan = scan.instrument, scan.plan
        self._progress, self._keep_incomplete, self._stop = progress, keep_incomplete, stop
        self._radars = radars
        self._queue = ProcessingQueue(on_row, scan.instrument.limits.rows_waiting)
        self._committed = set(scan.committed())
        self._row_seconds: list[float] = []
        self._row_began: float | None = None  # monotonic, plus pauses; None between rows
        self._current = (-1, 0, 0)  # row, take, points
        self._state = ""
        self._stop_announced = False
        self._was_ready = False  # the stage, in this run
        self._error: PolysightError | None = None  # that ended the scan
        self._lost_mm: tuple[float, float] | None = None
        self.result = ScanResult(scan, "fail", "ended unexpectedly")

    def run(self, warnings: list[str]) -> ScanResult:
        """Record every missing row and how the scan ended; `warnings` are put into the result.

        Raises PolysightError as :func:`polysight.acquisition.scan.run_scan`.
        """
        for warning in self._rig.warnings + warnings:
            self._warn(warning)
        begun = False
        events = EventWriter(self._scan.path / EVENTS)
        try:
            with stop_on_interrupt(self._stop):
                self._pi.follow(self._scan.scan_id, events.last_seq, events.append)
                self._pi.begin_run(self._begin_run(events.last_seq))
                begun = True
                self._pi.drain()  # events of an earlier program's takes
                self._warn_of_lost_events(self._pi.events())
                events.sync()
                self._queue.add_earlier(sorted(self._committed))
                self._write_radar_report({})
                self._rows(events)
                self._check_lost_steps()
                self._end(begun)
                events.sync()
        except BaseException as e:
            self._fail(e, begun)
            raise
        finally:
            events.close()
            self.result.processing_error = self._queue.close(now=self._stop.now)
        self._scan.reload()
        return self.result

    def _fail(self, e: BaseException, begun: bool) -> None:
        """Bring the rig to rest after an error, record the reason, and add to the error which rows are safe."""
        self.result.exit_status = "abort" if isinstance(e, KeyboardInterrupt) else "fail"
        safe = f"{len(self._committed)} of {self._plan.rows} rows are safe"
        resume = f"`polysight resume {self._scan.path}` continues from there"
        if isinstance(e, PolysightError):
            e.remedy = advice(e.remedy, safe, "" if f"polysight resume {self._scan.path}" in e.remedy else resume)
            self._error = e
            self.result.reason = e.what
        else:
            e.add_note(advice(safe, resume))
            self.result.reason = f"{type(e).__name__}: {e}"
        with stop_on_interrupt(self._stop):
            if begun:
                with suppress(PolysightError):  # the first error is the one to report
                    self._pi.come_to_rest(self.result.reason[:500])
            with suppress(PolysightError):
                self._end(begun)

    def _begin_run(self, last_seq: int) -> BeginRun:
        i = self._instrument
        return BeginRun(
            scan_id=self._scan.scan_id,
            plan=self._plan,
            pulses=i.burst.pulses,
            period_us=i.burst.period_us,
            width_us=i.burst.width_us,
            speed_mm_s=i.stage.speed_mm_s,
            last_seq=last_seq,
            heartbeat_ms=i.pi.host_heartbeat_ms,
        )

    def _warn_of_lost_events(self, events: list[AnyEvent]) -> None:
        """Warn if the Pi's journal is shorter than the scan's event log."""
        for event in events:
            if isinstance(event, RunStarted) and event.lost:
                self._warn(
                    f"the Pi's journal of this scan ends {event.lost} events before {self._scan.path / EVENTS}: it was"
                    f" removed, damaged or cut by a power loss; nothing is missing here, the scan continues with event"
                    f" {event.seq}"
                )

    def _rows(self, events: EventWriter) -> None:
        """Record every missing row, in order."""
        todo = [row for row in self._plan if row.index not in self._committed]
        check_disk(self._scan.path, self._instrument, len(todo))
        takes = takes_so_far(self._scan)
        taker = RowTaker(
            self._instrument,
            self._rig,
            self._radars,
            self._pi,
            self._scan.scan_id,
            self._scan.path,
            self._stop,
            self._point,
            self._notify,
        )
        for row in todo:
            if self._stop.after_row:
                break
            self._row_began = time.monotonic()
            self._row(row, takes.get(row.index, 0) + 1, taker, events)
            if row.index not in self._committed:
                break
            self._row_seconds.append(time.monotonic() - self._row_began)
            self._row_began = None
            self._notify("committed", f"row {row.index} committed")
        left = self._plan.rows - len(self._committed)
        if left == 0:
            self.result.exit_status, self.result.reason = "success", "every row is committed"
        else:
            self.result.exit_status = "abort"
            self.result.reason = f"stopped on request, {left} of {self._plan.rows} rows are missing"

    def _check_lost_steps(self) -> None:
        """Measure lost steps by homing after the last row; a failure is only a warning, the scan is complete."""
        if not (self._instrument.stage.home_after_scan and self._was_ready and self.result.exit_status == "success"):
            return
        try:
            lost_mm = measure_lost_steps(self._pi, self._stop, self._notify)
        except PolysightError as e:
            self._warn(f"every row is committed; lost steps were not measured: {e.what}")
            return
        self._lost_mm = lost_mm
        if lost_mm and max(map(abs, lost_mm)) >= _LOST_STEPS_WARNING_MM:
            self._warn(
                f"the drives lost {lost_mm[0]:.3f} mm in x and {lost_mm[1]:.3f} mm in y since the last homing:"
                " rows may be displaced; check belts, screws and drivers, and scan again"
            )

    def _row(self, row: Row, first_take: int, taker: RowTaker, events: EventWriter) -> None:
        """Record and commit a row, with retakes; return without commit if asked to stop."""
        last_take = first_take + self._instrument.limits.row_retakes
        for number in range(first_take, last_take + 1):
            transaction = RowTransaction(self._on_state)
            try:
                take = self._take(row, number, taker, transaction)
                if take is None:
                    transaction.to(RowState.STOPPED)
                    return
                events.sync()
                if self._settle(take, number == last_take, transaction, events) or self._stop.now:
                    return
            except BaseException:
                transaction.fail()
                raise
            faults = take.faults(self._instrument.burst.pulses)
            if number == last_take:
                raise retakes_exhausted(take, faults, self._scan, number - first_take + 1)
            check_between_rows(self._pi.status(), self._scan.scan_id, first=False)
            if take.silent_boards:
                self._rig.configure(take.silent_boards)  # a card that lost power has lost its configuration
            self.result.retakes += 1
            self._notify("retake", f"row {row.index} is taken again: {reasons(faults)}")

    def _take(self, row: Row, number: int, taker: RowTaker, transaction: RowTransaction) -> Take | None:
        """Wait until the row may begin, and record it; return None if asked to stop before it began."""
        check_disk(self._scan.path, self._instrument, 1)
        if not self._wait_while_paused() or not self._wait_for_processing():
            return None
        with self._untimed():
            ready = make_ready(self._pi, self._stop, self._notify, self._scan.scan_id, first=not self._was_ready)
        if not ready:
            return None
        self._was_ready = True
        self._current = (row.index, number, row.points)
        self._notify("row", f"row {row.index}" + (f", take {number}" if number > 1 else ""))
        try:
            return taker.take(row, number, transaction)
        finally:
            self._write_radar_report({"row": row.index, "take": number})

    def _write_radar_report(self, of: dict[str, int]) -> None:
        """Add the radars' report since the last one to the manifest, if there is one."""
        if report := self._radars.report():
            self._writer.append({"fact": "radars", **of, **report})

    @contextmanager
    def _untimed(self) -> Iterator[None]:
        """Exclude the block from the row's duration, unlike waiting for processing."""
        began = time.monotonic()
        try:
            yield
        finally:
            if self._row_began is not None:
                self._row_began += time.monotonic() - began

    def _wait_while_paused(self) -> bool:
        """Wait for the end of a pause and record it in the manifest; return False if asked to stop."""
        if not self._stop.paused:
            return not self._stop.now
        self._writer.append(ScanPaused(paused_utc=utc_now()))
        self._notify("wait", "paused on request; `continue` begins the next row")
        with self._untimed():
            while self._stop.paused:
                if self._stop.after_row:
                    return False
                time.sleep(_POLL_S)
                self._pi.events()
        self._writer.append(ScanContinued(continued_utc=utc_now()))
        self._notify("wait", "continued")
        return not self._stop.after_row

    def _wait_for_processing(self) -> bool:
        """Wait until processing has caught up; return False if asked to stop."""
        waited = False
        while waiting := self._queue.behind:
            if self._stop.after_row:
                return False
            if not waited:
                self._notify("wait", f"{waiting} rows wait to be processed; the next one begins when they are fewer")
            waited = True
            self._queue.wait(_POLL_S)
            self._pi.events()
        return not (self._stop.now or (waited and self._stop.after_row))

    def _settle(self, take: Take, last: bool, transaction: RowTransaction, events: EventWriter) -> bool:
        """Commit or reject the take; return True if it is committed."""
        row, faults = take.row.index, take.faults(self._instrument.burst.pulses)
        keep = last and self._keep_incomplete and take.all_pulses_sent and not self._stop.now
        if faults and not keep:
            reject_row(self._scan, self._writer, take, [ON_REQUEST] if self._stop.now else faults)
            transaction.to(RowState.REJECTED)
            return False
        commit_row(self._scan, self._writer, take, faults, events.digest())
        transaction.to(RowState.KEPT if faults else RowState.COMMITTED)
        self._committed.add(row)
        self._queue.add(row)
        if faults:
            self.result.incomplete_rows.append(row)
            self._notify("warning", f"row {row} is kept incomplete: {reasons(faults)}")
        return True

    def _end(self, begun: bool) -> None:
        """Add `scan_ended` to the manifest and end the Pi's run."""
        status, reason = self.result.exit_status, self.result.reason
        self._writer.append(
            ScanEnded(
                exit_status=status,
                reason=reason,
                why=self._error.why if self._error is not None else "",
                remedy=self._error.remedy if self._error is not None else "",
                lost_mm=self._lost_mm,
                rows_committed=len(self._committed),
                events_refetched=self._pi.gaps_filled,
                ended_utc=utc_now(),
            )
        )
        waiting = f"; {self._queue.left} rows wait to be processed" if self._queue.left else ""
        self._notify("end", reason + waiting)
        if not begun:
            return
        try:
            self._pi.end_run(self._scan.scan_id, status, reason)
            self._pi.drain()
        except PolysightError as e:
            if status != "success":
                raise
            self.result.warnings.append(f"the Pi's run could not be ended: {e.what}")

    def _point(self, points: int) -> None:
        if self._stop.after_row and not self._stop.now and not self._stop_announced:
            self._stop_announced = True
            self._notify("stop", "the scan ends after this row; Ctrl-C once more ends it now")
        self._notify("row", "", points)

    def _warn(self, warning: str) -> None:
        self.result.warnings.append(warning)
        self._notify("warning", warning)

    def _notify(self, phase: str, message: str, points: int = 0) -> None:
        """Report progress, if a callback was given; drop the callback if it fails."""
        if self._progress is None:
            return
        rows, committed = self._plan.rows, len(self._committed)
        remaining = None
        if self._row_seconds:
            elapsed_s = time.monotonic() - self._row_began if self._row_began is not None else 0.0
            remaining = time_left(rows - committed, typical_row_s(self._row_seconds), elapsed_s)
        row, take, row_points = self._current
        report = ScanProgress(phase, message, rows, committed, row, take, points, row_points, remaining, self._state)
        try:
            self._progress(report)
        # A closed terminal, or a log on a full disk, must not end the row.
        except Exception as e:  # noqa: BLE001
            self._progress = None
            self.result.warnings.append(f"progress is no longer reported: {type(e).__name__}: {e}")

    def _on_state(self, state: RowState) -> None:
        self._state = str(state)
        self._notify("state", "")


def takes_so_far(scan: ScanFolder) -> dict[int, int]:
    """Return the highest take number of every row that was begun, so that none is used twice."""
    begun = [(f.row, f.take) for f in (*scan.facts(RowCommitted), *scan.facts(RowRejected))]
    events = read_events(scan.path / EVENTS).events
    begun += [(e.row.index, e.take) for e in events if isinstance(e, RowStarted)]
    return dict(sorted(begun))  # of one row's takes, the highest is the last
