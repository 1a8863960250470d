"""Start, resume and run a scan: `run_scan` and `resume_scan`.

Every row is a transaction (docs/spec/scan-folder.md): it is recorded, checked by count, made durable, and only then
added to the manifest. After a crash or power loss at any time, `resume_scan` continues with the first missing row.
A *take* is one attempt to record a row, a *retake* a further one; a row is *committed* once the manifest lists it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import zmq

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
from polysight.acquisition.pulse_times import check_frame_fills_packet
from polysight.acquisition.ready import (
    check_between_rows,
    check_disk,
    check_same_stage,
    describe_pi,
    list_stage_differences,
    make_begin_run,
    make_ready,
    measure_lost_steps,
)
from polysight.acquisition.row import (
    ON_REQUEST,
    RowState,
    RowTaker,
    RowTransaction,
    Take,
    commit_row,
    explain_incomplete_row,
    join_faults,
    reject_row,
)
from polysight.radar import RadarControl, open_radar_control
from polysight.store import (
    EVENTS,
    EventWriter,
    ManifestWriter,
    RowCommitted,
    RowRejected,
    RowWithdrawn,
    ScanContinued,
    ScanEnded,
    ScanFolder,
    ScanPaused,
    ScanResumed,
    check_same_scan,
    extract_connection,
    find_damaged_rows,
    make_scan_id,
    read_events,
    utc_now,
)
from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode, PolysightError, ScanError, join_advice, quote
from polysight_shared.messages import AnyEvent, HelloReply, RowStarted, RunStarted, is_simulated
from polysight_shared.program import delay_interrupts
from polysight_shared.raster import Row, check_burst_fits, plan_raster
from polysight_shared.tables import to_builtins

# Time between two readings of the Pi's events while a scan waits; chosen.
_POLL_S = 0.05
# Smallest loss of steps of which the user is warned (chosen). A displacement of 0.05 mm changes the path to an object
# and back by up to 0.1 mm: 9 degrees of phase at 77 GHz.
_LOST_STEPS_WARNING_MM = 0.05


class RunningScan:
    """A running scan; needs connected devices and a locked folder. Parameters as of :func:`run_scan`."""

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
        self._scan = scan
        self._writer = writer
        self._pi = pi
        self._rig = rig
        self._instrument = scan.instrument
        self._plan = scan.plan
        self._progress = progress
        self._keep_incomplete = keep_incomplete
        self._stop = stop
        self._radars = radars
        self._queue = ProcessingQueue(on_row, scan.instrument.limits.rows_waiting)
        self._committed = set(scan.committed_rows())
        # Durations of the rows of this run.
        self._row_seconds: list[float] = []
        # Start of the current row on the monotonic clock, plus the duration of the pauses in it; None between rows.
        self._row_began: float | None = None
        # Index, take number and points of the current row.
        self._current = (-1, 0, 0)
        # State of the current row, a `RowState`; "" before the first.
        self._state = ""
        self._stop_announced = False
        # True once the stage was ready in this run.
        self._was_ready = False
        # The error that ended the scan.
        self._error: PolysightError | None = None
        # Lost steps in x and y; None if they were not measured.
        self._lost_mm: tuple[float, float] | None = None
        self.result = ScanResult(scan, "fail", "ended unexpectedly")

    def run(self, warnings: list[str]) -> ScanResult:
        """Record every missing row and how the scan ended; `warnings` are put into the result.

        Raises PolysightError as :func:`polysight.acquisition.scan.run_scan`.
        """
        for warning in self._rig.warnings + warnings:
            self._warn(warning)
        has_begun = False
        events = EventWriter(self._scan.path / EVENTS)
        try:
            with stop_on_interrupt(self._stop):
                self._pi.follow(self._scan.scan_id, events.last_seq, events.append)
                self._pi.begin_run(make_begin_run(self._instrument, self._scan.scan_id, self._plan, events.last_seq))
                has_begun = True
                # Fetch the events of takes that an earlier program recorded.
                self._pi.drain()
                self._warn_of_lost_events(self._pi.events())
                events.sync()
                self._queue.add_earlier(sorted(self._committed))
                self._write_radar_report({})
                self._record_rows(events)
                self._check_lost_steps()
                self._end_scan(has_begun)
                events.sync()
        except BaseException as e:
            self._fail(e, has_begun)
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
        resume = f"`polysight resume {quote(self._scan.path)}` continues from there"
        if isinstance(e, PolysightError):
            # Do not repeat the command if the remedy has it already.
            if f"polysight resume {quote(self._scan.path)}" in e.remedy:
                resume = ""
            e.remedy = join_advice(e.remedy, safe, resume)
            self._error = e
            self.result.reason = e.what
        else:
            e.add_note(join_advice(safe, resume))
            self.result.reason = f"{type(e).__name__}: {e}"
        with stop_on_interrupt(self._stop):
            if begun:
                # The first error is the one to report.
                with suppress(PolysightError):
                    self._pi.come_to_rest(self.result.reason)
            # If `_end_scan` failed itself, the manifest gets a second `scan_ended`, with its error; readers use the
            # last one.
            with suppress(PolysightError):
                self._end_scan(begun)

    def _warn_of_lost_events(self, events: list[AnyEvent]) -> None:
        """Warn if the Pi's journal is shorter than the scan's event log."""
        for event in events:
            if isinstance(event, RunStarted) and event.lost_events:
                self._warn(
                    f"the Pi's journal of this scan ends {event.lost_events} events before"
                    f" {self._scan.path / EVENTS}: it was removed, damaged or cut by a power loss; nothing is missing"
                    f" here, the scan continues with event {event.seq}"
                )

    def _record_rows(self, events: EventWriter) -> None:
        """Record every missing row, in order."""
        todo = [row for row in self._plan if row.index not in self._committed]
        check_disk(self._scan.path, self._instrument, len(todo))
        takes = find_last_takes(self._scan)
        taker = RowTaker(
            instrument=self._instrument,
            rig=self._rig,
            radars=self._radars,
            pi=self._pi,
            scan_id=self._scan.scan_id,
            folder=self._scan.path,
            stop=self._stop,
            on_point=self._report_points,
            notify=self._notify,
        )
        for row in todo:
            if self._stop.after_row:
                break
            self._row_began = time.monotonic()
            self._record_row(row, takes.get(row.index, 0) + 1, taker, events)
            if row.index not in self._committed:
                break
            self._row_seconds.append(time.monotonic() - self._row_began)
            self._row_began = None
            self._notify("committed", f"row {row.index} committed")
        rows_left = self._plan.rows - len(self._committed)
        if rows_left == 0:
            self.result.exit_status = "success"
            self.result.reason = "every row is committed"
        else:
            self.result.exit_status = "abort"
            self.result.reason = f"stopped on request, {rows_left} of {self._plan.rows} rows are missing"

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

    def _record_row(self, row: Row, first_take: int, taker: RowTaker, events: EventWriter) -> None:
        """Record and commit a row, with retakes; return without commit if asked to stop."""
        last_take = first_take + self._instrument.limits.row_retakes
        for number in range(first_take, last_take + 1):
            transaction = RowTransaction(self._follow_state)
            try:
                take = self._take_row(row, number, taker, transaction)
                if take is None:
                    transaction.change_state(RowState.STOPPED)
                    return
                events.sync()
                if self._commit_or_reject(take, number == last_take, transaction, events) or self._stop.now:
                    return
            except BaseException:
                transaction.fail()
                raise
            faults = take.faults(self._instrument.burst.pulses)
            if number == last_take:
                raise explain_incomplete_row(take, faults, self._scan, number - first_take + 1)
            # Raises if the next take cannot begin without a person; homing is allowed only before the first row.
            check_between_rows(self._pi.status(), self._scan.scan_id, first=False)
            if take.silent_boards:
                # A card that lost power has lost its configuration.
                self._rig.configure(take.silent_boards)
            self.result.retakes += 1
            self._notify("retake", f"row {row.index} is retaken: {join_faults(faults)}")

    def _take_row(self, row: Row, number: int, taker: RowTaker, transaction: RowTransaction) -> Take | None:
        """Wait until the row may begin, and record it; return None if asked to stop before it began."""
        check_disk(self._scan.path, self._instrument, 1)
        if not self._wait_while_paused() or not self._wait_for_processing():
            return None
        with self._exclude_time():
            ready = make_ready(self._pi, self._stop, self._notify, self._scan.scan_id, first=not self._was_ready)
        if not ready:
            return None
        self._was_ready = True
        self._current = (row.index, number, row.points)
        message = f"row {row.index}"
        if number > 1:
            message += f", take {number}"
        self._notify("row", message)
        try:
            return taker.take(row, number, transaction)
        finally:
            self._write_radar_report({"row": row.index, "take": number})

    def _write_radar_report(self, row_and_take: dict[str, int]) -> None:
        """Add the radars' report since the last one to the manifest, if there is one."""
        if report := self._radars.report():
            self._writer.append({"fact": "radars", **row_and_take, **report})

    @contextmanager
    def _exclude_time(self) -> Iterator[None]:
        """Exclude the block from the row's duration; the wait for processing is not excluded."""
        started_s = time.monotonic()
        try:
            yield
        finally:
            if self._row_began is not None:
                self._row_began += time.monotonic() - started_s

    def _wait_while_paused(self) -> bool:
        """Wait for the end of a pause and record it in the manifest; return False if asked to stop.

        Without a pause the result is False only after a request to stop immediately: the caller has already checked
        whether the scan is to end before this row.
        """
        if not self._stop.paused:
            return not self._stop.now
        self._writer.append(ScanPaused(paused_utc=utc_now()))
        self._notify("wait", "paused on request; `continue` begins the next row")
        with self._exclude_time():
            while self._stop.paused:
                if self._stop.after_row:
                    return False
                time.sleep(_POLL_S)
                self._pi.events()
        self._writer.append(ScanContinued(continued_utc=utc_now()))
        self._notify("wait", "continued")
        return not self._stop.after_row

    def _wait_for_processing(self) -> bool:
        """Wait until processing has caught up; return False if asked to stop now, or during the wait."""
        waited = False
        while waiting := self._queue.over_limit:
            if self._stop.after_row:
                return False
            if not waited:
                self._notify("wait", f"{waiting} rows wait to be processed; the next row begins when fewer are waiting")
            waited = True
            self._queue.wait(_POLL_S)
            self._pi.events()
        # Without a wait, the caller has just asked if the scan ends before this row, or takes a row again.
        if waited and self._stop.after_row:
            return False
        return not self._stop.now

    def _commit_or_reject(self, take: Take, is_last: bool, transaction: RowTransaction, events: EventWriter) -> bool:
        """Commit or reject the take; return True if it is committed."""
        row = take.row.index
        faults = take.faults(self._instrument.burst.pulses)
        may_keep_incomplete = is_last and self._keep_incomplete and take.all_pulses_sent and not self._stop.now
        if faults and not may_keep_incomplete:
            if self._stop.now:
                faults = [ON_REQUEST]
            reject_row(self._scan, self._writer, take, faults)
            transaction.change_state(RowState.REJECTED)
            return False
        commit_row(self._scan, self._writer, take, faults, events.digest())
        transaction.change_state(RowState.KEPT if faults else RowState.COMMITTED)
        self._committed.add(row)
        self._queue.add(row)
        if faults:
            self.result.incomplete_rows.append(row)
            self._notify("warning", f"row {row} is kept incomplete: {join_faults(faults)}")
        return True

    def _end_scan(self, begun: bool) -> None:
        """Add `scan_ended` to the manifest and end the Pi's run."""
        status = self.result.exit_status
        reason = self.result.reason
        cause = ""
        remedy = ""
        if self._error is not None:
            cause = self._error.why
            remedy = self._error.remedy
        command = ""
        asker = ""
        if status == "abort":
            command = self._stop.pending
            asker = self._stop.asker
        self._writer.append(
            ScanEnded(
                exit_status=status,
                reason=reason,
                why=cause,
                remedy=remedy,
                lost_mm=self._lost_mm,
                rows_committed=len(self._committed),
                events_refetched=self._pi.gaps_filled,
                ended_utc=utc_now(),
                asked=command,
                asker=asker,
            )
        )
        waiting = ""
        if self._queue.rows_left:
            waiting = f"; {self._queue.rows_left} rows wait to be processed"
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

    def _report_points(self, points: int) -> None:
        """Report the points of the row so far, and once that a stop was requested."""
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
        rows = self._plan.rows
        committed = len(self._committed)
        remaining = None
        if self._row_seconds:
            elapsed_s = 0.0
            if self._row_began is not None:
                elapsed_s = time.monotonic() - self._row_began
            remaining = time_left(rows - committed, typical_row_s(self._row_seconds), elapsed_s)
        row, take, row_points = self._current
        report = ScanProgress(
            phase=phase,
            message=message,
            rows=rows,
            committed=committed,
            row=row,
            take=take,
            points=points,
            row_points=row_points,
            remaining_s=remaining,
            state=self._state,
        )
        try:
            self._progress(report)
        # A closed terminal, or a log on a full disk, must not end the row.
        except Exception as e:  # noqa: BLE001
            self._progress = None
            self.result.warnings.append(f"progress is no longer reported: {type(e).__name__}: {e}")

    def _follow_state(self, state: RowState) -> None:
        """Note the current row's state and report it."""
        self._state = str(state)
        self._notify("state", "")


def find_last_takes(scan: ScanFolder) -> dict[int, int]:
    """Return the highest take number of every row that was begun, so that none is used twice."""
    begun_takes = [(f.row, f.take) for f in (*scan.facts(RowCommitted), *scan.facts(RowRejected))]
    events = read_events(scan.path / EVENTS).events
    begun_takes += [(e.row.index, e.take) for e in events if isinstance(e, RowStarted)]
    # Sorted by row and take: in the dictionary, the highest take of a row replaces its others.
    return dict(sorted(begun_takes))


def run_scan(
    instrument: Instrument,
    folder: Path,
    *,
    on_row: OnRow | None = None,
    progress: OnProgress | None = None,
    keep_incomplete: bool = False,
    stop: StopRequest | None = None,
    radars: RadarControl | None = None,
) -> ScanResult:
    """Create a scan folder and record a scan into it.

    Parameters
    ----------
    instrument
        The rig, the grid and the limits.
    folder
        Scan folder to create.
    on_row
        Called with each committed row's index, in order, in a low-priority worker thread.
    progress
        Called in the calling thread.
    keep_incomplete
        Commit a row that is incomplete after all retakes, masked, instead of failing.
    stop
        Request to stop: the first one ends the scan after the current row, the second one immediately. In the main
        thread, Ctrl-C makes such a request.
    radars
        Arms the radars for each row; default: as the rig file says. Closed at the end.

    Raises
    ------
    PolysightError
        with the hop (the device or link on the way to the data) that failed and what to do, also in the manifest once
        the scan has begun; all committed rows are safe.
    """
    plan = plan_raster(instrument.grid)
    check_burst_fits(instrument.grid, instrument.burst, instrument.stage)
    check_frame_fills_packet(instrument)
    with ExitStack() as stack:
        pi, rig, hello = _connect(stack, instrument, progress)
        warnings = check_same_stage(instrument.stage, hello, "this scan")
        simulated = is_simulated(hello.backend)
        scan = ScanFolder.create(
            folder,
            instrument,
            plan,
            simulated=simulated,
            scan_id=make_scan_id(),
            pi=describe_pi(hello),
            calibration=_copy_calibration(instrument, folder, simulated),
        )
        writer = stack.enter_context(scan.writer())
        if progress is not None:
            # Report progress now, because the radars may take seconds: from now on the scan's folder exists, and the
            # caller can show it and request a stop.
            progress(ScanProgress("check", "making the radars ready", plan.rows, committed=0))
        radars = stack.enter_context(radars or open_radar_control(instrument))
        stop = stop or StopRequest()
        return RunningScan(
            scan=scan,
            writer=writer,
            pi=pi,
            rig=rig,
            radars=radars,
            on_row=on_row,
            progress=progress,
            keep_incomplete=keep_incomplete,
            stop=stop,
        ).run(warnings)


def resume_scan(
    folder: Path,
    *,
    on_row: OnRow | None = None,
    progress: OnProgress | None = None,
    keep_incomplete: bool = False,
    stop: StopRequest | None = None,
    rig_now: Instrument | None = None,
) -> ScanResult:
    """Resume a scan at its first missing row, after comparing committed rows with their digests.

    A row that differs from its digest is taken again. `rig_now` may change addresses and limits; everything else must
    be equal to the rig that the scan was begun with (:func:`polysight.store.check_same_scan`).

    Parameters and errors as :func:`run_scan`. `on_row` is called for the rows committed earlier too.
    """
    scan = ScanFolder.load(folder)
    if rig_now is not None:
        check_same_scan(scan.instrument, rig_now, "the rig file given")
    with ExitStack() as stack:
        writer = stack.enter_context(scan.writer())
        # Read it again under the writer's lock: another program may have written to it until then.
        scan.reload()
        withdrawn = _withdraw_damaged(scan, writer, progress)
        pi, rig, hello = _connect(stack, rig_now or scan.instrument, progress)
        _check_cards(scan, rig)
        if is_simulated(hello.backend) != scan.simulated:
            kind = "simulated" if scan.simulated else "of the real rig"
            raise ScanError(
                f"{folder} is a scan that is {kind}, and the Pi's backend is {hello.backend!r}",
                "simulated and measured rows must never be mixed in one scan",
                "start the Pi with the backend with which the scan began, or make a new scan",
                code=ErrorCode.MISMATCH,
            )
        # The Pi's settings must be those that it reported when the scan began. A Pi of an older program reports none:
        # `check_same_stage` then only warns.
        if not hello.stage or (scan.started.pi is not None and scan.started.pi.stage):
            warnings = check_same_stage(scan.instrument.stage, hello, f"{folder}")
        else:
            # The scan began without the Pi's stage settings, which placed its rows: a difference is only a warning.
            differences = list_stage_differences(scan.instrument.stage, hello)
            warnings = [f"not compared when the scan began: {d}" for d in differences]
        # Addresses and limits, for the manifest; with `scan.reload` they are in `scan.instrument`.
        connection = None
        if rig_now is not None:
            connection = extract_connection(rig_now)
        writer.append(
            ScanResumed(
                resumed_utc=utc_now(),
                rows_missing=len(scan.rows_absent),
                pi=describe_pi(hello),
                rig=connection,
            )
        )
        scan.reload()
        radars = stack.enter_context(open_radar_control(scan.instrument))
        stop = stop or StopRequest()
        running = RunningScan(
            scan=scan,
            writer=writer,
            pi=pi,
            rig=rig,
            radars=radars,
            on_row=on_row,
            progress=progress,
            keep_incomplete=keep_incomplete,
            stop=stop,
        )
        return running.run(withdrawn + warnings)


def _withdraw_damaged(scan: ScanFolder, writer: ManifestWriter, progress: OnProgress | None) -> list[str]:
    """Withdraw every committed row whose files differ from their digests; return warnings.

    Raises DeviceError if the manifest cannot be written.
    """
    rows = scan.committed_rows()
    if progress is not None:
        message = f"comparing {len(rows)} committed rows with their digests"
        progress(ScanProgress("check", message, scan.plan.rows, committed=0))
    damaged = find_damaged_rows(scan)
    for row, faults in damaged.items():
        writer.append(RowWithdrawn(row=row, take=rows[row].take, reasons=faults, withdrawn_utc=utc_now()))
    scan.reload()
    return [f"row {row} is retaken: {'; '.join(faults)}" for row, faults in damaged.items()]


def _check_cards(scan: ScanFolder, rig: CaptureRig) -> None:
    """Raise ScanError if a card sent another board's rows so far, by its MAC address: boards would be exchanged."""
    macs_of_board: dict[str, set[str]] = {}
    for row in scan.committed_rows().values():
        for name, board in row.boards.items():
            macs_of_board.setdefault(name, set()).add(board.card_mac)
    for name, card in rig.cards.items():
        boards_of_card = [other for other, macs in macs_of_board.items() if card.mac in macs]
        if card.mac and boards_of_card and name not in boards_of_card:
            raise ScanError(
                f"the card of {name} at {card.board.card_address} sent the rows of {boards_of_card[0]} so far"
                f" (MAC address {card.mac})",
                "cards or their addresses were exchanged: later rows would be those of another board",
                "exchange them back, or begin another scan",
                code=ErrorCode.MISMATCH,
            )


def _copy_calibration(instrument: Instrument, folder: Path, simulated: bool) -> dict[str, Any]:
    """Copy the calibration files that the rig file names into the scan; return their entry for the manifest."""
    if not any(to_builtins(instrument.calibration).values()):
        return {}
    # Imported here, because it loads imaging and polarimetry.
    from polysight.calibration import copy_into_scan

    return copy_into_scan(instrument, folder, simulated)


def _connect(
    stack: ExitStack, instrument: Instrument, progress: OnProgress | None
) -> tuple[PiClient, CaptureRig, HelloReply]:
    """Connect to the Pi and every card, before a scan folder is created; return both and the Pi's first reply.

    `stack` closes them.
    """
    if progress is not None:
        message = "connecting to the Pi and the capture cards"
        progress(ScanProgress("connect", message, instrument.grid.rows, committed=0))
    # Context.term() would wait forever for a socket that was never closed, as after an interrupt in PiClient().
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    stack.callback(context.destroy, linger=0)
    with delay_interrupts():
        pi = stack.enter_context(PiClient(context, instrument))
    hello = pi.hello()
    rig = stack.enter_context(CaptureRig(instrument))
    rig.configure()
    return pi, rig, hello
