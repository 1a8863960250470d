"""Start or resume a scan: `run_scan` and `resume_scan`.

Every row is a transaction (docs/spec/scan-folder.md): it is recorded, checked by count, made durable, and only then
added to the manifest. After a crash or power loss at any time, `resume_scan` continues with the first missing row.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zmq

from polysight.acquisition.capture_rig import CaptureRig
from polysight.acquisition.control import StopRequest, delay_interrupts
from polysight.acquisition.pi_client import PiClient
from polysight.acquisition.progress import OnProgress, OnRow, ScanProgress, ScanResult
from polysight.acquisition.ready import check_same_stage, describe_pi, stage_differences
from polysight.acquisition.scan_loop import RunningScan
from polysight.radar import RadarControl, radar_control
from polysight.store import (
    ManifestWriter,
    RowWithdrawn,
    ScanFolder,
    ScanResumed,
    check_same_scan,
    connection_of,
    damaged_rows,
    new_scan_id,
    utc_now,
)
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ScanError
from polysight_shared.messages import HelloReply, is_simulated
from polysight_shared.raster import check_burst_fits, plan_raster
from polysight_shared.tables import to_builtins


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
        Requested once: stop after the current row; twice: now. In the main thread, Ctrl-C requests.
    radars
        Arms the radars for each row; default: as the rig file says. Closed at the end.

    Raises
    ------
    PolysightError
        with the hop that failed and what to do, also in the manifest; all committed rows are safe.
    """
    plan = plan_raster(instrument.grid)
    check_burst_fits(instrument.grid, instrument.burst, instrument.stage)
    with ExitStack() as stack:
        pi, rig, hello = _connect(stack, instrument, progress)
        warnings = check_same_stage(instrument.stage, hello, "this scan")
        simulated = is_simulated(hello.backend)
        scan = ScanFolder.create(
            folder,
            instrument,
            plan,
            simulated=simulated,
            scan_id=new_scan_id(),
            pi=describe_pi(hello),
            calibration=_copy_calibration(instrument, folder, simulated),
        )
        writer = stack.enter_context(scan.writer())
        radars = stack.enter_context(radars or radar_control(instrument))
        stop = stop or StopRequest()
        return RunningScan(scan, writer, pi, rig, radars, on_row, progress, keep_incomplete, stop).run(warnings)


def resume_scan(
    folder: Path,
    *,
    on_row: OnRow | None = None,
    progress: OnProgress | None = None,
    keep_incomplete: bool = False,
    stop: StopRequest | None = None,
    radars: RadarControl | None = None,
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
        scan.reload()
        withdrawn = _withdraw_damaged(scan, writer, progress)
        pi, rig, hello = _connect(stack, rig_now or scan.instrument, progress)
        if is_simulated(hello.backend) != scan.simulated:
            kind = "simulated" if scan.simulated else "of the real rig"
            raise ScanError(
                f"{folder} is a scan that is {kind}, and the Pi's backend is {hello.backend!r}",
                "simulated and measured rows must never be mixed in one scan",
                "start the Pi with the backend the scan was begun with, or make a new scan",
                code=ErrorCode.MISMATCH,
            )
        if not hello.stage or (scan.started.pi is not None and scan.started.pi.stage):
            warnings = check_same_stage(scan.instrument.stage, hello, f"{folder}")
        else:  # the earlier rows were placed by that Pi, not by the host's rig file
            found = stage_differences(scan.instrument.stage, hello)
            warnings = [f"not compared when the scan began: {d}" for d in found]
        writer.append(
            ScanResumed(
                resumed_utc=utc_now(),
                rows_missing=len(scan.rows_absent),
                pi=describe_pi(hello),
                rig=None if rig_now is None else connection_of(rig_now),
            )
        )
        scan.reload()
        radars = stack.enter_context(radars or radar_control(scan.instrument))
        stop = stop or StopRequest()
        running = RunningScan(scan, writer, pi, rig, radars, on_row, progress, keep_incomplete, stop)
        return running.run(withdrawn + warnings)


def _withdraw_damaged(scan: ScanFolder, writer: ManifestWriter, progress: OnProgress | None) -> list[str]:
    """Withdraw every committed row whose files differ from their digests; return warnings. Raises DeviceError."""
    rows = scan.committed()
    if progress is not None:
        progress(ScanProgress("check", f"comparing {len(rows)} committed rows with their digests", scan.plan.rows, 0))
    damaged = damaged_rows(scan)
    for row, reasons in damaged.items():
        writer.append(RowWithdrawn(row=row, take=rows[row].take, reasons=reasons, withdrawn_utc=utc_now()))
    scan.reload()
    return [f"row {row} is taken again: {'; '.join(reasons)}" for row, reasons in damaged.items()]


def _copy_calibration(instrument: Instrument, folder: Path, simulated: bool) -> dict[str, Any]:
    """Copy the calibration files that the rig file names into the scan; return their entry for the manifest."""
    if not any(to_builtins(instrument.calibration).values()):
        return {}
    # Here, because checking them loads imaging and polarimetry.
    from polysight.calibration import copy_into_scan

    return copy_into_scan(instrument, folder, simulated)


def _connect(
    stack: ExitStack, instrument: Instrument, progress: OnProgress | None
) -> tuple[PiClient, CaptureRig, HelloReply]:
    """Connect to the Pi and every card, before a scan folder is created."""
    if progress is not None:
        progress(ScanProgress("connect", "connecting to the Pi and the capture cards", instrument.grid.rows, 0))
    # Context.term() would wait forever for a socket that was never closed, as after an interrupt in PiClient().
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    stack.callback(context.destroy, linger=0)
    with delay_interrupts():
        pi = stack.enter_context(PiClient(context, instrument))
    hello = pi.hello()
    rig = stack.enter_context(CaptureRig(instrument))
    rig.configure()
    return pi, rig, hello
